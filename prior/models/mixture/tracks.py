"""The filters of a bank, on tracks: modes of the whole body, or joints by themselves.

The joints of a body accelerate together. In the basis of the eigenvectors of the covariance of their accelerations,
constant-velocity Kalman filters of the whole body fall apart into one for each mode, whose process density is in
proportion to its eigenvalue; white noise of the joints is white noise of the modes. So a mode in which bodies hardly
move is smoothed far, and one in which they do is followed.

That holds where all joints are seen equally well. A joint that is missed for a few frames stays in the body and is
taken to be where it is predicted; of one of little confidence that is so in part. Modes then have the more noise, the
less of them was measured. A joint missed for longer is a track by itself until it has settled, and
the modes are those of the other joints: the eigenvectors of their part of the covariance. Of the states' covariance
only the diagonal is kept through such a change.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import load_weights

MEMORY = 9
"""Time constant of the likelihoods' exponential forgetting, in sightings: 5 to 15 differ by 3 % at most
(validation)."""

MIN_SCALE = 1e-4
"""Added to every normalised squared innovation: a floor of the noise at a hundredth of `MEASUREMENT_SIGMA`."""

HELD, SETTLED = 3, 4
"""Frames after which a joint that is missed leaves the body, and for which one is seen before it is of it."""

MIN_EIGENVALUE = 1e-5
"""Of a mode, relative to the joints' mean variance: no mode is rigid."""

INITIAL_SPEED = 1.0
"""m/s along an axis, standard deviation of a new joint's velocity."""


@cache
def body_covariance(name: str = "default") -> Floats:
    """(22, 22) covariance of joints' accelerations along an axis, relative to their mean variance; read-only.

    Six of its eigenvectors hold five sixths of it. It is the same for x, y and z, so that it does not depend on the
    body's heading, and is learned from training motion (`training.recipes.moments`).

    Args:
        name: a weight set or a path, as of `load_weights`.
    """
    covariance = load_weights(name, "body_modes")[0]["covariance"].astype(np.float64)
    covariance.flags.writeable = False
    return covariance


@njit(cache=True)
def clipped(confidence):
    """A confidence in the range in which noise is inversely proportional to it."""
    return min(max(confidence, 0.1), 1.0)


@njit(cache=True)
def weigh(confidence, seen, members, weight):
    """Write the weights (J,) of the joints' measurements, inverse to their variances, the largest in a body 1; return
    the greatest confidence in it."""
    most = 0.0
    for j in range(len(weight)):
        if members[j] and seen[j]:
            most = max(most, clipped(confidence[j]))
    for j in range(len(weight)):
        own = clipped(confidence[j]) / most if members[j] else 1.0
        weight[j] = own * own if seen[j] else 0.0
    return most


@njit(cache=True)
def fill_in(filled, modes, joint, share, tracks):
    """Add to the tracks' measurements (J, 3) this share of where they (J, 3) predict a joint: so much of it is not
    measured."""
    for axis in range(3):
        ahead = 0.0
        for t in range(len(filled)):
            ahead += modes[joint, t] * tracks[t, axis]
        for t in range(len(filled)):
            filled[t, axis] += modes[joint, t] * share * ahead


@njit(cache=True)
def regroup(members, covariance, modes, eigenvalues):
    """Let these joints form the body, and track all others by themselves.

    Args:
        members: (J,) of the body.
        covariance: (J, J) of joints' accelerations.
        modes: (J, J) joints by tracks, written.
        eigenvalues: (J,) of the tracks, written.

    Returns:
        (J, J) by which the tracks so far are to be multiplied.
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
    """Predict all filters of a track into ``slot``."""
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
    """Update one filter and its smoother; a track not ``known`` begins."""
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
