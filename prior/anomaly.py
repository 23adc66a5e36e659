"""The score stage: how unlike human motion what was seen of a body is, and because of which joints.

A joint is odd when it was seen where HG-VAE would not have put it, or in a body of which the model no longer knows what
to think: its expected squared distance from where it was seen, bias and variance together, over the last half second.
(In units of the model's own deviation, exchanged limbs go unnoticed: it says that it is not sure.) The window is as odd
as its oddest joint. Both are told on one scale: the number of decimals of the rate at which clean motion of people whom
the model has not seen scores as high. An anomaly of 2 is met once in a hundred clean windows.

The paper scores by log p(z | x) alone (`steadypose evaluate hgvae` has both).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from prior.checkpoint import weights_path
from prior.encode import Encoded
from prior.window import FPS, Window

Floats = NDArray[np.float64]

RECENT = 15
"""Frames over which a joint's deviation is averaged: what is wrong now must not be watered down by what was right."""

MISSING = (0, 4, 8, 14)
"""Joints missing at which the scale was measured; between them it is interpolated."""

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
    """Oddity on validation motion, by joints missing and error of the sensor.

    Attributes:
        mean: (M, S, 22) of each joint's log deviation.
        spread: (M, S, 22) its standard deviation.
        quantiles: (M, S, R) of the window's score, at `RATES`.
    """

    mean: Floats
    spread: Floats
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
        content = json.loads(path.read_text())
        return cls(**{name: np.array(content[name]) for name in ("mean", "spread", "quantiles")})

    def save(self, path: Path, note: str) -> None:
        """Write as JSON."""
        values = {name: np.round(value, 4).tolist() for name, value in asdict(self).items()}
        path.write_text(json.dumps({"note": note, **values}) + "\n")

    def at(self, sensor_sigma: float) -> Calibration:
        """For one sensor: the same without the axis S."""
        place = np.interp(np.log(sensor_sigma), np.log(SENSOR_SIGMAS), np.arange(len(SENSOR_SIGMAS)))
        low = min(int(place), len(SENSOR_SIGMAS) - 2)
        share = place - low
        values = (self.mean, self.spread, self.quantiles)
        return Calibration(*((1 - share) * value[:, low] + share * value[:, low + 1] for value in values))


def deviations(x: Floats, mean: Floats, sigma: Floats, observed: NDArray[np.floating]) -> Floats:
    """(..., 22) logarithm of how far, squared, each joint seen is from where it is, as the model expects it: over the
    last `RECENT` frames; NaN if not seen.

    Args:
        x: (..., 66, T) metres, tracks seen.
        mean: (..., 66, T) what the model would put there, and
        sigma: (..., 66, T) how sure it is.
        observed: (..., 66, T) 1 where seen.
    """
    x, mean, sigma = (a[..., -RECENT:] for a in (x, mean, sigma))
    seen = observed[..., -RECENT:] > 0
    squared = np.where(seen, (x - mean) ** 2 + sigma**2, 0.0)
    joints = (*x.shape[:-2], 22, 3 * RECENT)
    count = seen.reshape(joints).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(squared.reshape(joints).sum(axis=-1) / count)


def oddities(logs: Floats, calibration: Calibration, missing: NDArray[np.integer]) -> Floats:
    """(..., 22) each joint's oddity as a z-score of clean motion; -inf where the joint was not seen."""
    weight = _between(missing)
    z = (logs - weight @ calibration.mean) / (weight @ calibration.spread)
    return np.where(np.isnan(z), -np.inf, z)


def decimals(score: Floats, calibration: Calibration, missing: NDArray[np.integer]) -> Floats:
    """(...) -log10 of the rate at which clean windows score at least so high."""
    quantiles = _between(missing) @ calibration.quantiles
    heights = -np.log10(RATES)
    place = np.sum(score[..., None] > quantiles, axis=-1)
    low = np.clip(place - 1, 0, len(RATES) - 2)[..., None]
    below, above = (np.take_along_axis(quantiles, low + k, axis=-1)[..., 0] for k in (0, 1))
    # beyond the rarest rate measured, the tail goes on as it went between the last two
    rising = (heights[low[..., 0] + 1] - heights[low[..., 0]]) / np.maximum(above - below, 1e-6)
    return np.maximum(heights[low[..., 0]] + rising * (score - below), 0.0)


def _between(missing: NDArray[np.integer]) -> Floats:
    """(..., M) weights of the two of `MISSING` on either side."""
    place = np.interp(missing, MISSING, np.arange(len(MISSING)))
    return np.maximum(1 - np.abs(place[..., None] - np.arange(len(MISSING))), 0.0)


class Score:
    """Writes ``window.anomaly``, ``window.joint_anomaly`` and, with hysteresis, ``window.anomaly_flag``."""

    delay_frames = 0

    def __init__(self, settings: ScoreSettings, weights: str, sensor_sigma: float, slots: int) -> None:
        if not 0 < settings.false_alarms < 1:
            raise ValueError(f"score.false_alarms: expected a share between 0 and 1, got {settings.false_alarms:g}")
        self._height = -np.log10(settings.false_alarms)
        self._hold = settings.hold
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
            window.anomaly[slots], window.joint_anomaly[slots] = self._score(window.encoded)
        with np.errstate(invalid="ignore"):
            self._quiet_s = np.where(window.anomaly > self._height / 2, 0.0, self._quiet_s + 1 / FPS)
            raised = window.anomaly > self._height
        window.anomaly_flag = raised | window.anomaly_flag & (self._quiet_s < self._hold)
        return window

    def _score(self, encoded: Encoded) -> tuple[Floats, Floats]:
        """The anomaly of each window (B,) and, on the same scale, of its joints (B, 22)."""
        logs = deviations(encoded.tracks.x, encoded.look.mean, encoded.look.sigma, encoded.tracks.observed)
        missing = np.isnan(logs).sum(axis=-1)
        odd = oddities(logs, self._calibration, missing)
        told = decimals(odd, self._calibration, np.broadcast_to(missing[:, None], odd.shape))
        return told.max(axis=-1), np.where(np.isinf(odd), np.nan, told)
