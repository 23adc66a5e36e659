"""The score stage: whether what was seen of a body can be trusted, and which joints cannot.

The fault network says of each joint how much more likely it is off than not; the window is as odd as its oddest joint.
Both are told on one scale: the number of decimals of the rate at which clean motion of people whom the networks have
not seen scores as high. An anomaly of 2 is met once in a hundred clean windows.

The paper scores by log p(z | x) alone (`steadypose evaluate hgvae` has both).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Window
from steadypose.prior.clean.reconstruct import Encoded
from steadypose.prior.models.hgvae.fault_inference import LiveFaultNet
from steadypose.prior.models.hgvae.faults import RECENT, FaultNet, FaultNetConfig
from steadypose.prior.models.weights_io import load_weights, weights_path
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]

MISSING = (0, 4, 8, 14)
"""Joints missing at which the scale was measured; between them it is interpolated."""

STUCK_ODDS = 12.0
"""of a joint of which the last answer is repeated while the others shake, logarithm"""

SENSOR_SIGMAS = (0.003, 0.01, 0.02, 0.04)
"""Metres along an axis, errors of the sensor at which the scale was measured."""

RATES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
"""of clean windows that score higher than the quantiles kept"""


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


@dataclass(frozen=True)
class Calibration:
    """What clean windows score, by joints missing and error of the sensor.

    Attributes:
        quantiles: (M, S, R) of the window's score, at `RATES`.
    """

    quantiles: Floats

    @classmethod
    def load(cls, weights: str) -> Calibration:
        """The calibration that belongs to these weights.

        Raises:
            FileNotFoundError: there is none; says how to make it.
        """
        path = weights_path(weights, "hgvae").with_suffix(".anomaly.json")
        if not path.is_file():
            raise FileNotFoundError(f"no {path.name} beside the weights: 'steadypose train hgvae' makes both")
        return cls(np.array(json.loads(path.read_text())["quantiles"]))

    def save(self, path: Path, note: str) -> None:
        """Write as JSON."""
        path.write_text(json.dumps({"note": note, "quantiles": np.round(self.quantiles, 4).tolist()}) + "\n")

    def at(self, sensor_sigma: float) -> Calibration:
        """For one sensor: the same without the axis S."""
        place = np.interp(np.log(sensor_sigma), np.log(SENSOR_SIGMAS), np.arange(len(SENSOR_SIGMAS)))
        low = min(int(place), len(SENSOR_SIGMAS) - 2)
        share = place - low
        return Calibration((1 - share) * self.quantiles[:, low] + share * self.quantiles[:, low + 1])


def load_fault_net(weights: str) -> FaultNet:
    """The fault network beside HG-VAE's weights of this name."""
    path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
    state, config = load_weights(str(path), "hgvae")
    network = FaultNet(FaultNetConfig.from_dict(config))
    network.load_state_dict(state)
    return network.eval()


def judged(odds: Floats, observed: Floats, stuck: NDArray[np.bool_]) -> Floats:
    """(B, 22) what a fault network says, -inf of joints not seen in the frames that are scored.

    Args:
        odds: (B, 22) of `FaultNet`.
        observed: (B, 66, T) more than 0 where seen.
        stuck: (B, 22) joints of which the sensor repeats its last answer.
    """
    seen = (observed[:, ::3, -RECENT:] > 0).any(axis=-1)
    return np.where(seen, np.where(stuck, np.maximum(odds, STUCK_ODDS), odds), -np.inf)


def decimals(score: Floats, calibration: Calibration, missing: NDArray[np.integer]) -> Floats:
    """-log10 of the rate at which clean windows score at least so high.

    Args:
        score: (B, K) of windows or of their joints.
        calibration: for the sensor.
        missing: (B,) joints of each window.
    """
    told = np.empty(score.shape)
    _decimals(score, _between(missing) @ calibration.quantiles, -np.log10(RATES), told)
    return told


def _between(missing: NDArray[np.integer]) -> Floats:
    """(B, M) weights of the two of `MISSING` on either side."""
    place = np.interp(missing, MISSING, np.arange(len(MISSING)))
    return np.maximum(1 - np.abs(place[:, None] - np.arange(len(MISSING))), 0.0)


@njit(cache=True)
def _decimals(score, quantiles, heights, told):
    for row in range(len(score)):
        limits = quantiles[row]
        for k in range(score.shape[1]):
            low = min(max((score[row, k] > limits).sum() - 1, 0), len(limits) - 2)
            # beyond the rarest rate measured, the tail goes on as it went between the last two
            rising = (heights[low + 1] - heights[low]) / max(limits[low + 1] - limits[low], 1e-6)
            told[row, k] = max(heights[low] + rising * (score[row, k] - limits[low]), 0.0)


class Score:
    """Writes ``window.anomaly``, ``window.joint_anomaly`` and, with hysteresis, ``window.anomaly_flag``."""

    delay_frames = 0

    def __init__(self, settings: ScoreSettings, weights: str, sensor_sigma: float, slots: int) -> None:
        if not 0 < settings.false_alarms < 1:
            raise ValueError(f"score.false_alarms: expected a share between 0 and 1, got {settings.false_alarms:g}")
        self._height = -np.log10(settings.false_alarms)
        self._hold = settings.hold
        self._network = LiveFaultNet(load_fault_net(weights), sensor_sigma, slots)
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
