"""The score stage: whether what was seen of a body can be trusted, and which joints cannot.

The fault network says of each joint how much more likely it is off than not; the window is as odd as its oddest joint.
Both are told on one scale: the number of decimals of the rate at which clean motion of people whom the networks have
not seen scores as high. An anomaly of 2 is met once in a hundred clean windows.

The paper scores by log p(z | x) alone (`steadypose evaluate hgvae` has both).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Window
from steadypose.prior.clean.reconstruct import Encoded
from steadypose.prior.models.hgvae.anomaly import Calibration, decimals, judged
from steadypose.prior.models.hgvae.fault_inference import LiveFaultNet
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ScoreSettings:
    """When to raise the flag.

    Attributes:
        enabled: whether to score at all; off, the anomaly is NaN and the flag down.
        false_alarms: the share of frames of clean motion that may be flagged; 0.01 would be one every three seconds.
        hold: seconds that the anomaly must stay at half the flag's height or lower before the flag goes down.
    """

    enabled: bool = True
    false_alarms: float = 0.001
    hold: float = 0.3


class Score:
    """Writes ``window.anomaly``, ``window.joint_anomaly`` and, with hysteresis, ``window.anomaly_flag``."""

    delay_frames = 0

    def __init__(self, settings: ScoreSettings, weights: str, sensor_sigma: float, slots: int) -> None:
        if not 0 < settings.false_alarms < 1:
            raise ValueError(f"score.false_alarms: expected a share between 0 and 1, got {settings.false_alarms:g}")
        self._height = -np.log10(settings.false_alarms)
        self._hold = settings.hold
        self._network = LiveFaultNet.load(weights, sensor_sigma, slots)
        self._calibration = Calibration.load(weights).at(sensor_sigma)
        self._quiet_s = np.full(slots, np.inf)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        self._quiet_s[slot] = np.inf

    def update(self, window: Window) -> Window:
        """Score the newest window of each body."""
        window.anomaly[:], window.joint_anomaly[:] = np.nan, np.nan
        if window.encoded:
            slots = window.encoded.slots
            window.anomaly[slots], window.joint_anomaly[slots] = self._score(window.encoded, window.stuck[slots])
        with np.errstate(invalid="ignore"):
            self._quiet_s = np.where(window.anomaly > self._height / 2, 0.0, self._quiet_s + 1 / FPS)
            raised = window.anomaly > self._height
        window.anomaly_flag = raised | window.anomaly_flag & (self._quiet_s < self._hold)
        return window

    def _score(self, encoded: Encoded, stuck: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """The anomaly of each window (B,) and, on the same scale, of its joints (B, 22); some are known to be stuck."""
        tracks, look = encoded.tracks, encoded.look
        odds = self._network(tracks.x, look.mean, look.sigma, tracks.observed)
        odds = judged(odds, tracks.observed, stuck)
        unseen = np.isinf(odds)
        told = decimals(odds, self._calibration, unseen.sum(axis=-1))
        return told.max(axis=-1), np.where(unseen, np.nan, told)
