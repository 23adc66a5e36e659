"""The experts of the mixture: a bank of fixed-lag smoothers.

Each mode of the body's motion, and each joint outside the modes, is a track (`prior.models.mixture.tracks`). Each track
has several constant-velocity Kalman filters that differ in the density of their process noise, each with a fixed-lag
smoother over its last frames. A filter of small density averages noise but lags behind fast motion; a filter of large
density follows everything, including noise. The smoothers use the augmented-state form (Anderson and Moore 1979,
section 7.3): the positions of the last frames are updated with the newest one through their covariance with it. This
equals the RTS result without a backward pass.

The smoothers' mean, weighted by the filters' likelihoods, is the static multiple-model estimate (Bar-Shalom, Li and
Kirubarajan 2001, section 11.6), with exponential forgetting. The measurement noise is unknown. Each filter uses the
most likely noise given its innovations (concentrated likelihood) and, where noise is white, given the noise of the
body's other tracks (`SHARED`). Only the ratio of process to measurement noise therefore distinguishes the filters. The
multiple-model estimate of each track is another expert. `training.networks.mixture` computes the experts' weights from
`prior.models.mixture.features`. Training and live inference share this code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.compiled import njit
from steadypose.prior.models.mixture.tracks import (
    HELD,
    MEMORY,
    SETTLED,
    clipped,
    fill_in,
    predict,
    regroup,
    turn,
    update,
    weigh,
)

DENSITIES = np.array([0.01, 0.045, 0.2, 0.9, 4.0, 15.0, 60.0, 400.0])
"""Process densities of the smoothers, stiff to loose, m²/s³. They are for measurements with `MEASUREMENT_SIGMA` and a
track whose variance is the joints' mean."""

MEASUREMENT_SIGMA = 0.02
"""Standard deviation of a fully confident measurement along an axis, metres. Only its ratio to the density matters."""

EXPERTS = len(DENSITIES) + 2
"""Number of experts: the smoothers, the multiple-model estimate, and the raw joint (held while unobserved)."""

MULTIPLE_MODEL = len(DENSITIES)
RAW = EXPERTS - 1
"""Indices of the last two experts."""

MEAN_FRAMES = 18  # length of the running means of distances and differences, frames

SHARED = 9.0
"""Weight of the geometric mean of the tracks' noise in the noise of each track, observations. Over a few frames, a fast
track looks like a noisy one. Values of 4 to 15 differ by at most 1 % (validation)."""

LOG_FLOOR = 3e-4  # floor of lengths in logarithms, metres

LAGS = ((1, 1), (2, 1), (3, 1), (2, 3))
"""Order and spacing of the differences of raw positions, frames. Their sizes distinguish noise from motion."""
_HISTORY = 7


class Bank(NamedTuple):
    """State of S bodies, J joints in J tracks, M smoothers and K frames (the delay and the newest)."""

    # of tracks
    position: Floats  # (S, J, M, K, 3) metres, position in each frame given all measurements so far
    variance: Floats  # (S, J, M, K) metres² along an axis, variance of the position
    with_position: Floats  # (S, J, M, K) covariance of each frame's position with the newest position
    with_velocity: Floats  # (S, J, M, K) covariance of each frame's position with the newest velocity
    velocity: Floats  # (S, J, M, 3) m/s
    velocity_variance: Floats  # (S, J, M)
    squared_innovations: Floats  # (S, J, M) sums, with forgetting, of squared innovations over their variances
    log_variances: Floats  # (S, J, M) sums, with forgetting, of the logarithms of the innovations' variances
    observations: Floats  # (S, J) number of observations in these sums, with forgetting
    # of joints
    raw: Floats  # (S, J, K, 3) metres, the raw position, or the last one while unobserved; NaN before the first
    since: Floats  # (S, J, K) frames since the joint was last observed; -1 before the first observation
    confidence: Floats  # (S, J, K) confidence of the observation
    recent: Floats  # (S, J, 7, 3) metres, raw positions of the last frames; NaN where unobserved
    distances: Floats  # (S, J, M, 2) metres², running means of the squared distances between neighbouring experts
    noise: Floats  # (S, J) metres², running mean of the squared distance from the raw joint to `features.NOISE_EXPERT`
    sizes: Floats  # (S, J, 4) running means of the logarithms of the differences of `LAGS`
    length: Floats  # (S, J, 2) metres and metres², running mean and variance of the length of each joint's bone
    place: Floats  # (S, J, 3) metres, pose in the frame that was last described; NaN before
    age: Floats  # (S, J, 3) number of frames in the running means of experts, differences and bones
    # of bodies and their modes
    heading: Floats  # (S, 2) cosine and sine of the body's heading
    modes: Floats  # (S, J, J) orthogonal matrix, joints by tracks: joints are ``modes @ tracks``
    eigenvalue: Floats  # (S, J) variance of each track's acceleration, relative to the joints' mean
    member: Floats  # (S, J) 1 if a joint is in the body's modes, 0 if it is a track of its own
    streak: Floats  # (S, J) number of consecutive frames in which a joint was observed


