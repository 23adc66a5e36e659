"""Kalman filters of a constant derivative with fixed-lag Rauch-Tung-Striebel smoothing, for whole clips at once.

Written for comparison, as the textbook has it (Bar-Shalom, Li and Kirubarajan 2001, sections 6.2 and 8.6): a forward
pass, then one backward sweep for each frame of lag, over all frames together.
"""

from __future__ import annotations

from math import factorial

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_UNKNOWN = (1e3, 1.0, 5.0)
"""Standard deviations of a joint never seen: metres, m/s, m/s²."""


def transition(order: int, step: float) -> Floats:
    """(n, n) state transition over ``step`` seconds: Taylor's series."""
    return np.array(
        [[step ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in range(order)] for i in range(order)]
    )


def process_noise(order: int, step: float) -> Floats:
    """(n, n) covariance that white noise of unit density on the last derivative adds in ``step`` seconds."""
    ahead = [order - 1 - i for i in range(order)]
    return np.array([[step ** (a + b + 1) / (factorial(a) * factorial(b) * (a + b + 1)) for b in ahead] for a in ahead])


def fixed_lag(
    seen: Floats, stamps_s: Floats, delay: int, order: int, density: float, measurement_sigma: float = 0.02
) -> Floats:
    """Each frame's estimate, given the measurements up to ``delay`` frames later (those there are, at the end).

    Args:
        seen: (T, ..., 3) metres, NaN where missing.
        stamps_s: (T,) seconds.
        delay: frames.
        order: 2 for constant velocity, 3 for constant acceleration.
        density: power spectral density of the noise on the derivative after that: m²/s³ for 2, m²/s⁵ for 3.
        measurement_sigma: metres.

    Returns:
        (T, ..., 3); NaN where a joint had not been seen by then.
    """
    frames = len(seen)
    z = seen.reshape(frames, -1, 3)
    known = np.asarray(np.isfinite(z).all(axis=-1))
    # Covariances depend on when a joint was seen, not on where: joints seen at the same times share them.
    patterns, which = np.unique(known, axis=1, return_inverse=True)
    steps = np.diff(stamps_s)
    gains, backward = _gains(patterns, steps, order, density, measurement_sigma)
    state = np.zeros((order, z.shape[1], 3))
    filtered, predicted = np.empty((frames, *state.shape)), np.empty((frames, *state.shape))
    for t in range(frames):
        if t:
            state = np.tensordot(transition(order, steps[t - 1]), state, axes=1)
        predicted[t] = state
        innovation = np.where(known[t, :, None], z[t] - state[0], 0.0)
        filtered[t] = state = state + gains[t].T[:, which, None] * innovation
    smoothed = filtered
    for _ in range(min(delay, frames - 1)):
        correction = smoothed[1:] - predicted[1:]
        moved = [
            filtered[:-1, i] + sum(backward[:, which, i, j, None] * correction[:, j] for j in range(order))
            for i in range(order)
        ]
        smoothed = np.concatenate([np.stack(moved, axis=1), filtered[-1:]])
    by_then = np.maximum.accumulate(known)[np.minimum(np.arange(frames) + delay, frames - 1)]
    return np.where(by_then[..., None], smoothed[:, 0], np.nan).reshape(seen.shape)


def _gains(
    known: NDArray[np.bool_], steps: Floats, order: int, density: float, measurement_sigma: float
) -> tuple[Floats, Floats]:
    """Kalman gains (T, P, n) and RTS gains (T-1, P, n, n) of joints that are seen when ``known`` (T, P) says."""
    covariance = np.broadcast_to(np.diag(np.square(_UNKNOWN[:order])), (known.shape[1], order, order)).copy()
    gains, backward = [], []
    for t, seen in enumerate(known):
        if t:
            f = transition(order, steps[t - 1])
            before = covariance
            covariance = f @ before @ f.T + density * process_noise(order, steps[t - 1])
            backward.append(before @ f.T @ np.linalg.inv(covariance))
        gain = covariance[:, :, 0] / (covariance[:, :1, 0] + measurement_sigma**2) * seen[:, None]
        covariance = covariance - gain[:, :, None] * covariance[:, None, 0]
        gains.append(gain)
    return np.stack(gains), np.stack(backward) if backward else np.empty((0, known.shape[1], order, order))
