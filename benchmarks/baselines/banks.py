"""Baselines without a parameter: multiple-model estimates of fixed-lag smoothers, per joint and of the whole body.

Both follow Bar-Shalom, Li and Kirubarajan 2001, section 11.6.

Per joint, a smoother's weight is the likelihood of its innovations over the last 0.3 s. The measurement noise is
estimated from third differences, in which motion is small: their median over the last second, half of it (in logarithm)
shared by the joints of a body.

Of the whole body, eight smoothers run over modes instead of joints. The modes are eigenvectors of the covariance of
joint accelerations, learned once from other people's motion (`prior.models.mixture.tracks`). In white noise it has 0.84
to 0.93 of the other's error, for all people. Its smoothers are the product's own (`prior.models.mixture.bank`). The
product falls back to the same estimate, except for the noise shared by modes where it is white.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from steadypose.benchmarks.baselines.kalman import smooth
from steadypose.prior.arrays import Floats
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    MEASUREMENT_SIGMA,
    MULTIPLE_MODEL,
    advance,
    new_bank,
)
from steadypose.prior.models.mixture.features import FEATURES, PARENT, describe
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.timing.rate import FPS

JOINT_DENSITIES = (0.05, 0.3, 1.8, 10.0, 60.0)
"""Process densities of the joints' smoothers, m²/s³."""

_RECENT, _NOISE_FRAMES = 9, 30
_MIN_NOISE, _FIRST_NOISE = 1e-4, 0.01
"""Lower bound of the estimated noise, and its value before the fourth observation, metres."""
_MEDIAN_NORM = 1.538
"""Median length of a normal vector in space with a standard deviation of 1 along each axis."""
_THIRD = np.sqrt(20.0)
"""Standard deviation of the third difference of white noise of standard deviation 1."""


def bank(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Estimate each frame (..., J, 3) metres, NaN where missing, given those up to ``delay`` later, or to the end."""
    frames, joints = len(seen), seen.shape[1:-1]
    sigma = noise_found(seen)
    found = [smooth(seen, stamps_s, delay, 2, density, sigma) for density in JOINT_DENSITIES]
    past = np.cumsum([f.log_likelihood for f in found], axis=1)
    past[:, _RECENT:] -= past[:, :-_RECENT].copy()
    log_likelihood = past[:, np.minimum(np.arange(frames) + delay, frames - 1)]
    weights = np.exp(log_likelihood - log_likelihood.max(axis=0))
    weights /= weights.sum(axis=0)
    mixed = sum(w[..., None] * f.positions for w, f in zip(weights, found, strict=True))
    return np.asarray(mixed).reshape(frames, *joints, 3)


def noise_found(seen: Floats) -> Floats:
    """Estimate the noise along an axis from the input up to each frame, (T, ..., J) metres."""
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


def whole_body_bank(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Estimate each frame (..., 22, 3) metres, NaN where missing, given those up to ``delay`` later, or to the end.

    Raises ValueError for other joints: the compiled loops would write past the ends of their arrays.
    """
    if seen.shape[-2:] != (len(PARENT), 3):
        raise ValueError(f"expected (..., {len(PARENT)}, 3) canonical joints of a body, got {seen.shape}")
    frames = np.ascontiguousarray(seen.reshape(len(seen), -1, *seen.shape[-2:]))
    bodies, joints = frames.shape[1:3]
    bank, sure, answers = new_bank(bodies, delay), np.ones((bodies, joints)), np.full(frames.shape, np.nan)
    experts, features = np.empty((bodies, joints, EXPERTS, 3)), np.empty((bodies, joints, FEATURES), np.float32)
    scale, gap, between = np.empty(bodies), np.empty((bodies, joints)), np.empty((bodies, joints))

    unknown = np.zeros(bodies)  # whether the noise is white is unknown

    def answer(count: int, back: int) -> None:
        describe(bank, count, back, PARENT, unknown, experts, features, scale, gap, between)
        answers[count - 1 - back] = experts[:, :, MULTIPLE_MODEL]

    for t, frame in enumerate(frames):
        step = stamps_s[t] - stamps_s[t - 1] if t else 1 / FPS
        advance(bank, t, step, frame, sure, DENSITIES, MEASUREMENT_SIGMA, body_covariance())
        if t >= delay:
            answer(t + 1, delay)
    for back in reversed(range(min(delay, len(frames)))):
        answer(len(frames), back)
    return answers.reshape(seen.shape)
