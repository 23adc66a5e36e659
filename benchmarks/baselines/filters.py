"""Freely available filters as baselines.

A baseline takes clips side by side, (T, ..., 3) metres with NaN where a joint is missing, and their stamps. It returns
each frame's estimate as of ``delay`` frames later, or as of the end of the clip. All use the real time between frames,
if they use time at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from steadypose.benchmarks.baselines.body import beside
from steadypose.benchmarks.baselines.kalman import bank, fixed_lag, smooth, whole_body_bank
from steadypose.prior.arrays import Floats, medians
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.timing.rate import FPS

OFFLINE = -1  # delay of a method that needs the whole recording

_HAMPEL_HALF = 5  # frames to either side, as far as they are available
_HAMPEL_FLOOR = 0.005  # metres: without it, a still body has no spread and every observation would be an outlier
_GAUSSIAN_PAST = 12  # frames
_VELOCITY_CUTOFF_HZ = 1.0  # of the One-Euro filter
_MEASUREMENT_SIGMA = 0.02  # metres, as in `fixed_lag`


@dataclass(frozen=True)
class Baseline:
    """A method and the range of its parameters."""

    name: str  # name in tables
    run: Callable[..., Floats]  # maps (seen, stamps_s, delay, **parameters) to estimates of seen's shape
    delays: tuple[int, ...] | None = None  # supported delays; None for any
    space: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # range of each parameter; searched in logs
    whole_body: bool = False  # whether it needs all 22 canonical joints


def missing(seen: Floats) -> NDArray[np.bool_]:
    """Return which joints of (T, ..., 3) are missing, (T, ...)."""
    return np.asarray(~np.isfinite(seen).all(axis=-1))


def raw(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    return seen


def hold_last(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Return the input; hold a missing joint at its last position."""
    return np.take_along_axis(seen, _last_seen(seen)[..., None], axis=0)


