"""The experts of the mixture, and what tells them apart: a bank of fixed-lag smoothers, and the features of a frame.

Every joint is followed by constant-velocity Kalman filters that differ in the density of their process noise, each with
the smoother of its last frames (see `FixedLagRTS`, of which these are many side by side). A stiff one
averages noise away and lags behind what is quick; a loose one follows all, noise too. That is the bank of
multiple-model estimation (Bar-Shalom, Li and Kirubarajan 2001, section 11.6), without its weights: they come from a
network (`prior.models.mixture.network`), which reads `FEATURES` numbers of every joint.

The features do not change when the body stands elsewhere or faces elsewhere: they are lengths, and vectors in the frame
of the body's heading. Training and the live node run this very code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS, J
from steadypose.prior.timing.rate import FPS

DENSITIES = np.array([0.01, 0.045, 0.2, 0.9, 4.0, 15.0, 60.0])
"""m²/s³, process densities of the smoothers, stiff to loose, for a measurement of `MEASUREMENT_SIGMA`."""

MEASUREMENT_SIGMA = 0.02
"""Metres along an axis, at full confidence. Only its ratio to the density matters."""

EXPERTS = len(DENSITIES) + 1
"""The smoothers, and the joint as it came: where it was last, if it is not seen."""

RAW = EXPERTS - 1
MIDDLE = 3
"""The expert from which a body's pose is read,"""
LOOSE = 4
"""the one whose distance to what came measures the noise,"""
STEADY = 2
"""and the one that tells where the body faces."""

QUICK, SLOW, LONG = 3, 18, 30
"""Frames of the running means."""

LEAST = 3e-4
"""Metres: what is smaller than this is nothing, in logarithms."""

INITIAL_SPEED = 1.0
"""m/s, standard deviation of a new joint's velocity."""

PACE = 2.0
"""m/s, the unit of velocities."""

_LAGS = ((1, 1), (2, 1), (3, 1), (2, 3))
"""Order and spacing in frames of the differences of what came, whose sizes tell noise from motion."""
_HISTORY = 7
_CENTIMETRES = float(np.log(100.0))

_DELAYS = (0, 1, 2, 4, 8)
FEATURES = 3 * RAW + len(_LAGS) + 6 + 6 + 3 * RAW + 5 + len(_DELAYS) + 1
"""Of each joint: three logarithms of the distance between neighbouring experts, sizes of differences, bone, pose,
the vectors between neighbouring experts, sighting, delay."""
_SIZES = 6 * RAW
_BONE = _SIZES + len(_LAGS)
_POSE = _BONE + 6
_SIGHTING = _POSE + 6
"""where these begin"""


class Bank(NamedTuple):
    """State of S bodies, J joints, M smoothers and K frames: the delay and the newest.

    Attributes:
        position: (S, J, M, K, 3) metres, of each frame given all measurements so far.
        with_position, with_velocity: (S, J, M, K) covariance of that with the newest position and velocity.
        velocity: (S, J, M, 3) m/s, and ``velocity_variance`` (S, J, M).
        raw: (S, J, K, 3) metres, what came, or came last; NaN before.
        unseen: (S, J, K) frames for which the joint had not been seen by then, -1 before it was first seen.
        confidence: (S, J, K).
        recent: (S, J, 7, 3) metres, what came in the last frames, NaN where unseen.
        apart: (S, J, M, 2) metres², running means of the squared distances between neighbouring experts.
        noise: (S, J) metres², that of the loose expert to what came.
        sizes: (S, J, 4) running means of the logarithms of differences of what came.
        length: (S, J, 2) metres and metres², running mean of each bone's length, and of its deviation squared.
        place: (S, J, 3) metres, the pose of the last frame described; NaN before.
        age: (S, J, 3) how many frames the running means are of: experts, differences, bones.
        heading: (S, 2) cosine and sine of where the body faces.
    """

    position: NDArray[np.float64]
    with_position: NDArray[np.float64]
    with_velocity: NDArray[np.float64]
    velocity: NDArray[np.float64]
    velocity_variance: NDArray[np.float64]
    raw: NDArray[np.float64]
    unseen: NDArray[np.float64]
    confidence: NDArray[np.float64]
    recent: NDArray[np.float64]
    apart: NDArray[np.float64]
    noise: NDArray[np.float64]
    sizes: NDArray[np.float64]
    length: NDArray[np.float64]
    place: NDArray[np.float64]
    age: NDArray[np.float64]
    heading: NDArray[np.float64]


