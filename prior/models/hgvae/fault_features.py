"""What the fault network reads of a window, in training and live: compiled loops, shared by both."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.config import SCALE

RECENT = 15
"""Frames that are scored: what is wrong now must not be watered down by what was right."""

OFF_SCALE = 0.02
"""Metres: residuals against HG-VAE are given in these, large values by their logarithm."""

ROUGH_SCALE = 0.003
"""Metres: how rough a track is, is given in these, by its logarithm."""

SENSOR_SCALE = 0.01
"""Metres, of the sensor's error, given by its logarithm."""


def fault_features(
    x: NDArray[np.floating],
    found: NDArray[np.floating],
    sigma: NDArray[np.floating],
    observed: NDArray[np.floating],
    sensor_sigma: NDArray[np.floating] | float,
    mean: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Windows as `FaultNet` reads them.

    Args:
        x: (B, 66, T) metres of a standard body, tracks seen; not read where there is nothing observed.
        found: (B, 66, T) metres, what HG-VAE makes of them.
        sigma: (B, 66, T) metres, how sure HG-VAE is.
        observed: (B, 66, T) more than 0 where seen.
        sensor_sigma: (B,) metres along an axis, what the sensor may be off by.
        mean: (66,) metres, of the network.

    Returns:
        (B, 66, 4 T + 2): where a track was seen, how far that is off, how sure HG-VAE is, what was seen; how much the
        last frames of the track shake (a tracker that holds its last answer does not); the sensor's error.
    """
    count, tracks, frames = x.shape
    features = np.empty((count, tracks, 4 * frames + 2), dtype=np.float32)
    _write_features(x, found, sigma, observed, mean, features)
    features[..., -1] = np.reshape(np.log(np.asarray(sensor_sigma) / SENSOR_SCALE), (-1, 1))
    return features


@njit(cache=True)
def _write_features(x, found, sigma, observed, mean, features):
    count, tracks, frames = x.shape
    for b in range(count):
        for track in range(tracks):
            row = features[b, track]
            square, shown = 0.0, 0
            for t in range(frames):
                seen = observed[b, track, t] > 0
                row[t] = (x[b, track, t] - mean[track]) / SCALE if seen else 0.0
                row[frames + t] = math.asinh((x[b, track, t] - found[b, track, t]) / OFF_SCALE) if seen else 0.0
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
