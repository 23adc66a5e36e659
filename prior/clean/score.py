"""The score stage: whether what was seen of a body can be trusted, and which joints cannot.

The fault network says of each joint how much more likely it is off than not; the window is as odd as its oddest joint.
Both are told on one scale: the number of decimals of the rate at which clean motion of people whom the networks have
not seen, as fast as this, scores as high. An anomaly of 2 is met once in a hundred clean windows.

A sensor or a person unlike those of validation scores higher all the time, and is not wrong all the time. So each body
has a scale of its own, from its last ten seconds (`OwnScale`), by which its anomaly is divided.

The paper scores by log p(z | x) alone (`steadypose evaluate hgvae` has both).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.clean.frame import BodyWindows, Bools, Floats, Score
from steadypose.prior.models.hgvae.anomaly import SENSOR_SIGMAS, Calibration, decimals, joint_odds, pace
from steadypose.prior.models.hgvae.fault_inference import LiveFaultNet
from steadypose.prior.timing.rate import FPS

MEAN_ANOMALY = 0.54
"""Mean anomaly that needs no scale. Were the scale of validation right for everybody, it would be 1 / ln 10 = 0.43."""

MOST_COUNTED = 2.0
"""What one frame counts in the mean at most: a fault of a second is not to be taken for the sensor's habit."""

MOST_SCALE = 2.0
"""A body that would need more than this is odd, not strange to us: a wrong skeleton, say."""

OWN_FRAMES, FIRST_FRAMES = 300, 30
"""Memory of the mean; and how many frames `MEAN_ANOMALY` counts for when a body is new."""

RELEASED = 0.8
"""Share of the flag's height under which the anomaly has to stay for the flag to go down."""


@dataclass(frozen=True)
class ScoreSettings:
    """When to raise the flag.

    Attributes:
        enabled: whether to score at all; off, the anomaly is NaN and the flag down.
        false_alarms: the share of frames of clean motion that may be flagged; 0.01 would be one every three seconds.
        hold: seconds that the anomaly must stay under `RELEASED` of the flag's height before the flag goes down.
    """

    enabled: bool = True
    false_alarms: float = 0.001
    hold: float = 0.3


class OwnScale:
    """How many times as high as validation's people each body scores when nothing is wrong: 1 to `MOST_SCALE`.

    Its anomaly over validation's would have an exponential distribution; a mean so many times as large stands for
    quantiles as many times as high.
    """

    def __init__(self, slots: int) -> None:
        self._mean = np.full(slots, MEAN_ANOMALY)
        self._frames = np.full(slots, FIRST_FRAMES)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mean[slot], self._frames[slot] = MEAN_ANOMALY, FIRST_FRAMES

    def update(self, slots: NDArray[np.intp], anomaly: Floats) -> Floats:
        """(B,) scales of the bodies in ``slots`` (B,) before this frame, whose ``anomaly`` (B,) is taken in."""
        scale = np.clip(self._mean[slots] / MEAN_ANOMALY, 1.0, MOST_SCALE)
        self._frames[slots] = np.minimum(self._frames[slots] + 1, OWN_FRAMES)
        self._mean[slots] += (np.minimum(anomaly, MOST_COUNTED) - self._mean[slots]) / self._frames[slots]
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

        ``sensor_sigma`` (S,) metres along an axis is the error found of what is seen of each body: one that is met all
        the time is no fault.
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
        sensor_sigma = np.clip(sensor_sigma, SENSOR_SIGMAS[0], SENSOR_SIGMAS[-1])  # of which the network was told
        odds = self._network(tracks.x, found.mean, found.sigma, tracks.observed, sensor_sigma)
        odds = joint_odds(odds, tracks.observed, frozen)
        unseen = np.isinf(odds)
        told = decimals(odds, self._calibration.limits(unseen.sum(axis=-1), sensor_sigma, pace(found.mean)))
        return told.max(axis=-1), np.where(unseen, np.nan, told)
