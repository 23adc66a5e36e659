"""The filters of a bank, applied to tracks: modes of the whole body, or single joints.

The joints of a body accelerate together. In the basis of the eigenvectors of their accelerations' covariance, a
constant-velocity Kalman filter of the whole body separates into one filter per mode, with a process density
proportional to the mode's eigenvalue. White noise of the joints is white noise of the modes. Modes in which bodies
hardly move are therefore smoothed strongly, and modes in which they move are followed.

This holds if all joints are observed equally well. A joint that is missing for a few frames stays in the body, and its
prediction replaces the measurement. For a joint of low confidence, this happens in part. The less of a mode is
measured, the larger its noise. A joint that is missing for longer becomes a track of its own until it has settled, and
the modes are then the eigenvectors of the other joints' part of the covariance. Such a change keeps only the diagonal
of the states' covariance.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import load_weights

MEMORY = 9
"""Time constant of the likelihoods' exponential forgetting, observations; 5 to 15 differ by at most 3 %
(validation)."""

MIN_SCALE = 1e-4
"""Term added to each normalised squared innovation; it limits the noise to at least 1 % of `MEASUREMENT_SIGMA`."""

HELD, SETTLED = 3, 4  # numbers of frames for which a joint must be missing to leave the body, and observed to join it
MIN_EIGENVALUE = 1e-5  # least eigenvalue of a mode relative to the joints' mean variance, because no mode is rigid
INITIAL_SPEED = 1.0  # standard deviation of a new joint's velocity along an axis, m/s


@cache
def body_covariance() -> Floats:
    """(22, 22) covariance of joints' accelerations along an axis, relative to their mean variance; read-only.

    Six of its eigenvectors explain five sixths of it. It is equal for x, y and z, so that it does not depend on the
    body's heading. It is learned from training motion (`training.recipes.moments`).
    """
    covariance = load_weights("default", "body_modes")[0]["covariance"].astype(np.float64)
    covariance.flags.writeable = False
    return covariance


@njit(cache=True)
def clipped(confidence):
    """Clip a confidence to the range in which noise is inversely proportional to it."""
    return min(max(confidence, 0.1), 1.0)


@njit(cache=True)
def weigh(confidence, observed, members, weight):
    """Write the weights (J,) of the joints' measurements, and return the largest confidence in the body.

    Weights are inverse to the variances of the measurements; the largest in a body is 1.
    """
    most = 0.0
    for j in range(len(weight)):
        if members[j] and observed[j]:
            most = max(most, clipped(confidence[j]))
    for j in range(len(weight)):
        own = clipped(confidence[j]) / most if members[j] else 1.0
        weight[j] = own * own if observed[j] else 0.0
    return most


@njit(cache=True)
def fill_in(filled, modes, joint, share, tracks):
    """Add a joint's unmeasured ``share`` to the measurements ``filled`` (J, 3), as predicted by ``tracks`` (J, 3)."""
    for axis in range(3):
        ahead = 0.0
        for t in range(len(filled)):
            ahead += modes[joint, t] * tracks[t, axis]
        for t in range(len(filled)):
            filled[t, axis] += modes[joint, t] * share * ahead


@njit(cache=True)
def regroup(members, covariance, modes, eigenvalues):
    """Form the body's modes from these joints, and give each other joint a track of its own.

    Args:
        members: (J,) which joints form the body.
        covariance: (J, J) covariance of joints' accelerations.
        modes: (J, J) joints by tracks, written.
        eigenvalues: (J,) eigenvalues of the tracks, written.

    Returns:
        (J, J) matrix that converts the previous tracks to the new ones.
    """
    joints, before, among = len(members), modes.copy(), np.flatnonzero(members)
    modes[:] = 0.0
    for j in range(joints):
        modes[j, j], eigenvalues[j] = 1.0, covariance[j, j]
    if len(among):
        part = np.empty((len(among), len(among)))
        for a in range(len(among)):
            for b in range(len(among)):
                part[a, b] = covariance[among[a], among[b]]
        values, vectors = np.linalg.eigh(part)
        for b in range(len(among)):
            eigenvalues[among[b]] = max(values[b], MIN_EIGENVALUE)
            for a in range(len(among)):
                modes[among[a], among[b]] = vectors[a, b]
    return np.dot(np.ascontiguousarray(modes.T), before)


@njit(cache=True)
def turn(values, by):
    """Multiply tracks' values (J, N), in place, by a matrix (J, J)."""
    turned = np.dot(by, values)
    for j in range(len(values)):
        for k in range(values.shape[1]):
            values[j, k] = turned[j, k]


@njit(cache=True)
def predict(
    position, own_variance, with_position, with_velocity, velocity, velocity_variance, slot, last, step, densities
):  # fmt: skip
    """Predict all filters of a track, and write the result to ``slot``."""
    for m in range(len(densities)):
        own = velocity_variance[m]
        growth, covariance = densities[m] * step, with_velocity[m, last]
        ahead = with_position[m, last] + step * (2 * covariance + step * (own + growth / 3))
        for k in range(position.shape[1]):
            with_position[m, k] += step * with_velocity[m, k]
        for axis in range(3):
            position[m, slot, axis] = position[m, last, axis] + step * velocity[m, axis]
        with_position[m, slot] = own_variance[m, slot] = ahead
        with_velocity[m, slot] = covariance + step * (own + growth / 2)
        velocity_variance[m] = own + growth


@njit(cache=True)
def update(
    position, own_variance, with_position, with_velocity, velocity, velocity_variance, squared_innovations,
    log_variances, slot, known, measured, variance,
):  # fmt: skip
    """Update one filter and its smoother. A track that is not ``known`` is initialised."""
    frames = len(position)
    if not known:
        for k in range(frames):
            with_position[k] = with_velocity[k] = 0.0
        for axis in range(3):
            position[slot, axis] = measured[axis]
            velocity[axis] = 0.0
        with_position[slot] = own_variance[slot] = variance
        velocity_variance[0] = INITIAL_SPEED**2
        return
    keep = 1.0 - 1.0 / MEMORY
    ahead, covariance = with_position[slot], with_velocity[slot]
    total = ahead + variance
    a, b, c = measured[0] - position[slot, 0], measured[1] - position[slot, 1], measured[2] - position[slot, 2]
    square = (a * a + b * b + c * c) / (3.0 * total)
    squared_innovations[0] = keep * squared_innovations[0] + square + MIN_SCALE
    log_variances[0] = keep * log_variances[0] + np.log(total)
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
    velocity_variance[0] -= gain * covariance
