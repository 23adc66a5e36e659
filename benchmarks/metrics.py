"""Metrics, as the papers define them: arrays in, arrays out, SI units, NaN where there is nothing to compare."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def position_error(estimate: Floats, truth: Floats) -> Floats:
    """Distance between (T, J, 3) and (T, J, 3), metres: (T, J). Its mean is the MPJPE."""
    return np.linalg.norm(estimate - truth, axis=-1)


def acceleration_error(estimate: Floats, truth: Floats) -> Floats:
    """Norm of the difference of the second differences, (T-2, J) metres/frame² (Kanazawa et al. 2019).

    Times fps² it is in m/s²: at 30 Hz, 1 mm/frame² is 0.9 m/s².
    """
    return np.linalg.norm(np.diff(estimate - truth, n=2, axis=0), axis=-1)


def length_variation(positions: Floats, bones: Sequence[tuple[int, int]]) -> float:
    """How far bones are from constant: standard deviation over time by mean length, the mean over bones.

    Args:
        positions: (T, J, 3) metres.
        bones: pairs of joint indices.
    """
    ends, starts = np.array(bones).T
    lengths = np.linalg.norm(positions[:, ends] - positions[:, starts], axis=-1)
    return float(np.mean(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)))


def contact_speed(positions: Floats, contact: NDArray[np.bool_], stamps_s: Floats) -> Floats:
    """Horizontal speed of joints from one frame to the next where both are in contact, m/s: (T-1, J), else NaN.

    Each foot counts for itself: its mean is the foot skate.

    Args:
        positions: (T, J, 3) metres, z up.
        contact: (T, J).
        stamps_s: (T,) seconds.
    """
    speed = np.linalg.norm(np.diff(positions[..., :2], axis=0), axis=-1) / np.diff(stamps_s)[:, None]
    return np.where(contact[1:] & contact[:-1], speed, np.nan)


def rigid_alignment(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """The rotation R (3, 3) and translation t (3,) with the least sum of |R source + t - target|² (Kabsch 1976).

    Args:
        source: (..., 3) metres; points not finite in either are left out.
        target: the same shape.

    Raises:
        ValueError: fewer than three points are finite in both.
    """
    both = np.isfinite(source).all(axis=-1) & np.isfinite(target).all(axis=-1)
    a, b = source[both], target[both]
    if len(a) < 3:
        raise ValueError(f"alignment: expected at least 3 points that both have, got {len(a)}")
    u, _, vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u @ mirror @ vt).T
    return rotation, b.mean(axis=0) - rotation @ a.mean(axis=0)


def body_frame(left_hip: Floats, right_hip: Floats, left_shoulder: Floats, right_shoulder: Floats) -> Floats:
    """Axes forward, left, up of the trunk as columns: (..., 3, 3). Up runs from the hips to the shoulders.

    Args:
        left_hip, right_hip, left_shoulder, right_shoulder: (..., 3) metres.
    """
    up = left_shoulder + right_shoulder - left_hip - right_hip
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    left = left_shoulder - right_shoulder + left_hip - right_hip
    left = left - (left * up).sum(axis=-1, keepdims=True) * up
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def bootstrap(values: ArrayLike, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean of (N,) values, one a clip, by drawing clips with replacement."""
    values = np.asarray(values, dtype=np.float64)
    picks = np.random.default_rng(seed).integers(len(values), size=(draws, len(values)))
    low, high = np.quantile(values[picks].mean(axis=1), (0.025, 0.975))
    return float(low), float(high)


def bootstrap_ratio(
    values: ArrayLike, baseline: ArrayLike, draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Ratio of two means over the same (N,) clips, and its 95 % interval by drawing clips with replacement."""
    values, baseline = np.asarray(values, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    picks = np.random.default_rng(seed).integers(len(values), size=(draws, len(values)))
    low, high = np.quantile(values[picks].mean(axis=1) / baseline[picks].mean(axis=1), (0.025, 0.975))
    return float(values.mean() / baseline.mean()), float(low), float(high)