def new_bank(bodies: int, delay: int) -> Bank:
    """Create an empty bank for ``bodies`` slots and a delay in frames."""
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
        observations=np.empty((bodies, joints)),
        raw=np.empty((bodies, joints, frames, 3)),
        since=np.empty((bodies, joints, frames)),
        confidence=np.empty((bodies, joints, frames)),
        recent=np.empty((bodies, joints, _HISTORY, 3)),
        distances=np.empty((bodies, joints, experts, 2)),
        noise=np.empty((bodies, joints)),
        sizes=np.empty((bodies, joints, len(LAGS))),
        length=np.empty((bodies, joints, 2)),
        place=np.empty((bodies, joints, 3)),
        age=np.empty((bodies, joints, 3)),
        heading=np.empty((bodies, 2)),
        modes=np.empty((bodies, joints, joints)),
        eigenvalue=np.empty((bodies, joints)),
        member=np.empty((bodies, joints)),
        streak=np.empty((bodies, joints)),
    )
    forget(bank, np.ones(bodies, dtype=bool))
    return bank


def forget(bank: Bank, slot: Bools) -> None:
    """Forget the bodies in these slots (S,)."""
    for values in bank:
        values[slot] = 0.0
    for values in (bank.raw, bank.recent, bank.place):
        values[slot] = np.nan
    bank.modes[slot], bank.eigenvalue[slot] = np.eye(bank.modes.shape[1]), 1.0
    bank.since[slot] = -1.0
    bank.heading[slot] = (1.0, 0.0)


@njit(cache=True)
def advance(bank, count, step, positions, confidence, densities, sigma, covariance):
    """Process a frame: predict and update all filters and smoothers.

    Args:
        bank: a `Bank`.
        count: number of frames processed before.
        step: seconds since the last frame.
        positions: (S, J, 3) metres, NaN where unobserved.
        confidence: (S, J) 0 to 1.
        densities: `DENSITIES`.
        sigma: `MEASUREMENT_SIGMA`.
        covariance: (J, J) covariance of joints' accelerations along an axis, with mean variance 1 (`body_covariance`).
    """
    bodies, joints, _, frames, _ = bank.position.shape
    slot, last = count % frames, (count - 1) % frames
    observed, known = np.empty(joints, dtype=np.bool_), np.empty(joints, dtype=np.bool_)
    members = np.empty(joints, dtype=np.bool_)
    for s in range(bodies):
        for j in range(joints):
            members[j] = bank.member[s, j] > 0.0
        for j in range(joints):
            observed[j] = np.isfinite(positions[s, j, 0] + positions[s, j, 1] + positions[s, j, 2])
            known[j] = bank.since[s, j, last] >= 0
            bank.confidence[s, j, slot] = confidence[s, j] if observed[j] else 0.0
            bank.since[s, j, slot] = 0.0 if observed[j] else bank.since[s, j, last] + 1.0 if known[j] else -1.0
            for axis in range(3):
                for k in range(_HISTORY - 1):
                    bank.recent[s, j, k, axis] = bank.recent[s, j, k + 1, axis]
                came = positions[s, j, axis] if observed[j] else np.nan
                bank.recent[s, j, _HISTORY - 1, axis] = came
                bank.raw[s, j, slot, axis] = bank.raw[s, j, last, axis] if known[j] and not observed[j] else came
            if observed[j]:
                _measure_differences(bank.recent[s, j], bank.sizes[s, j], bank.age[s, j])
        if observed.any():
            for j in range(joints):
                bank.streak[s, j] = bank.streak[s, j] + 1.0 if observed[j] else 0.0
                held, settled = bank.since[s, j, slot] <= HELD, bank.streak[s, j] > SETTLED
                members[j] = known[j] and (held if bank.member[s, j] > 0.0 else settled)
            _change_body(bank, s, members, covariance)
        _track(bank, s, slot, last, step, positions[s], confidence[s], observed, known, members, densities, sigma)