def interpolate(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Return the input; interpolate a missing joint linearly if its next observation is at most ``delay`` frames away,
    otherwise hold it."""
    frames = np.arange(len(seen)).reshape(-1, *[1] * (seen.ndim - 2))
    gone = missing(seen)
    last = _last_seen(seen)
    after = np.minimum.accumulate(np.where(gone, len(seen), frames)[::-1])[::-1]
    bridged = (after < len(seen)) & ((after - frames <= delay) | (delay == OFFLINE))
    after = np.where(bridged, after, last)
    start, end = stamps_s[last], stamps_s[after]
    share = np.where(after > last, (stamps_s[frames] - start) / np.where(after > last, end - start, 1.0), 0.0)
    a, b = (np.take_along_axis(seen, index[..., None], axis=0) for index in (last, after))
    return np.where(gone[..., None], a + share[..., None] * (b - a), seen)


def one_euro(seen: Floats, stamps_s: Floats, delay: int, min_cutoff_hz: float, beta: float) -> Floats:
    """Apply the One-Euro filter (Casiez, Roussel and Vogel, CHI 2012): the cut-off rises by ``beta`` Hz per m/s.

    The speed is the norm of the joint's filtered velocity, so the result does not depend on the axes. A missing joint
    is held; its next measurement is weighted by the time since its last.
    """
    estimates = np.empty_like(seen)
    previous, estimate, velocity = np.full_like(seen[0], np.nan), np.full_like(seen[0], np.nan), np.zeros_like(seen[0])
    seen_at = np.full(seen.shape[1:-1], np.nan)
    for t, (measured, stamp_s) in enumerate(zip(seen, stamps_s, strict=True)):
        here, known = ~missing(measured), np.isfinite(seen_at)
        step = np.where(known, stamp_s - seen_at, 1.0)[..., None]
        moved = velocity + _weight(_VELOCITY_CUTOFF_HZ, step) * ((measured - previous) / step - velocity)
        cutoff_hz = min_cutoff_hz + beta * np.linalg.norm(moved, axis=-1, keepdims=True)
        filtered = np.where(known[..., None], estimate + _weight(cutoff_hz, step) * (measured - estimate), measured)
        velocity = np.where((here & known)[..., None], moved, velocity)
        estimate = np.where(here[..., None], filtered, estimate)
        previous = np.where(here[..., None], measured, previous)
        seen_at = np.where(here, stamp_s, seen_at)
        estimates[t] = estimate
    return estimates


def _weight(cutoff_hz: Floats | float, step_s: Floats) -> Floats:
    """Return the weight of the newest sample in an exponential filter (One-Euro paper, equation 5)."""
    return 1.0 / (1.0 + 1.0 / (2 * np.pi * cutoff_hz * step_s))


def constant_velocity(seen: Floats, stamps_s: Floats, delay: int, density: float) -> Floats:
    return fixed_lag(seen, stamps_s, delay, 2, density)


def constant_velocity_by_joint(seen: Floats, stamps_s: Floats, delay: int, density: float) -> Floats:
    """Apply the constant-velocity filter with a density for each joint, from joint accelerations in training motion;
    their mean is ``density``."""
    sigma = _MEASUREMENT_SIGMA / np.sqrt(np.diag(body_covariance()))  # only the ratio of density to noise matters
    noise = np.broadcast_to(sigma, seen.shape[:-1])
    return smooth(seen, stamps_s, delay, 2, density, noise).positions.reshape(seen.shape)


def constant_acceleration(seen: Floats, stamps_s: Floats, delay: int, density: float) -> Floats:
    return fixed_lag(seen, stamps_s, delay, 3, density)


def gaussian_hampel(seen: Floats, stamps_s: Floats, delay: int, sigma_s: float, threshold: float) -> Floats:
    """Average the surrounding frames, after a Hampel filter has removed outliers (Pearson et al. 2016).

    Weights are a Gaussian of ``sigma_s`` seconds, cut off ``delay`` frames ahead.
    """
    cleared = _hampel(seen, delay, threshold)
    total, weights = np.zeros_like(cleared), np.zeros(seen.shape[:-1])
    for shift in range(-_GAUSSIAN_PAST, delay + 1):
        frames, others = _overlap(len(seen), shift)
        time = (stamps_s[others] - stamps_s[frames]).reshape(-1, *[1] * (seen.ndim - 2))
        weight = np.where(missing(cleared[others]), 0.0, np.exp(-0.5 * (time / sigma_s) ** 2))
        total[frames] += weight[..., None] * np.nan_to_num(cleared[others])
        weights[frames] += weight
    with np.errstate(invalid="ignore", divide="ignore"):
        return hold_last(np.where((weights > 0)[..., None], total / weights[..., None], np.nan), stamps_s, delay)


def butterworth(seen: Floats, stamps_s: Floats, delay: int, cutoff_hz: float) -> Floats:
    """Apply a second-order Butterworth filter forwards and backwards over the whole clip, gaps interpolated:
    offline."""
    answers = np.full(seen.shape, np.nan)
    filled = interpolate(seen, stamps_s, OFFLINE).reshape(len(seen), -1)
    flat = answers.reshape(len(seen), -1)
    ends = len(seen) - np.isfinite(seen).reshape(len(seen), -1)[::-1].argmax(axis=0)
    sections = butter(2, cutoff_hz, fs=FPS, output="sos")
    for end in np.unique(ends):
        these = (ends == end) & np.isfinite(filled[0])
        if these.any():
            flat[:end, these] = sosfiltfilt(sections, filled[:end, these], axis=0, padlen=min(15, end - 1))
    return answers


BASELINES: tuple[Baseline, ...] = (
    Baseline("raw", raw, (0,)),
    Baseline("hold last", hold_last, (0,)),
    Baseline("held in the body frame", beside, (0,)),
    Baseline("linear interpolation", interpolate),
    Baseline("One-Euro", one_euro, (0,), {"min_cutoff_hz": (0.1, 10.0), "beta": (0.05, 30.0)}),
    Baseline("Kalman, constant velocity", constant_velocity, None, {"density": (0.002, 50.0)}),
    Baseline(
        "Kalman, a density a joint", constant_velocity_by_joint, None, {"density": (0.002, 50.0)}, whole_body=True
    ),
    Baseline("Kalman, constant acceleration", constant_acceleration, None, {"density": (0.05, 5e4)}),
    Baseline("Gaussian + Hampel", gaussian_hampel, None, {"sigma_s": (0.01, 0.4), "threshold": (2.0, 12.0)}),
    Baseline("bank of smoothers", bank),
    Baseline("whole-body bank", whole_body_bank, whole_body=True),
    Baseline("Butterworth, offline", butterworth, (OFFLINE,), {"cutoff_hz": (0.5, 12.0)}),
)
"""Baselines without training. With a delay, a Kalman filter is the fixed-lag RTS smoother of its model."""

FILTERS: tuple[Baseline, ...] = tuple(
    baseline for baseline in BASELINES if baseline.run not in (hold_last, interpolate, beside)
)
"""Baselines for studies without missing joints: those that do more than fill gaps."""


def _last_seen(seen: Floats) -> NDArray[np.intp]:
    """Return the frame of each joint's last observation (T, ...), 0 before the first."""
    frames = np.arange(len(seen)).reshape(-1, *[1] * (seen.ndim - 2))
    return np.maximum.accumulate(np.where(missing(seen), 0, frames))


def _overlap(frames: int, shift: int) -> tuple[slice, slice]:
    """Return the slices of frames t and of frames t + shift for which both exist."""
    start, end = max(0, -shift), max(0, min(frames, frames - shift))
    return slice(start, end), slice(start + shift, max(0, end + shift))


def _hampel(seen: Floats, delay: int, threshold: float) -> Floats:
    shifts = range(-_HAMPEL_HALF, min(delay, _HAMPEL_HALF) + 1)
    around = np.full((len(shifts), *seen.shape), np.nan)
    for row, shift in enumerate(shifts):
        frames, others = _overlap(len(seen), shift)
        around[row, frames] = seen[others]
    median = medians(around)
    spread = 1.4826 * medians(np.linalg.norm(around - median, axis=-1))
    off = np.linalg.norm(seen - median, axis=-1)
    with np.errstate(invalid="ignore"):
        return np.where((off > threshold * np.maximum(spread, _HAMPEL_FLOOR))[..., None], median, seen)
