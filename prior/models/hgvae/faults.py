"""Live inference of the fault network (`FaultNet`) without torch, its features, and the calibration of its scores.

`prior.clean.score` describes the scores and the anomaly.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.compiled_graph import Network, Program
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, FaultNetConfig
from steadypose.prior.models.weights import Arrays, load_weights, part, weights_path
from steadypose.prior.timing.rate import FPS

RECENT = 15
"""Number of the newest frames of a window that are scored, so that clean frames do not hide a fault that just began."""

OFF_SCALE = 0.02
"""Unit of the residuals against HG-VAE, metres. They enter by asinh: linear if small, logarithmic if large."""

ROUGH_SCALE = 0.003  # unit of the RMS second difference of a track, which enters by its logarithm, metres
SENSOR_SCALE = 0.01  # unit of the sensor's error, which enters by its logarithm, metres

MISSING = (0, 4, 8, 14)
"""Numbers of missing joints at which the calibration was measured; it is interpolated between them."""

FROZEN_ODDS = 12.0  # log odds of a joint whose last position the sensor repeats while the others jitter
SENSOR_SIGMAS = (0.003, 0.01, 0.02, 0.04)  # sensor errors along an axis at which the calibration was measured, metres

PACES, PACE_EDGES = (0.03, 0.5, 1.5), (0.274, 0.866)
"""Typical values of `pace` in three classes of windows, and the edges between the classes, m/s. In most windows of a
recording people stand. Fast motion is rare in training and would score high for that reason alone."""

RATES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
"""Rates at which clean windows score higher than the stored quantiles."""


def fault_features(
    x: NDArray[np.floating],
    reconstructed: NDArray[np.floating],
    sigma: NDArray[np.floating],
    observed: NDArray[np.floating],
    sensor_sigma: NDArray[np.floating] | float,
    mean: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Build the input of `FaultNet`.

    Args:
        x: (B, 66, T) metres of a body of standard size, tracks; ignored where unobserved.
        reconstructed: (B, 66, T) metres, HG-VAE's mean.
        sigma: (B, 66, T) metres, HG-VAE's standard deviation.
        observed: (B, 66, T) more than 0 where observed.
        sensor_sigma: (B,) metres along an axis, total error of the sensor.
        mean: (66,) metres, the network's training mean.

    Returns:
        (B, 66, 4 T + 2): the track, its residual against the reconstruction, HG-VAE's deviation, and the observed mask;
        the RMS second difference of the newest frames (near 0 if a tracker repeats its output); the sensor's error.
    """
    count, tracks, frames = x.shape
    features, seen = np.empty((count, tracks, 4 * frames + 2), dtype=np.float32), observed > 0
    features[..., :frames] = np.where(seen, (x - mean[:, None]) / SCALE, 0.0)
    features[..., frames : 2 * frames] = np.arcsinh(np.where(seen, (x - reconstructed) / OFF_SCALE, 0.0))
    features[..., 2 * frames : 3 * frames] = np.log(sigma / OFF_SCALE)
    features[..., 3 * frames : -2] = seen
    newest, last = x[..., -RECENT - 2 :], seen[..., -RECENT - 2 :]
    shown = last[..., 2:] & last[..., 1:-1] & last[..., :-2]
    rough = np.where(shown, newest[..., 2:] - 2 * newest[..., 1:-1] + newest[..., :-2], 0.0)
    square = np.square(rough).sum(axis=-1) / np.maximum(shown.sum(axis=-1), 1)
    features[..., -2] = 0.5 * np.log(square / ROUGH_SCALE**2 + 1e-3)
    features[..., -1] = np.reshape(np.log(np.asarray(sensor_sigma) / SENSOR_SCALE), (-1, 1))
    return features


