"""The score stage: whether the observations of a body can be trusted, and which joints cannot.

The fault network gives each joint's log odds of being at fault; a window's score is the highest of its joints'. Both
are expressed as an anomaly: -log10 of the rate at which clean windows of people unseen in training, of the same pace,
score at least as high. An anomaly of 2 occurs in one of a hundred clean windows.

Sensors and people unlike those of validation score higher throughout, without being at fault throughout. So each body's
anomaly is divided by a scale estimated from its own last ten seconds (`OwnScale`).

The paper scores by log p(z | x) alone (`steadypose evaluate hgvae` has both).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import BodyWindows, Score
from steadypose.prior.models.hgvae.faults import SENSOR_SIGMAS, Calibration, LiveFaultNet, decimals, joint_odds, pace
from steadypose.prior.timing.rate import FPS

MEAN_ANOMALY = 0.54
"""Mean anomaly at which the scale is 1. Of a body that follows validation's distribution it would be 1 / ln 10 = 0.43;
chosen on validation (benchmarks/NOTEBOOK.md)."""

MAX_COUNTED = 2.0
"""At which a frame's anomaly is clipped in the mean, so that a fault of a second hardly changes it."""

MAX_SCALE = 2.0
"""The largest scale: a body that would need more, such as one with a wrong skeleton, is to be flagged."""

OWN_FRAMES, FIRST_FRAMES = 300, 30
"""Frames of the running mean; and for how many `MEAN_ANOMALY` counts when a body is new."""

RELEASED = 0.8
"""Fraction of the flag's threshold below which the anomaly has to stay for the flag to be cleared."""


@dataclass(frozen=True)
class ScoreSettings:
    """Settings of the score stage.

    Attributes:
        enabled: whether to score at all; off, the anomaly is NaN and the flag down.
        false_alarms: the share of frames of clean motion that may be flagged; 0.01 would be one every three seconds.
        hold: seconds that the anomaly must stay under `RELEASED` of the flag's height before the flag goes down.
    """

    enabled: bool = True
    false_alarms: float = 0.001
    hold: float = 0.3


class OwnScale:
    """The scale of each body's anomaly: how many times as high as validation's it is on average, 1 to `MAX_SCALE`.

    If the calibration holds, an anomaly is distributed exponentially, so that a mean k times as large stands for
    quantiles k times as large.
    """

    def __init__(self, slots: int) -> None:
        self._mean = np.full(slots, MEAN_ANOMALY)
        self._frames = np.full(slots, FIRST_FRAMES)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mean[slot], self._frames[slot] = MEAN_ANOMALY, FIRST_FRAMES

    def update(self, slots: NDArray[np.intp], anomaly: Floats) -> Floats:
        """(B,) scales of the bodies ``slots`` (B,) as of the frame before; then ``anomaly`` (B,) enters the means."""
        scale = np.clip(self._mean[slots] / MEAN_ANOMALY, 1.0, MAX_SCALE)
        self._frames[slots] = np.minimum(self._frames[slots] + 1, OWN_FRAMES)
        self._mean[slots] += (np.fmin(anomaly, MAX_COUNTED) - self._mean[slots]) / self._frames[slots]
        return scale


class Scorer:
    """Scores the newest window of each body, and raises the flag with hysteresis."""

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

    def update(self, windows: BodyWindows | None, frozen: Bools, sensor_sigma: Floats) -> Score:
        """The score of the newest frame, in which the joints ``frozen`` (S, 22) repeat themselves.

        ``sensor_sigma`` (S,) metres along an axis is the estimated error of each body's observations.
        """
        anomaly, joint_anomaly = np.full(len(frozen), np.nan), np.full(frozen.shape, np.nan)
        if windows is not None:
            slots = windows.slots
            oddest, joints = self._score(windows, frozen[slots], sensor_sigma[slots])
            scale = self._scale.update(slots, oddest)
            anomaly[slots], joint_anomaly[slots] = oddest / scale, joints / scale[:, None]
        with np.errstate(invalid="ignore"):
            self._quiet_s = np.where(anomaly > RELEASED * self._height, 0.0, self._quiet_s + 1 / FPS)
            raised = anomaly > self._height
        self._flag = raised | self._flag & (self._quiet_s < self._hold)
        return Score(anomaly, self._flag, joint_anomaly)

    def _score(self, windows: BodyWindows, frozen: Bools, sensor_sigma: Floats) -> tuple[Floats, Floats]:
        """The anomaly of each window (B,), on the scale of validation's people, and of its joints (B, 22)."""
        tracks, found = windows.tracks, windows.reconstruction
        sensor_sigma = np.clip(sensor_sigma, SENSOR_SIGMAS[0], SENSOR_SIGMAS[-1])  # the range it was trained on
        odds = self._network(tracks.x, found.mean, found.sigma, tracks.observed, sensor_sigma)
        odds = joint_odds(odds, tracks.observed, frozen)
        unseen = np.isinf(odds)
        anomaly = decimals(odds, self._calibration.limits(unseen.sum(axis=-1), sensor_sigma, pace(found.mean)))
        return anomaly.max(axis=-1), np.where(unseen, np.nan, anomaly)
