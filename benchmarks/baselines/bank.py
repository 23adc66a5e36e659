"""A peer without parameters to tune: the static multiple-model estimate of constant-velocity fixed-lag smoothers.

(Bar-Shalom, Li and Kirubarajan 2001, section 11.6.) For each joint, a smoother's weight is the likelihood of its
innovations over the last 0.3 s. The measurement noise is estimated from third differences, in which motion is small:
their median over the last second, half of it (in logarithm) shared by the joints of a body.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from steadypose.benchmarks.baselines.kalman import smooth
from steadypose.prior.arrays import Floats

DENSITIES = (0.05, 0.3, 1.8, 10.0, 60.0)
"""m²/s³"""

_RECENT, _NOISE_FRAMES = 9, 30
_MIN_NOISE, _FIRST_NOISE = 1e-4, 0.01
"""metres, lower bound of the estimated noise, and its value before there are four observations"""
_MEDIAN_NORM = 1.538
"""Median length of a normal vector in space with a standard deviation of 1 along each axis."""
_THIRD = np.sqrt(20.0)
"""Standard deviation of the third difference of white noise."""


def bank(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Each frame's estimate, given the measurements up to ``delay`` frames later (those there are, at the end).

    Args:
        seen: (T, ..., J, 3) metres, NaN where missing; J joints of a body.
        stamps_s: (T,) seconds.
        delay: frames.
    """
    frames, joints = len(seen), seen.shape[1:-1]
    sigma = noise_found(seen)
    found = [smooth(seen, stamps_s, delay, 2, density, sigma) for density in DENSITIES]
    past = np.cumsum([f.log_likelihood for f in found], axis=1)
    past[:, _RECENT:] -= past[:, :-_RECENT].copy()
    log_likelihood = past[:, np.minimum(np.arange(frames) + delay, frames - 1)]
    weights = np.exp(log_likelihood - log_likelihood.max(axis=0))
    weights /= weights.sum(axis=0)
    mixed = sum(w[..., None] * f.positions for w, f in zip(weights, found, strict=True))
    return np.asarray(mixed).reshape(frames, *joints, 3)


def noise_found(seen: Floats) -> Floats:
    """(T, ..., J) metres along an axis, noise estimated from the input up to each frame."""
    third = np.full(seen.shape[:-1], np.nan)
    third[3:] = np.linalg.norm(np.diff(seen, n=3, axis=0), axis=-1)
    padded = np.concatenate([np.full((_NOISE_FRAMES - 1, *third.shape[1:]), np.nan), third])
    window = np.sort(sliding_window_view(padded, _NOISE_FRAMES, axis=0), axis=-1)  # NaN last
    count = np.isfinite(window).sum(axis=-1, keepdims=True)
    median = np.take_along_axis(window, np.maximum(count - 1, 0) // 2, axis=-1)[..., 0]
    log = np.log(np.maximum(median / _MEDIAN_NORM / _THIRD, _MIN_NOISE))
    known = np.isfinite(log)
    of_body = np.where(known, log, 0.0).sum(axis=-1, keepdims=True)
    of_body = np.where(
        known.any(axis=-1, keepdims=True),
        of_body / np.maximum(known.sum(axis=-1, keepdims=True), 1),
        np.log(_FIRST_NOISE),
    )
    return np.exp(0.5 * np.where(known, log, of_body) + 0.5 * of_body)