class LiveFaultNet:
    """A trained `FaultNet` for at most ``max_batch`` windows per call."""

    def __init__(self, config: FaultNetConfig, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean = weights["mean"].astype(np.float64)
        self._features = p.matrix(JOINT_NODES, 4 * config.frames + 2)
        self._odds = p.layer(p.trunk(self._features, weights), part(weights, "write"))
        self._net = Network(p, max_batch)

    @classmethod
    def load(cls, weights: str, max_batch: int) -> LiveFaultNet:
        """Load the fault network that belongs to HG-VAE's weights of this name.

        Raises:
            FileNotFoundError: there is none; the message lists those that exist.
        """
        path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
        arrays, config = load_weights(str(path), "hgvae")
        return cls(FaultNetConfig.from_dict(config), arrays, max_batch)

    def __call__(
        self, x: Floats, reconstructed: Floats, sigma: Floats, observed: Floats, sensor_sigma: Floats
    ) -> Floats:
        """Return log odds (B, 22) that a joint is faulty; arguments as in `fault_features`."""
        rows = slice(0, len(x))
        self._net.matrix(self._features, rows)[:] = fault_features(
            x, reconstructed, sigma, observed, sensor_sigma, self._mean
        )
        self._net.run(rows)
        return self._net.matrix(self._odds, rows)[..., 0].astype(np.float64)


@dataclass(frozen=True)
class Calibration:
    """Scores of clean windows, by missing joints, sensor error and pace."""

    quantiles: Floats  # (M, S, P, R) quantiles of the window's score at `MISSING`, `SENSOR_SIGMAS`, `PACES` and `RATES`

    @classmethod
    def load(cls, weights: str) -> Calibration:
        """Load the calibration that belongs to these weights.

        Raises:
            FileNotFoundError: there is none; the message says how to make it.
        """
        path = weights_path(weights, "hgvae").with_suffix(".anomaly.json")
        if not path.is_file():
            raise FileNotFoundError(f"no {path.name} beside the weights: 'steadypose train hgvae' makes both")
        return cls(np.array(json.loads(path.read_text())["quantiles"]))

    def save(self, path: Path, note: str) -> None:
        """Write as JSON."""
        path.write_text(json.dumps({"note": note, "quantiles": np.round(self.quantiles, 4).tolist()}) + "\n")

    def limits(self, missing: NDArray[np.integer], sensor_sigma: Floats, paces: Floats) -> Floats:
        """Return the scores (B, R) of clean windows at `RATES`, interpolated between the measured conditions: numbers
        of missing joints (B,), errors of the sensor (B,) metres along an axis, and `pace`s (B,) m/s."""
        by_missing = _interpolation_weights(np.asarray(missing, dtype=np.float64), np.array(MISSING, dtype=np.float64))
        by_sensor = _interpolation_weights(np.log(sensor_sigma), np.log(SENSOR_SIGMAS))
        by_pace = _interpolation_weights(np.log(np.maximum(paces, 1e-3)), np.log(PACES))
        return np.einsum("bm,bs,bp,mspr->br", by_missing, by_sensor, by_pace, self.quantiles)


def pace(mean: Floats) -> Floats:
    """(B,) m/s, upper quartile of the joints' RMS speeds in tracks (B, 66, T) reconstructed by HG-VAE.

    Neither a single faulty limb nor the sensor's noise changes it much.
    """
    steps = np.diff(mean.reshape(len(mean), -1, 3, mean.shape[-1]), axis=-1) * FPS
    speeds = np.sort(np.sqrt((steps**2).sum(axis=2).mean(axis=-1)), axis=1)
    # equals numpy.quantile, which takes a quarter of a millisecond: for 22 joints, between the 16th and the 17th
    place, share = divmod(0.75 * (speeds.shape[1] - 1), 1.0)
    low, high = speeds[:, int(place)], speeds[:, int(place) + 1]
    return high - (high - low) * (1.0 - share)


def joint_odds(odds: Floats, observed: Floats, frozen: NDArray[np.bool_]) -> Floats:
    """Adjust the fault network's log odds (B, 22) for frozen joints (B, 22), whose last position the sensor repeats;
    -inf for joints that are not observed (B, 66, T) in the scored frames."""
    seen = (observed[:, ::3, -RECENT:] > 0).any(axis=-1)
    return np.where(seen, np.where(frozen, np.maximum(odds, FROZEN_ODDS), odds), -np.inf)


def decimals(score: Floats, limits: Floats) -> Floats:
    """Return -log10 of the rate at which clean windows score at least as high as ``score`` (B, K), by limits (B, R) of
    `Calibration.limits`."""
    anomaly = np.empty(score.shape)
    _decimals(score, limits, -np.log10(RATES), anomaly)
    return anomaly


def _interpolation_weights(value: Floats, knots: Floats) -> Floats:
    """(B, K) linear interpolation weights of ``knots`` for each value (B,); values beyond the ends take the end's."""
    place = np.interp(value, knots, np.arange(len(knots)))
    return np.maximum(1 - np.abs(place[:, None] - np.arange(len(knots))), 0.0)


@njit(cache=True)
def _decimals(score, quantiles, heights, anomaly):
    for row in range(len(score)):
        limits = quantiles[row]
        for k in range(score.shape[1]):
            below = 0
            for limit in range(len(limits)):
                below += score[row, k] > limits[limit]
            low = min(max(below - 1, 0), len(limits) - 2)
            # beyond the lowest measured rate, extrapolate the tail from the last two
            rising = (heights[low + 1] - heights[low]) / max(limits[low + 1] - limits[low], 1e-6)
            anomaly[row, k] = max(heights[low] + rising * (score[row, k] - limits[low]), 0.0)
