"""Kalman filters of a constant derivative with fixed-lag smoothing, joint by joint; of the whole body; banks of them.

The first is a textbook implementation for comparison (Bar-Shalom, Li and Kirubarajan 2001, sections 6.2 and 8.6). The
smoother is the filter of a state that includes the last positions (Anderson and Moore 1979, section 7.3), which equals
Rauch, Tung and Striebel's backward sweep over these frames.

The second is a baseline for hidden joints. Its state is the position and velocity of 22 joints. Velocities are damped,
and joints accelerate with the covariance of training motion (`prior.models.mixture.tracks`), the only thing learned. It
is the same for x, y and z, so one covariance (44, 44) serves all three axes. A hidden joint contributes no measurement;
it follows from the others'.

The banks are multiple-model estimates (the same book, section 11.6) without a parameter. Per joint, a smoother's weight
is the likelihood of its innovations over the last 0.3 s, and the measurement noise is estimated from third differences,
in which motion is small: their median over the last second, half of it (in logarithm) shared by the joints of a body.
For the whole body, eight smoothers run over modes: eigenvectors of that covariance. They are the product's own
(`prior.models.mixture.bank`), which falls back to the same estimate, except for the noise shared by modes where it is
white. In white noise it has 0.84 to 0.93 of the other's error, for all people.
"""

from __future__ import annotations

import math
from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from steadypose.benchmarks.baselines.body import beside
from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
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

_UNKNOWN = (1e3, 1.0, 5.0)  # standard deviations of a joint never observed: metres, m/s, m/s²


class Smoothed(NamedTuple):
    """Output of a smoother for (T, N) joints."""

    positions: Floats  # (T, N, 3) metres, given the measurements up to ``delay`` frames later
    log_likelihood: Floats  # (T, N) of each measurement, given the earlier ones; 0 without them


def transition(order: int, step: float) -> Floats:
    """Return the state transition (n, n) over ``step`` seconds: Taylor's series."""
    return np.array(
        [[step ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in range(order)] for i in range(order)]
    )


def process_noise(order: int, step: float) -> Floats:
    """Return the covariance (n, n) that white noise of unit density on the last derivative adds in ``step`` seconds."""
    ahead = [order - 1 - i for i in range(order)]
    return np.array([[step ** (a + b + 1) / (factorial(a) * factorial(b) * (a + b + 1)) for b in ahead] for a in ahead])


def fixed_lag(
    seen: Floats, stamps_s: Floats, delay: int, order: int, density: float, measurement_sigma: float = 0.02
) -> Floats:
    """Estimate each frame (T, ..., 3) metres, NaN where missing, given those up to ``delay`` later, or to the end. The
    result is NaN where a joint had not been observed yet.

    ``order`` is 2 for constant velocity, 3 for constant acceleration; ``density`` is the power spectral density of the
    noise on the next derivative: m²/s³ for 2, m²/s⁵ for 3.
    """
    sigma = np.full(seen.shape[:-1], measurement_sigma)
    return smooth(seen, stamps_s, delay, order, density, sigma).positions.reshape(seen.shape)


def smooth(seen: Floats, stamps_s: Floats, delay: int, order: int, density: float, sigma: Floats) -> Smoothed:
    """Run the smoother with a measurement noise for each observation, ``sigma`` (T, ...) metres; joints in a row."""
    frames = len(seen)
    z = np.ascontiguousarray(seen.reshape(frames, -1, 3))
    steps = np.diff(stamps_s)
    forward = np.array([transition(order, step) for step in steps]).reshape(-1, order, order)
    added = np.array([density * process_noise(order, step) for step in steps]).reshape(-1, order, order)
    variance = np.ascontiguousarray(np.square(sigma).reshape(frames, -1))
    answers, likelihood = np.full(z.shape, np.nan), np.zeros(z.shape[:2])
    _smooth(z, variance, forward, added, np.square(_UNKNOWN[:order]), min(delay, frames - 1), answers, likelihood)
    return Smoothed(answers, likelihood)


@njit(cache=True)
def _smooth(z, variance, forward, added, unknown, delay, answers, likelihood):  # pragma: no cover
    frames, joints, _ = z.shape
    n, lags = len(unknown), delay + 1
    place = np.empty((lags, 3))  # of the last frames, by frame number modulo lags
    cross = np.empty((lags, n))  # covariance of these with the newest state
    state, covariance, ahead = np.empty((n, 3)), np.empty((n, n)), np.empty((n, n))
    column = np.empty(n)
    for j in range(joints):
        state[:] = 0.0
        covariance[:] = np.diag(unknown)
        known = False
        for t in range(frames):
            if t > 0:
                f = forward[t - 1]  # upper triangular with ones on the diagonal
                for i in range(n):
                    for k in range(i + 1, n):
                        for axis in range(3):
                            state[i, axis] += f[i, k] * state[k, axis]
                for i in range(n):
                    for k in range(n):
                        ahead[i, k] = covariance[i, k]
                        for m in range(i + 1, n):
                            ahead[i, k] += f[i, m] * covariance[m, k]
                for i in range(n):
                    for k in range(n):
                        covariance[i, k] = ahead[i, k] + added[t - 1, i, k]
                        for m in range(k + 1, n):
                            covariance[i, k] += ahead[i, m] * f[k, m]
                for past in range(min(t, lags)):
                    for i in range(n):
                        for k in range(i + 1, n):
                            cross[past, i] += f[i, k] * cross[past, k]
            for i in range(n):
                cross[t % lags, i] = covariance[0, i]
            for axis in range(3):
                place[t % lags, axis] = state[0, axis]
            if np.isfinite(z[t, j, 0]) and np.isfinite(z[t, j, 1]) and np.isfinite(z[t, j, 2]):
                total = covariance[0, 0] + variance[t, j]
                a, b, c = z[t, j, 0] - state[0, 0], z[t, j, 1] - state[0, 1], z[t, j, 2] - state[0, 2]
                if known:
                    likelihood[t, j] = -1.5 * np.log(total) - 0.5 * (a * a + b * b + c * c) / total
                known = True
                for i in range(n):
                    column[i] = covariance[0, i]
                for past in range(min(t + 1, lags)):
                    gain = cross[past, 0] / total
                    place[past, 0] += gain * a
                    place[past, 1] += gain * b
                    place[past, 2] += gain * c
                    for i in range(n):
                        cross[past, i] -= gain * column[i]
                for i in range(n):
                    gain = column[i] / total
                    state[i, 0] += gain * a
                    state[i, 1] += gain * b
                    state[i, 2] += gain * c
                    for k in range(n):
                        covariance[i, k] -= gain * column[k]
            if known and t >= delay:
                answers[t - delay, j] = place[(t - delay) % lags]
        if known:
            for t in range(max(frames - delay, 0), frames):
                answers[t, j] = place[t % lags]


