"""The scale on which windows and joints are told to be odd.

The fault network says of each joint how much more likely it is off than not; the window is as odd as its oddest joint.
Both are told on one scale: the number of decimals of the rate at which clean motion of people whom the networks have
not seen, as fast as this, scores as high. An anomaly of 2 is met once in a hundred clean windows.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.fault_features import RECENT
from steadypose.prior.models.weights_io import weights_path
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]

MISSING = (0, 4, 8, 14)
"""Joints missing at which the scale was measured; between them it is interpolated."""

FROZEN_ODDS = 12.0
"""of a joint of which the last answer is repeated while the others shake, logarithm"""

SENSOR_SIGMAS = (0.003, 0.01, 0.02, 0.04)
"""Metres along an axis, errors of the sensor at which the scale was measured."""

PACES, PACE_EDGES = (0.03, 0.5, 1.5), (0.274, 0.866)
"""m/s, of `pace`: what windows of three classes move at about, and what divides these. Standing is most of any
recording; what is fast is rare in any training, and no fault for that."""

RATES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""of clean windows that score higher than the quantiles kept"""


@dataclass(frozen=True)
class Calibration:
    """What clean windows score, by joints missing, error of the sensor and pace of the motion.

    Attributes:
        quantiles: (M, S, P, R) of the window's score, at `MISSING`, `SENSOR_SIGMAS`, `PACES` and `RATES`.
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

    def limits(self, missing: NDArray[np.integer], sensor_sigma: Floats, paces: Floats) -> Floats:
        """(B, R) what clean windows score at `RATES`, interpolated between what was measured.

        Args:
            missing: (B,) joints missing.
            sensor_sigma: (B,) metres along an axis, error of the sensor.
            paces: (B,) m/s, `pace`.
        """
        by_missing = _between(np.asarray(missing, dtype=np.float64), np.array(MISSING, dtype=np.float64))
        by_sensor = _between(np.log(sensor_sigma), np.log(SENSOR_SIGMAS))
        by_pace = _between(np.log(np.maximum(paces, 1e-3)), np.log(PACES))
        return np.einsum("bm,bs,bp,mspr->br", by_missing, by_sensor, by_pace, self.quantiles)


def pace(mean: Floats) -> Floats:
    """(B,) m/s, above which a quarter of the joints move, by windows' tracks (B, 66, T) as HG-VAE makes them.

    Root mean square over the window. A limb at fault does not show in it, nor does a sensor's noise.
    """
    steps = np.diff(mean.reshape(len(mean), -1, 3, mean.shape[-1]), axis=-1) * FPS
    return np.quantile(np.sqrt((steps**2).sum(axis=2).mean(axis=-1)), 0.75, axis=1)


def joint_odds(odds: Floats, observed: Floats, frozen: NDArray[np.bool_]) -> Floats:
    """(B, 22) what a fault network says, -inf of joints not seen in the frames that are scored.

    Args:
        odds: (B, 22) of `FaultNet`.
        observed: (B, 66, T) more than 0 where seen.
        frozen: (B, 22) joints of which the sensor repeats its last answer.
    """
    seen = (observed[:, ::3, -RECENT:] > 0).any(axis=-1)
    return np.where(seen, np.where(frozen, np.maximum(odds, FROZEN_ODDS), odds), -np.inf)


def decimals(score: Floats, limits: Floats) -> Floats:
    """-log10 of the rate at which clean windows score at least so high.

    Args:
        score: (B, K) of windows or of their joints.
        limits: (B, R) of `Calibration.limits`.
    """
    told = np.empty(score.shape)
    _decimals(score, limits, -np.log10(RATES), told)
    return told


def _between(value: Floats, knots: Floats) -> Floats:
    """(B, K) weights of the two of ``knots`` on either side of each value (B,); the ends go on."""
    place = np.interp(value, knots, np.arange(len(knots)))
    return np.maximum(1 - np.abs(place[:, None] - np.arange(len(knots))), 0.0)


@njit(cache=True)
def _decimals(score, quantiles, heights, told):
    for row in range(len(score)):
        limits = quantiles[row]
        for k in range(score.shape[1]):
            below = 0
            for limit in range(len(limits)):
                below += score[row, k] > limits[limit]
            low = min(max(below - 1, 0), len(limits) - 2)
            # beyond the rarest rate measured, the tail goes on as it went between the last two
            rising = (heights[low + 1] - heights[low]) / max(limits[low + 1] - limits[low], 1e-6)
            told[row, k] = max(heights[low] + rising * (score[row, k] - limits[low]), 0.0)
