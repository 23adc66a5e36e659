"""The fault network as the live node runs it, `FaultNet` without torch, and its features, which training shares."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, FaultNetConfig
from steadypose.prior.models.layers.compiled_graph import Network, Program
from steadypose.prior.models.weights import Arrays, load_weights, part, weights_path

RECENT = 15
"""Newest frames of a window that are scored: a fault that has just begun must not be averaged with sound frames."""

OFF_SCALE = 0.02
"""Metres, unit of the residuals against HG-VAE, which enter by asinh: linear when small, logarithmic when large."""

ROUGH_SCALE = 0.003
"""Metres, unit of the RMS second difference of a track, which enters by its logarithm."""

SENSOR_SCALE = 0.01
"""Metres, unit of the sensor's error, which enters by its logarithm."""


def fault_features(
    x: NDArray[np.floating],
    reconstructed: NDArray[np.floating],
    sigma: NDArray[np.floating],
    observed: NDArray[np.floating],
    sensor_sigma: NDArray[np.floating] | float,
    mean: NDArray[np.floating],
) -> NDArray[np.float32]:
    """The input of `FaultNet`.

    Args:
        x: (B, 66, T) metres of a body of standard size, tracks; not read where not observed.
        reconstructed: (B, 66, T) metres, HG-VAE's mean.
        sigma: (B, 66, T) metres, HG-VAE's standard deviation.
        observed: (B, 66, T) more than 0 where observed.
        sensor_sigma: (B,) metres along an axis, total error of the sensor.
        mean: (66,) metres, of the network.

    Returns:
        (B, 66, 4 T + 2): a track, its residual against the reconstruction, HG-VAE's deviation, and what was observed;
        the RMS second difference of the newest frames (near 0 if a tracker repeats its output); the sensor's error.
    """
    count, tracks, frames = x.shape
    features = np.empty((count, tracks, 4 * frames + 2), dtype=np.float32)
    _write_features(x, reconstructed, sigma, observed, mean, features)
    features[..., -1] = np.reshape(np.log(np.asarray(sensor_sigma) / SENSOR_SCALE), (-1, 1))
    return features


@njit(cache=True)
def _write_features(x, reconstructed, sigma, observed, mean, features):
    count, tracks, frames = x.shape
    for b in range(count):
        for track in range(tracks):
            row = features[b, track]
            square, shown = 0.0, 0
            for t in range(frames):
                seen = observed[b, track, t] > 0
                row[t] = (x[b, track, t] - mean[track]) / SCALE if seen else 0.0
                row[frames + t] = math.asinh((x[b, track, t] - reconstructed[b, track, t]) / OFF_SCALE) if seen else 0.0
                row[2 * frames + t] = math.log(sigma[b, track, t] / OFF_SCALE)
                row[3 * frames + t] = 1.0 if seen else 0.0
                if (
                    t >= max(frames - RECENT, 2)
                    and seen
                    and observed[b, track, t - 1] > 0
                    and observed[b, track, t - 2] > 0
                ):
                    square += (x[b, track, t] - 2 * x[b, track, t - 1] + x[b, track, t - 2]) ** 2
                    shown += 1
            row[4 * frames] = 0.5 * math.log(square / max(shown, 1) / ROUGH_SCALE**2 + 1e-3)


class LiveFaultNet:
    """A trained `FaultNet`.

    Args:
        config: its sizes.
        weights: its state dict.
        max_batch: windows at once.
    """

    def __init__(self, config: FaultNetConfig, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean = weights["mean"].astype(np.float64)
        self._features = p.matrix(JOINT_NODES, 4 * config.frames + 2)
        self._odds = p.layer(p.trunk(self._features, weights), part(weights, "write"))
        self._net = Network(p, max_batch)

    @classmethod
    def load(cls, weights: str, max_batch: int) -> LiveFaultNet:
        """The one beside HG-VAE's weights of this name.

        Raises:
            FileNotFoundError: there is none; says which there are.
        """
        path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
        arrays, config = load_weights(str(path), "hgvae")
        return cls(FaultNetConfig.from_dict(config), arrays, max_batch)

    def __call__(
        self, x: Floats, reconstructed: Floats, sigma: Floats, observed: Floats, sensor_sigma: Floats
    ) -> Floats:
        """(B, 22) log-odds that a joint is faulty; the arguments are those of `fault_features`."""
        rows = slice(0, len(x))
        self._net.matrix(self._features, rows)[:] = fault_features(
            x, reconstructed, sigma, observed, sensor_sigma, self._mean
        )
        self._net.run(self._net.steps, rows)
        return self._net.matrix(self._odds, rows)[..., 0].astype(np.float64)
