"""The experts of the mixture: a bank of fixed-lag smoothers.

Every joint is tracked by constant-velocity Kalman filters that differ in the density of their process noise, each with
the fixed-lag smoother of its last frames (see `FixedLagRTS`, of which these are many side by side). One of small
density averages noise away and lags behind fast motion; one of large density follows everything, noise included.

Their mean, weighted by each filter's likelihood, is the static multiple-model estimate (Bar-Shalom, Li and Kirubarajan
2001, section 11.6), with exponential forgetting. The measurement noise is unknown: for each filter it is the most
likely one given the innovations (concentrated likelihood), so that only the ratio of process to measurement noise
distinguishes the filters. That mean is one more expert; the experts' weights are computed by
`prior.models.mixture.network`, from `prior.models.mixture.features`. Training and the live node share this code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS

DENSITIES = np.array([0.01, 0.045, 0.2, 0.9, 4.0, 15.0, 60.0, 400.0])
"""m²/s³, process densities of the smoothers, stiff to loose, for a measurement of `MEASUREMENT_SIGMA`."""

MEASUREMENT_SIGMA = 0.02
"""Metres along an axis, at full confidence. Only its ratio to the density matters."""

EXPERTS = len(DENSITIES) + 2
"""Number of experts: the smoothers; the multiple-model estimate; the raw joint, held at its last position while
unseen."""

MULTIPLE_MODEL = len(DENSITIES)
RAW = EXPERTS - 1
"""Indices of the last two"""

MEMORY = 9
"""Time constant of the likelihoods' exponential forgetting, in sightings: 5 to 15 differ by 3 % at most
(validation)."""

MIN_SCALE = 1e-4
"""Added to every normalised squared innovation: a floor of the noise at a hundredth of `MEASUREMENT_SIGMA`."""

MEAN_FRAMES = 18
"""Frames of the running means of distances and differences."""

LOG_FLOOR = 3e-4
"""Metres, floor of lengths in logarithms."""

INITIAL_SPEED = 1.0
"""m/s along an axis, standard deviation of a new joint's velocity."""

LAGS = ((1, 1), (2, 1), (3, 1), (2, 3))
"""Order and spacing (frames) of the differences of raw positions, whose sizes distinguish noise from motion."""
_HISTORY = 7


class Bank(NamedTuple):
    """State of S bodies, J joints, M smoothers and K frames: the delay and the newest.

    Attributes:
        position: (S, J, M, K, 3) metres, of each frame given all measurements so far.
        variance: (S, J, M, K) metres² along an axis, of that.
        with_position, with_velocity: (S, J, M, K) covariance of each frame's position with the newest position and
            velocity.
        velocity: (S, J, M, 3) m/s, and ``velocity_variance`` (S, J, M).
        squared_innovations: (S, J, M) sums, with forgetting, of the squared innovations normalised by their variance.
        log_variances: (S, J, M) sums, with forgetting, of the logarithms of the innovations' variance.
        sightings: (S, J) number of terms of these sums, with forgetting.
        raw: (S, J, K, 3) metres, the raw position, or the last one; NaN before the first.
        unseen: (S, J, K) frames since the joint was last seen; -1 before the first sighting.
        confidence: (S, J, K).
        recent: (S, J, 7, 3) metres, raw positions of the last frames; NaN where unseen.
        distances: (S, J, M, 2) metres², running means of the squared distances between neighbouring experts.
        noise: (S, J) metres², running mean of the squared distance of the raw joint to `features.NOISE_EXPERT`.
        sizes: (S, J, 4) running means of the logarithms of the differences of `LAGS`.
        length: (S, J, 2) metres and metres², running mean and variance of the length of each joint's bone.
        place: (S, J, 3) metres, the pose in the frame last described; NaN before.
        age: (S, J, 3) frames that the running means of experts, differences and bones contain.
        heading: (S, 2) cosine and sine of the body's heading.
    """

    position: NDArray[np.float64]
    variance: NDArray[np.float64]
    with_position: NDArray[np.float64]
    with_velocity: NDArray[np.float64]
    velocity: NDArray[np.float64]
    velocity_variance: NDArray[np.float64]
    squared_innovations: NDArray[np.float64]
    log_variances: NDArray[np.float64]
    sightings: NDArray[np.float64]
    raw: NDArray[np.float64]
    unseen: NDArray[np.float64]
    confidence: NDArray[np.float64]
    recent: NDArray[np.float64]
    distances: NDArray[np.float64]
    noise: NDArray[np.float64]
    sizes: NDArray[np.float64]
    length: NDArray[np.float64]
    place: NDArray[np.float64]
    age: NDArray[np.float64]
    heading: NDArray[np.float64]