def new_bank(bodies: int, delay: int) -> Bank:
    """A bank that has seen nothing, for ``bodies`` slots and a delay in frames."""
    experts, joints, frames = len(DENSITIES), len(PARENTS), delay + 1
    bank = Bank(
        position=np.empty((bodies, joints, experts, frames, 3)),
        with_position=np.empty((bodies, joints, experts, frames)),
        with_velocity=np.empty((bodies, joints, experts, frames)),
        velocity=np.empty((bodies, joints, experts, 3)),
        velocity_variance=np.empty((bodies, joints, experts)),
        raw=np.empty((bodies, joints, frames, 3)),
        unseen=np.empty((bodies, joints, frames)),
        confidence=np.empty((bodies, joints, frames)),
        recent=np.empty((bodies, joints, _HISTORY, 3)),
        apart=np.empty((bodies, joints, experts, 2)),
        noise=np.empty((bodies, joints)),
        sizes=np.empty((bodies, joints, len(_LAGS))),
        length=np.empty((bodies, joints, 2)),
        place=np.empty((bodies, joints, 3)),
        age=np.empty((bodies, joints, 3)),
        heading=np.empty((bodies, 2)),
    )
    forget(bank, np.ones(bodies, dtype=bool))
    return bank


def forget(bank: Bank, slot: NDArray[np.bool_]) -> None:
    """Start these slots (S,) afresh."""
    for values in bank:
        values[slot] = 0.0
    for values in (bank.position, bank.raw, bank.recent, bank.place):
        values[slot] = np.nan
    bank.unseen[slot] = -1.0
    bank.heading[slot] = (1.0, 0.0)


@njit(cache=True, error_model="numpy")
def advance(bank, count, step, positions, confidence, densities, sigma):
    """Take a frame in.

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
            for m in range(experts):
                position, with_position = bank.position[s, j, m], bank.with_position[s, j, m]
                with_velocity, velocity = bank.with_velocity[s, j, m], bank.velocity[s, j, m]
                if not known:
                    if seen:
                        for k in range(frames):
                            with_position[k] = with_velocity[k] = 0.0
                        for axis in range(3):
                            position[slot, axis] = positions[s, j, axis]
                            velocity[axis] = 0.0
                        with_position[slot] = variance
                        bank.velocity_variance[s, j, m] = INITIAL_SPEED**2
                    continue
                own = bank.velocity_variance[s, j, m]
                growth, covariance = densities[m] * step, with_velocity[last]
                ahead = with_position[last] + step * (2 * covariance + step * (own + growth / 3))
                for k in range(frames):
                    with_position[k] += step * with_velocity[k]
                for axis in range(3):
                    position[slot, axis] = position[last, axis] + step * velocity[axis]
                with_position[slot] = ahead
                covariance = with_velocity[slot] = covariance + step * (own + growth / 2)
                bank.velocity_variance[s, j, m] = own = own + growth
                if not seen:
                    continue
                total = ahead + variance
                a = positions[s, j, 0] - position[slot, 0]
                b = positions[s, j, 1] - position[slot, 1]
                c = positions[s, j, 2] - position[slot, 2]
                for k in range(frames):
                    gain = with_position[k] / total
                    position[k, 0] += gain * a
                    position[k, 1] += gain * b
                    position[k, 2] += gain * c
                    with_position[k] -= gain * ahead
                    with_velocity[k] -= gain * covariance
                gain = covariance / total
                velocity[0] += gain * a
                velocity[1] += gain * b
                velocity[2] += gain * c
                bank.velocity_variance[s, j, m] = own - gain * covariance


@njit(cache=True, error_model="numpy")
def _measure_differences(recent, sizes, age):
    """Running means of the logarithms of the sizes of `_LAGS`' differences of what came (7, 3)."""
    n = _HISTORY - 1
    found = np.zeros(4)
    for axis in range(3):
        a, b, c, d = recent[n, axis], recent[n - 1, axis], recent[n - 2, axis], recent[n - 3, axis]
        found[0] += (a - b) ** 2
        found[1] += (a - 2 * b + c) ** 2
        found[2] += (a - 3 * b + 3 * c - d) ** 2
        found[3] += (a - 2 * d + recent[n - 6, axis]) ** 2
    if np.isfinite(found[2]):
        age[1] += 1.0
        for k in range(4):
            if np.isfinite(found[k]):
                value = 0.5 * np.log(found[k] + LEAST**2)
                sizes[k] += (value - sizes[k]) / min(age[1], SLOW)
            elif age[1] < 4:
                sizes[k] = 0.5 * np.log(found[1] + LEAST**2)