@njit(cache=True)
def _change_body(bank, s, members, covariance):
    """Form the body's modes from these joints (J,), unless they already do."""
    changed = False
    for j in range(len(members)):
        changed |= members[j] != (bank.member[s, j] > 0.0)
        bank.member[s, j] = 1.0 if members[j] else 0.0
    if not changed:
        return
    by = regroup(members, covariance, bank.modes[s], bank.eigenvalue[s])
    squared, joints = by * by, len(members)
    turn(bank.position[s].reshape(joints, -1), by)
    turn(bank.velocity[s].reshape(joints, -1), by)
    turn(bank.variance[s].reshape(joints, -1), squared)
    turn(bank.with_position[s].reshape(joints, -1), squared)
    turn(bank.with_velocity[s].reshape(joints, -1), squared)
    turn(bank.velocity_variance[s], squared)
    turn(bank.squared_innovations[s], squared)
    turn(bank.log_variances[s], squared)
    turn(bank.observations[s].reshape(joints, -1), squared)


@njit(cache=True)
def _track(bank, s, slot, last, step, positions, confidence, observed, known, members, densities, sigma):
    """Predict and update all filters of a body. The track of a single joint has that joint's index."""
    joints, modes = len(observed), bank.modes[s]
    weight, variance, updated = np.empty(joints), np.empty(joints), np.empty(joints, dtype=np.bool_)
    measured, filled = np.zeros((joints, 3)), np.empty((joints, 3))
    best = weigh(confidence, observed, members, weight)
    for t in range(joints):
        share = 0.0
        for j in range(joints):
            if modes[j, t] != 0.0 and weight[j] > 0.0:
                share += modes[j, t] ** 2 * weight[j]
                for axis in range(3):
                    measured[t, axis] += modes[j, t] * weight[j] * positions[j, axis]
        updated[t] = share > 0.0
        own = best if members[t] else clipped(confidence[t])
        variance[t] = (sigma / own) ** 2 / max(share, 1e-3) if updated[t] else 0.0
        if known[t]:
            predict(
                bank.position[s, t], bank.variance[s, t], bank.with_position[s, t], bank.with_velocity[s, t],
                bank.velocity[s, t], bank.velocity_variance[s, t], slot, last, step, bank.eigenvalue[s, t] * densities,
            )  # fmt: skip
            if updated[t]:
                bank.observations[s, t] = (1.0 - 1.0 / MEMORY) * bank.observations[s, t] + 1.0
    for m in range(len(densities)):
        for t in range(joints):
            for axis in range(3):
                filled[t, axis] = measured[t, axis]
        for j in range(joints):
            if members[j] and weight[j] < 1.0:
                fill_in(filled, modes, j, 1.0 - weight[j], bank.position[s, :, m, slot])
        for t in range(joints):
            if updated[t]:
                update(
                    bank.position[s, t, m], bank.variance[s, t, m], bank.with_position[s, t, m],
                    bank.with_velocity[s, t, m], bank.velocity[s, t, m], bank.velocity_variance[s, t, m : m + 1],
                    bank.squared_innovations[s, t, m : m + 1], bank.log_variances[s, t, m : m + 1],
                    slot, known[t], filled[t], variance[t],
                )  # fmt: skip


@njit(cache=True)
def _measure_differences(recent, sizes, age):
    """Update the running means of the logarithms of the `LAGS` differences of raw positions (7, 3)."""
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


@njit(cache=True)
def multiple_model_weights(squared_innovations, log_variances, observations, expected, counts, weights):
    """Write the smoothers' weights in the multiple-model estimate of one track: their normalised likelihoods.

    Args:
        squared_innovations: (M,) sums of one track, see `Bank`.
        log_variances: (M,) sums of one track, see `Bank`.
        observations: number of observations in these sums.
        expected: variance of the measurement noise in the other tracks, in units of `MEASUREMENT_SIGMA` squared.
        counts: weight of ``expected``, observations.
        weights: (M,), written; they sum to 1.

    Returns:
        The estimated variance of the measurement noise, in the same units.
    """
    most, noise, total = -np.inf, 0.0, observations + counts
    for m in range(len(weights)):
        scale = (squared_innovations[m] + counts * expected) / total if total > 0.0 else 1.0
        weights[m] = -1.5 * (total * np.log(scale) + log_variances[m])
        most = max(most, weights[m])
    sum_of_weights = 0.0
    for m in range(len(weights)):
        weights[m] = np.exp(weights[m] - most)
        sum_of_weights += weights[m]
    for m in range(len(weights)):
        weights[m] /= sum_of_weights
        noise += weights[m] * ((squared_innovations[m] + counts * expected) / total if total > 0.0 else 1.0)
    return noise