def new_bank(bodies: int, delay: int) -> Bank:
    """An empty bank for ``bodies`` slots and a delay in frames."""
    experts, joints, frames = len(DENSITIES), len(PARENTS), delay + 1
    bank = Bank(
        position=np.empty((bodies, joints, experts, frames, 3)),
        variance=np.empty((bodies, joints, experts, frames)),
        with_position=np.empty((bodies, joints, experts, frames)),
        with_velocity=np.empty((bodies, joints, experts, frames)),
        velocity=np.empty((bodies, joints, experts, 3)),
        velocity_variance=np.empty((bodies, joints, experts)),
        squared_innovations=np.empty((bodies, joints, experts)),
        log_variances=np.empty((bodies, joints, experts)),
        sightings=np.empty((bodies, joints)),
        raw=np.empty((bodies, joints, frames, 3)),
        unseen=np.empty((bodies, joints, frames)),
        confidence=np.empty((bodies, joints, frames)),
        recent=np.empty((bodies, joints, _HISTORY, 3)),
        distances=np.empty((bodies, joints, experts, 2)),
        noise=np.empty((bodies, joints)),
        sizes=np.empty((bodies, joints, len(LAGS))),
        length=np.empty((bodies, joints, 2)),
        place=np.empty((bodies, joints, 3)),
        age=np.empty((bodies, joints, 3)),
        heading=np.empty((bodies, 2)),
    )
    forget(bank, np.ones(bodies, dtype=bool))
    return bank


def forget(bank: Bank, slot: NDArray[np.bool_]) -> None:
    """Forget the bodies in these slots (S,)."""
    for values in bank:
        values[slot] = 0.0
    for values in (bank.position, bank.raw, bank.recent, bank.place):
        values[slot] = np.nan
    bank.unseen[slot] = -1.0
    bank.heading[slot] = (1.0, 0.0)