@njit(cache=True, error_model="numpy")
def _log(square):
    """How large a square of metres is, in powers of e of a centimetre, its root."""
    return 0.5 * np.log(square + LEAST**2) + _CENTIMETRES


@njit(cache=True, error_model="numpy")
def describe(bank, count, back, parents, experts, features, scale):
    """What a frame's experts say, and the features that their weights are to be read from; running means go on.

    Every frame is to be described once, in order.

    Args:
        bank: a `Bank`.
        count: frames taken in, the newest included.
        back: how many frames before the newest.
        parents: of the joints, the root's being 0.
        experts: (S, J, EXPERTS, 3) metres, written; NaN of a joint not yet seen.
        features: (S, J, FEATURES) float32, written.
        scale: (S,) metres along an axis, the noise found; written.
    """
    bodies, joints, _, frames, _ = bank.position.shape
    slot = (count - 1 - back) % frames
    for s in range(bodies):
        total, seen_joints = 0.0, 0.0
        for j in range(joints):
            for m in range(RAW):
                for axis in range(3):
                    experts[s, j, m, axis] = bank.position[s, j, m, slot, axis]
            for axis in range(3):
                experts[s, j, RAW, axis] = bank.raw[s, j, slot, axis]
            if bank.unseen[s, j, slot] == 0.0:
                bank.age[s, j, 0] += 1.0
                for m in range(RAW):
                    square = 0.0
                    for axis in range(3):
                        square += (experts[s, j, m, axis] - experts[s, j, m + 1, axis]) ** 2
                    for k, memory in enumerate((QUICK, SLOW)):
                        bank.apart[s, j, m, k] += (square - bank.apart[s, j, m, k]) / min(bank.age[s, j, 0], memory)
                square = 0.0
                for axis in range(3):
                    square += (experts[s, j, LOOSE, axis] - experts[s, j, RAW, axis]) ** 2
                bank.noise[s, j] += (square - bank.noise[s, j]) / min(bank.age[s, j, 0], SLOW)
            if bank.age[s, j, 0] > 0.0:
                total += bank.noise[s, j]
                seen_joints += 1.0
        scale[s] = np.sqrt(total / max(seen_joints, 1.0) / 3.0) + LEAST
        _face(experts[s], bank.heading[s])
        unseen = bank.unseen[s, :, slot]
        for j in range(joints):
            _describe_sighting(
                unseen[j], bank.confidence[s, j, slot], bank.age[s, j, 0], back, scale[s], features[s, j]
            )
            if unseen[j] >= 0.0:
                _describe_experts(experts[s, j], bank.apart[s, j], bank.heading[s], scale[s], features[s, j])
                if bank.age[s, j, 1] > 0.0:
                    for k in range(len(_LAGS)):
                        features[s, j, _SIZES + k] = bank.sizes[s, j, k] + _CENTIMETRES
                length, age, heading = bank.length[s, j], bank.age[s, j], bank.heading[s]
                _describe_bone(j, parents[j], unseen, length, age, experts[s], heading, scale[s], features[s, j])
                _describe_pose(j, unseen[0], experts[s], bank.place[s, j], heading, features[s, j])
        for j in range(joints):
            for axis in range(3):
                bank.place[s, j, axis] = experts[s, j, MIDDLE, axis]


@njit(cache=True, error_model="numpy")
def _face(experts, heading):
    """Where the body faces, from hips and shoulders, what is known of them."""
    x, y = 0.0, 0.0
    for left, right in ((_LEFT_HIP, _RIGHT_HIP), (_LEFT_SHOULDER, _RIGHT_SHOULDER)):
        a = experts[left, STEADY, 0] - experts[right, STEADY, 0]
        b = experts[left, STEADY, 1] - experts[right, STEADY, 1]
        if np.isfinite(a) and np.isfinite(b):
            x += a
            y += b
    length = np.sqrt(x * x + y * y)
    if length > 1e-6:
        heading[0], heading[1] = y / length, -x / length