MIN_SIGMA = 0.01
"""Standard deviation of a measurement along an axis, metres. Modes are not exact: with less, a joint's noise moves
hidden joints."""


def whole_body_kalman(seen: Floats, stamps_s: Floats, delay: int, density: float, damping: float) -> Floats:
    """Return joints (T, C, 22, 3) metres, z up, with hidden ones (NaN) estimated by the filter from the measurements up
    to their own frame.

    ``density`` is the mean process density of the joints, m²/s³, ``damping`` that of velocities, 1/s.
    """
    answers, clips = beside(seen, stamps_s, delay), seen.shape[1]
    # positions in metres, NaN before the first measurement, then velocities in m/s; deviations of 1 m and 1 m/s
    mean, covariance = np.zeros((clips, 44, 3)), np.tile(np.eye(44), (clips, 1, 1))
    mean[:, :22] = np.nan
    for t, frame in enumerate(np.ascontiguousarray(seen)):
        step = stamps_s[t] - stamps_s[t - 1] if t else 1 / FPS
        for clip, measured in enumerate(frame):
            _step(mean[clip], covariance[clip], measured, body_covariance(), step, density, damping)
            hidden = np.isnan(measured[:, 0]) & np.isfinite(mean[clip, :22, 0])
            answers[t, clip, hidden] = mean[clip, :22][hidden]
    return answers


@njit(cache=True)
def _step(mean, covariance, measured, modes, dt, density, damping):  # pragma: no cover
    """Predict a body's state by ``dt`` seconds, and update it by each measured joint (22, 3) metres, NaN if missing, in
    turn. ``modes`` (22, 22) is the covariance of joint accelerations, of mean variance 1.
    """
    joints, kept = 22, math.exp(-damping * dt)
    moved = (1.0 - kept) / damping
    twice = (1.0 - kept * kept) / (2.0 * damping)
    of_speed = density * twice
    of_both = density * (moved - twice) / damping
    of_place = density * (dt - 2.0 * moved + twice) / damping**2
    for i in range(joints):
        for axis in range(3):
            mean[i, axis] += moved * mean[joints + i, axis]
            mean[joints + i, axis] *= kept
    for i in range(joints):
        for j in range(joints):
            xx, xv, vx, vv = (
                covariance[i, j],
                covariance[i, joints + j],
                covariance[joints + i, j],
                covariance[joints + i, joints + j],
            )
            noise = modes[i, j]
            covariance[i, j] = xx + moved * (xv + vx) + moved * moved * vv + of_place * noise
            covariance[i, joints + j] = kept * (xv + moved * vv) + of_both * noise
            covariance[joints + i, j] = kept * (vx + moved * vv) + of_both * noise
            covariance[joints + i, joints + j] = kept * kept * vv + of_speed * noise
    for joint in range(joints):
        if math.isfinite(measured[joint, 0]):
            _measure(mean, covariance, joint, measured[joint])


@njit(cache=True)
def _measure(mean, covariance, joint, measured):  # pragma: no cover
    if math.isnan(mean[joint, 0]):
        # the first measurement is independent of all other joints
        for k in range(len(mean)):
            covariance[joint, k] = covariance[k, joint] = 0.0
        covariance[joint, joint] = MIN_SIGMA * MIN_SIGMA
        for axis in range(3):
            mean[joint, axis] = measured[axis]
        return
    row = covariance[joint].copy()
    inverse = 1.0 / (row[joint] + MIN_SIGMA * MIN_SIGMA)
    off = measured - mean[joint]
    for k in range(len(mean)):
        gain = row[k] * inverse
        for axis in range(3):
            mean[k, axis] += gain * off[axis]
        for j in range(len(mean)):
            covariance[k, j] -= gain * row[j]


JOINT_DENSITIES = (0.05, 0.3, 1.8, 10.0, 60.0)  # process densities of the joints' smoothers, m²/s³

_RECENT, _NOISE_FRAMES = 9, 30
_MIN_NOISE, _FIRST_NOISE = 1e-4, 0.01
"""Lower bound of the estimated noise, and its value before the fourth observation, metres."""
_MEDIAN_NORM = 1.538  # median length of a normal vector in space with a standard deviation of 1 along each axis
_THIRD = np.sqrt(20.0)  # standard deviation of the third difference of white noise of standard deviation 1


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