@njit(cache=True, error_model="numpy")
def advance(bank, count, step, positions, confidence, densities, sigma):
    """Take in a frame: predict and update all filters and smoothers.

    Args:
        bank: a `Bank`.
        count: frames taken in before.
        step: seconds since the last.
        positions: (S, J, 3) metres, NaN where unseen.
        confidence: (S, J) 0 to 1.
        densities: `DENSITIES`.
        sigma: `MEASUREMENT_SIGMA`.
    """
    bodies, joints, experts, frames, _ = bank.position.shape
    slot, last = count % frames, (count - 1) % frames
    keep = 1.0 - 1.0 / MEMORY
    for s in range(bodies):
        for j in range(joints):
            seen = np.isfinite(positions[s, j, 0] + positions[s, j, 1] + positions[s, j, 2])
            known = bank.unseen[s, j, last] >= 0
            bank.confidence[s, j, slot] = confidence[s, j] if seen else 0.0
            bank.unseen[s, j, slot] = 0.0 if seen else bank.unseen[s, j, last] + 1.0 if known else -1.0
            for axis in range(3):
                for k in range(_HISTORY - 1):
                    bank.recent[s, j, k, axis] = bank.recent[s, j, k + 1, axis]
                came = positions[s, j, axis] if seen else np.nan
                bank.recent[s, j, _HISTORY - 1, axis] = came
                bank.raw[s, j, slot, axis] = bank.raw[s, j, last, axis] if known and not seen else came
            if seen:
                _measure_differences(bank.recent[s, j], bank.sizes[s, j], bank.age[s, j])
            variance = (sigma / min(max(confidence[s, j], 0.1), 1.0)) ** 2
            if seen and known:
                bank.sightings[s, j] = keep * bank.sightings[s, j] + 1.0
            for m in range(experts):
                position, own_variance = bank.position[s, j, m], bank.variance[s, j, m]
                with_position, with_velocity = bank.with_position[s, j, m], bank.with_velocity[s, j, m]
                velocity = bank.velocity[s, j, m]
                if not known:
                    if seen:
                        for k in range(frames):
                            with_position[k] = with_velocity[k] = 0.0
                        for axis in range(3):
                            position[slot, axis] = positions[s, j, axis]
                            velocity[axis] = 0.0
                        with_position[slot] = own_variance[slot] = variance
                        bank.velocity_variance[s, j, m] = INITIAL_SPEED**2
                    continue
                own = bank.velocity_variance[s, j, m]
                growth, covariance = densities[m] * step, with_velocity[last]
                ahead = with_position[last] + step * (2 * covariance + step * (own + growth / 3))
                for k in range(frames):
                    with_position[k] += step * with_velocity[k]
                for axis in range(3):
                    position[slot, axis] = position[last, axis] + step * velocity[axis]
                with_position[slot] = own_variance[slot] = ahead
                covariance = with_velocity[slot] = covariance + step * (own + growth / 2)
                bank.velocity_variance[s, j, m] = own = own + growth
                if not seen:
                    continue
                total = ahead + variance
                a = positions[s, j, 0] - position[slot, 0]
                b = positions[s, j, 1] - position[slot, 1]
                c = positions[s, j, 2] - position[slot, 2]
                square = (a * a + b * b + c * c) / (3.0 * total)
                bank.squared_innovations[s, j, m] = keep * bank.squared_innovations[s, j, m] + square + MIN_SCALE
                bank.log_variances[s, j, m] = keep * bank.log_variances[s, j, m] + np.log(total)
                for k in range(frames):
                    gain = with_position[k] / total
                    position[k, 0] += gain * a
                    position[k, 1] += gain * b
                    position[k, 2] += gain * c
                    own_variance[k] -= gain * with_position[k]
                    with_position[k] -= gain * ahead
                    with_velocity[k] -= gain * covariance
                gain = covariance / total
                velocity[0] += gain * a
                velocity[1] += gain * b
                velocity[2] += gain * c
                bank.velocity_variance[s, j, m] = own - gain * covariance


@njit(cache=True, error_model="numpy")
def _measure_differences(recent, sizes, age):
    """Update the running means of the logarithms of `LAGS`' differences of raw positions (7, 3)."""
    n = _HISTORY - 1
    squares = np.zeros(4)
    for axis in range(3):
        a, b, c, d = recent[n, axis], recent[n - 1, axis], recent[n - 2, axis], recent[n - 3, axis]
        squares[0] += (a - b) ** 2
        squares[1] += (a - 2 * b + c) ** 2
        squares[2] += (a - 3 * b + 3 * c - d) ** 2
        squares[3] += (a - 2 * d + recent[n - 6, axis]) ** 2
    if np.isfinite(squares[2]):
        age[1] += 1.0
        for k in range(4):
            if np.isfinite(squares[k]):
                value = 0.5 * np.log(squares[k] + LOG_FLOOR**2)
                sizes[k] += (value - sizes[k]) / min(age[1], MEAN_FRAMES)
            elif age[1] < 4:
                sizes[k] = 0.5 * np.log(squares[1] + LOG_FLOOR**2)


@njit(cache=True, error_model="numpy")
def multiple_model_weights(squared_innovations, log_variances, sightings, weights):
    """Write the smoothers' weights in the multiple-model estimate of one joint: their normalised likelihoods.

    Args:
        squared_innovations: (M,), as of `Bank`.
        log_variances: (M,), as of `Bank`.
        sightings: as of `Bank`.
        weights: (M,), written; they sum to 1.

    Returns:
        The estimated variance of the measurement noise, in units of `MEASUREMENT_SIGMA` squared.
    """
    most, noise = -np.inf, 0.0
    for m in range(len(weights)):
        scale = squared_innovations[m] / sightings if sightings > 0.0 else 1.0
        weights[m] = -1.5 * (sightings * np.log(scale) + log_variances[m])
        most = max(most, weights[m])
    total = 0.0
    for m in range(len(weights)):
        weights[m] = np.exp(weights[m] - most)
        total += weights[m]
    for m in range(len(weights)):
        weights[m] /= total
        noise += weights[m] * (squared_innovations[m] / sightings if sightings > 0.0 else 1.0)
    return noise