@njit(cache=True, error_model="numpy")
def _turned(heading, x, y, z, unit, features, at):
    """Write a vector in the body's frame, in ``unit``, large ones compressed."""
    features[at] = np.arcsinh((heading[0] * x + heading[1] * y) / unit)
    features[at + 1] = np.arcsinh((heading[0] * y - heading[1] * x) / unit)
    features[at + 2] = np.arcsinh(z / unit)


# Each writes its part of a joint's features. None is handed the bank: its 16 arrays take a second more to compile.


@njit(cache=True, error_model="numpy")
def _describe_sighting(unseen, confidence, age, back, scale, features):
    """How the joint was seen, and the delay; the rest is 0 for a joint never seen."""
    for k in range(FEATURES):
        features[k] = 0.0
    at = FEATURES - len(_DELAYS) - 1
    for k, delay in enumerate(_DELAYS):
        features[at + k] = 1.0 / (1.0 + (back - delay) ** 2)
    features[at + len(_DELAYS)] = back / 16.0
    if unseen < 0.0:
        return
    features[_SIGHTING] = 1.0 if unseen == 0.0 else 0.0
    features[_SIGHTING + 1] = np.log(1.0 + unseen)
    features[_SIGHTING + 2] = confidence
    features[_SIGHTING + 3] = 1.0 / (1.0 + age / 10.0)
    features[_SIGHTING + 4] = np.log(scale / 0.01)


@njit(cache=True, error_model="numpy")
def _describe_experts(own, apart, heading, scale, features):
    """How far neighbouring experts (M + 1, 3) are from each other, now and of late, and which way."""
    for m in range(RAW):
        x, y, z = own[m, 0] - own[m + 1, 0], own[m, 1] - own[m + 1, 1], own[m, 2] - own[m + 1, 2]
        features[3 * m] = _log(x * x + y * y + z * z)
        features[3 * m + 1], features[3 * m + 2] = _log(apart[m, 0]), _log(apart[m, 1])
        _turned(heading, x, y, z, scale, features, 3 * RAW + 3 * m)


@njit(cache=True, error_model="numpy")
def _describe_pose(j, unseen_root, experts, place, heading, features):
    """Where the joint is beside the root, and how it has moved since the last frame."""
    x, y, z = experts[j, MIDDLE, 0], experts[j, MIDDLE, 1], experts[j, MIDDLE, 2]
    if unseen_root >= 0.0:
        a, b, c = experts[0, MIDDLE, 0], experts[0, MIDDLE, 1], experts[0, MIDDLE, 2]
        _turned(heading, x - a, y - b, z - c, 0.5, features, _POSE)
    if np.isfinite(place[0]):
        _turned(heading, x - place[0], y - place[1], z - place[2], PACE / FPS, features, _POSE + 3)


@njit(cache=True, error_model="numpy")
def _describe_bone(j, parent, unseen, length, age, experts, heading, scale, features):
    """The bone to a joint: how its length varies, and by how much, and where to, it is too long now."""
    if parent == j or unseen[parent] < 0.0:
        return
    came, middle = 0.0, 0.0
    for axis in range(3):
        came += (experts[j, RAW, axis] - experts[parent, RAW, axis]) ** 2
        middle += (experts[j, MIDDLE, axis] - experts[parent, MIDDLE, axis]) ** 2
    came, middle = np.sqrt(came), np.sqrt(middle)
    if unseen[j] == 0.0 and unseen[parent] == 0.0:
        age[2] += 1.0
        length[0] += (came - length[0]) / min(age[2], LONG)
        length[1] += ((came - length[0]) ** 2 - length[1]) / min(age[2], LONG)
    if age[2] == 0.0:
        return
    features[_BONE] = _log(length[1])
    features[_BONE + 1] = np.arcsinh((came - length[0]) / scale)
    features[_BONE + 2] = np.arcsinh((middle - length[0]) / scale)
    long = (middle - length[0]) / max(middle, 1e-3)
    x = experts[j, MIDDLE, 0] - experts[parent, MIDDLE, 0]
    y = experts[j, MIDDLE, 1] - experts[parent, MIDDLE, 1]
    z = experts[j, MIDDLE, 2] - experts[parent, MIDDLE, 2]
    _turned(heading, long * x, long * y, long * z, scale, features, _BONE + 3)


PARENT = np.maximum(np.array(PARENTS), 0)
_LEFT_HIP, _RIGHT_HIP = J["left_hip"], J["right_hip"]
_LEFT_SHOULDER, _RIGHT_SHOULDER = J["left_shoulder"], J["right_shoulder"]
