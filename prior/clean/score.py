"""The score stage: anomaly detection for each body and joint.

The fault network gives each joint's log odds of being faulty. A window's score is the highest score of its joints. Both
are converted to an anomaly: -log10 of the rate at which clean windows of the same pace, of people unseen in training,
score at least as high. One clean window in a hundred has an anomaly of 2 or more.

Sensors and people unlike those of the validation set score higher throughout without being faulty. Each body's anomaly
is therefore divided by a scale estimated from its own last ten seconds (`OwnScale`).

The paper scores by log p(z | x) alone; `steadypose evaluate hgvae` compares the two.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import BodyWindows, Score
from steadypose.prior.clean.settings import ScoreSettings
from steadypose.prior.models.hgvae.faults import SENSOR_SIGMAS, Calibration, LiveFaultNet, decimals, joint_odds, pace
from steadypose.prior.timing.rate import FPS

MEAN_ANOMALY = 0.54
"""Mean anomaly at which the scale is 1 (chosen on validation, benchmarks/NOTEBOOK.md). For a body that follows the
validation set's distribution, the mean is 1 / ln 10 = 0.43."""

MAX_COUNTED = 2.0
"""Bound at which a frame's anomaly is clipped in the mean, so that a fault of one second hardly changes the scale."""

MAX_SCALE = 2.0
"""Largest scale; a body that would need more, such as one with a wrong skeleton, should be flagged."""

OWN_FRAMES, FIRST_FRAMES = 300, 30
"""Length of the running mean, and weight of `MEAN_ANOMALY` in it for a new body, frames."""

RELEASED = 0.8  # fraction of the flag's threshold below which the anomaly must stay for the flag to be cleared


class OwnScale:
    """The scale of each body's anomaly: its mean relative to the validation set's, between 1 and `MAX_SCALE`.

    A calibrated anomaly is distributed exponentially. If its mean is k times as large, so are its quantiles.
    """

    def __init__(self, slots: int) -> None:
        self._mean = np.full(slots, MEAN_ANOMALY)
        self._frames = np.full(slots, FIRST_FRAMES)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mean[slot], self._frames[slot] = MEAN_ANOMALY, FIRST_FRAMES

    def update(self, slots: NDArray[np.intp], anomaly: Floats) -> Floats:
        """Return the scales (B,) of the bodies ``slots`` (B,) up to the last frame, then add ``anomaly`` (B,)."""
        scale = np.clip(self._mean[slots] / MEAN_ANOMALY, 1.0, MAX_SCALE)
        self._frames[slots] = np.minimum(self._frames[slots] + 1, OWN_FRAMES)
        self._mean[slots] += (np.fmin(anomaly, MAX_COUNTED) - self._mean[slots]) / self._frames[slots]
        return scale


class Scorer:
    """Scores the newest window of each body, and sets the flag with hysteresis."""

    def __init__(self, settings: ScoreSettings, weights: str, slots: int) -> None:
        if not 0 < settings.false_alarms < 1:
            raise ValueError(f"score.false_alarms: expected a share between 0 and 1, got {settings.false_alarms:g}")
        self._height = -np.log10(settings.false_alarms)
        self._hold = settings.hold
        self._network = LiveFaultNet.load(weights, slots)
        self._calibration = Calibration.load(weights)
        self._scale = OwnScale(slots)
        self._quiet_s = np.full(slots, np.inf)
        self._flag = np.zeros(slots, dtype=bool)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._scale.forget(slot)
        self._quiet_s[slot] = np.inf
        self._flag = self._flag & ~slot

    def update(self, windows: BodyWindows | None, faulty: Bools, sensor_sigma: Floats) -> Score:
        """Score the newest frame, in which the joints ``faulty`` (S, 22) repeat themselves or were mirrored back.

        ``sensor_sigma`` (S,) is the estimated error of each body's observations, metres along an axis.
        """
        anomaly, joint_anomaly = np.full(len(faulty), np.nan), np.full(faulty.shape, np.nan)
        if windows is not None:
            slots = windows.slots
            oddest, joints = self._score(windows, faulty[slots], sensor_sigma[slots])
            scale = self._scale.update(slots, oddest)
            anomaly[slots], joint_anomaly[slots] = oddest / scale, joints / scale[:, None]
        with np.errstate(invalid="ignore"):
            self._quiet_s = np.where(anomaly > RELEASED * self._height, 0.0, self._quiet_s + 1 / FPS)
            raised = anomaly > self._height
        self._flag = raised | self._flag & (self._quiet_s < self._hold)
        return Score(anomaly, self._flag, joint_anomaly)

    def _score(self, windows: BodyWindows, frozen: Bools, sensor_sigma: Floats) -> tuple[Floats, Floats]:
        """Return the anomaly of each window (B,) and of its joints (B, 22), before the body's own scale."""
        tracks, found = windows.tracks, windows.reconstruction
        sensor_sigma = np.clip(sensor_sigma, SENSOR_SIGMAS[0], SENSOR_SIGMAS[-1])  # the range it was trained on
        odds = self._network(tracks.x, found.mean, found.sigma, tracks.observed, sensor_sigma)
        odds = joint_odds(odds, tracks.observed, frozen)
        unseen = np.isinf(odds)
        anomaly = decimals(odds, self._calibration.limits(unseen.sum(axis=-1), sensor_sigma, pace(found.mean)))
        return anomaly.max(axis=-1), np.where(unseen, np.nan, anomaly)
