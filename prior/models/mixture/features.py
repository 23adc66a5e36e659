"""What the network of the mixture reads of a frame: `FEATURES` numbers of every joint.

They do not change when the body stands elsewhere or faces elsewhere: they are lengths, and vectors in the frame
of the body's heading.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from steadypose.prior.body.skeleton import PARENTS, J
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    LAGS,
    LEAST,
    MEASUREMENT_SIGMA,
    PREDICTED,
    RAW,
    SLOW,
    weigh_by_predictions,
)
from steadypose.prior.timing.rate import FPS

MIDDLE = 3
"""The expert from which a body's pose is read,"""
LOOSE = 4
"""the one whose distance to what came measures the noise,"""
STEADY = 2
"""and the one that tells where the body faces."""

QUICK, LONG = 3, 30
"""Frames of the running means, beside `SLOW`."""

PACE = 2.0
"""m/s, the unit of velocities."""

MAX_NOISE = 0.3
"""Metres: what one frame adds to the noise found, at most; beyond that, the gate has let a bad one through."""

_CENTIMETRES = float(np.log(100.0))
_DELAYS = (0, 1, 2, 4, 8)
_SMOOTHERS = len(DENSITIES)
_LOG_DENSITIES = np.log(DENSITIES)

_VECTORS = 3 * _SMOOTHERS
_SIZES = 2 * _VECTORS
_BONE = _SIZES + len(LAGS)
_POSE = _BONE + 6
_PREDICTED = _POSE + 6
_SIGHTING = _PREDICTED + 6
_DELAY = _SIGHTING + 6
"""Where these begin: logarithms of the distance between neighbouring experts (the smoothers, stiff to loose, and the
joint as it came), three of each; vectors between these; sizes of differences; bone; pose; what predictions say;
sighting; delay."""
FEATURES = _DELAY + len(_DELAYS) + 1
"""Of each joint."""


@njit(cache=True, error_model="numpy")
def _log(square):
    """How large a square of metres is, in powers of e of a centimetre, its root."""
    return 0.5 * np.log(square + LEAST**2) + _CENTIMETRES


@njit(cache=True, error_model="numpy")
def describe(bank, count, back, parents, experts, features, scale, gap, between):
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
        gap: (S, J) frames to the nearest sighting, before or since; 0 of a joint seen, -1 not yet seen; written.
        between: (S, J) metres along an axis, deviation of the mean by predictions of a joint that is not seen, though
            others of the body are, and was seen since; elsewhere 0; written.
    """
    bodies, joints, _, frames, _ = bank.position.shape
    slot = (count - 1 - back) % frames
    weights, noise = np.empty((joints, _SMOOTHERS)), np.empty(joints)
    for s in range(bodies):
        total, seen_joints = 0.0, 0.0
        for j in range(joints):
            noise[j] = weigh_by_predictions(bank.misfit[s, j], bank.spread[s, j], bank.sightings[s, j], weights[j])
            _say(bank.position[s, j, :, slot], bank.raw[s, j, slot], weights[j], experts[s, j])
            gap[s, j], between[s, j] = bank.unseen[s, j, slot], 0.0
            if gap[s, j] > 0.0:
                for since in range(1, back + 1):
                    if bank.unseen[s, j, (slot + since) % frames] == 0.0:
                        gap[s, j] = min(gap[s, j], since)
                        scales = bank.misfit[s, j] / max(bank.sightings[s, j], 1.0)
                        between[s, j] = _deviation(experts[s, j], weights[j], bank.variance[s, j, :, slot], scales)
                        break
            if gap[s, j] == 0.0:
                bank.age[s, j, 0] += 1.0
                for m in range(_SMOOTHERS):
                    square = _square(experts[s, j, m], experts[s, j, _looser(m)])
                    for k, memory in enumerate((QUICK, SLOW)):
                        bank.apart[s, j, m, k] += (square - bank.apart[s, j, m, k]) / min(bank.age[s, j, 0], memory)
                square = min(_square(experts[s, j, LOOSE], experts[s, j, RAW]), MAX_NOISE**2)
                bank.noise[s, j] += (square - bank.noise[s, j]) / min(bank.age[s, j, 0], SLOW)
            if bank.age[s, j, 0] > 0.0:
                total += bank.noise[s, j]
                seen_joints += 1.0
        scale[s] = np.sqrt(total / max(seen_joints, 1.0) / 3.0) + LEAST
        if not (gap[s] == 0.0).any():
            between[s] = 0.0
        _face(experts[s], bank.heading[s])
        unseen = bank.unseen[s, :, slot]
        for j in range(joints):
            confidence, age = bank.confidence[s, j, slot], bank.age[s, j]
            _describe_sighting(unseen[j], gap[s, j], confidence, age[0], back, scale[s], features[s, j])
            if unseen[j] >= 0.0:
                heading = bank.heading[s]
                _describe_experts(experts[s, j], bank.apart[s, j], heading, scale[s], features[s, j])
                _describe_predictions(experts[s, j], weights[j], noise[j], heading, scale[s], features[s, j])
                if age[1] > 0.0:
                    for k in range(len(LAGS)):
                        features[s, j, _SIZES + k] = bank.sizes[s, j, k] + _CENTIMETRES
                length = bank.length[s, j]
                _describe_bone(j, parents[j], unseen, length, age, experts[s], heading, scale[s], features[s, j])
                _describe_pose(j, unseen[0], experts[s], bank.place[s, j], heading, features[s, j])
        for j in range(joints):
            for axis in range(3):
                bank.place[s, j, axis] = experts[s, j, MIDDLE, axis]


@njit(cache=True, error_model="numpy")
def _say(smoothed, raw, weights, experts):
    """Write a joint's experts (EXPERTS, 3), from its smoothers' places (M, 3), their weights, and the joint as it
    came."""
    for axis in range(3):
        experts[PREDICTED, axis] = 0.0
        for m in range(_SMOOTHERS):
            experts[m, axis] = smoothed[m, axis]
            experts[PREDICTED, axis] += weights[m] * smoothed[m, axis]
        experts[RAW, axis] = raw[axis]


@njit(cache=True, error_model="numpy")
def _deviation(experts, weights, variance, scales):
    """Of the mean by predictions, along an axis: what each smoother is off by, at the noise that its innovations show,
    and what they differ by."""
    total = 0.0
    for m in range(_SMOOTHERS):
        total += weights[m] * (scales[m] * variance[m] + _square(experts[m], experts[PREDICTED]) / 3.0)
    return np.sqrt(total)


@njit(cache=True)
def _looser(m):
    """The next expert of those that are neighbours."""
    return m + 1 if m + 1 < _SMOOTHERS else RAW


@njit(cache=True, error_model="numpy")
def _square(a, b):
    """Of the distance between two places (3,)."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


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


# Each writes its part of a joint's features. None is handed the bank: its 19 arrays take a second more to compile.


@njit(cache=True, error_model="numpy")
def _describe_sighting(unseen, gap, confidence, age, back, scale, features):
    """How the joint was seen, and the delay; the rest is 0 for a joint never seen."""
    for k in range(FEATURES):
        features[k] = 0.0
    for k, delay in enumerate(_DELAYS):
        features[_DELAY + k] = 1.0 / (1.0 + (back - delay) ** 2)
    features[_DELAY + len(_DELAYS)] = back / 16.0
    if unseen < 0.0:
        return
    features[_SIGHTING] = 1.0 if unseen == 0.0 else 0.0
    features[_SIGHTING + 1] = np.log(1.0 + unseen)
    features[_SIGHTING + 2] = confidence
    features[_SIGHTING + 3] = 1.0 / (1.0 + age / 10.0)
    features[_SIGHTING + 4] = np.log(scale / 0.01)
    features[_SIGHTING + 5] = np.log(1.0 + gap)


@njit(cache=True, error_model="numpy")
def _describe_experts(own, apart, heading, scale, features):
    """How far neighbouring experts (M + 1, 3) are from each other, now and of late, and which way."""
    for m in range(_SMOOTHERS):
        looser = own[_looser(m)]
        features[3 * m] = _log(_square(own[m], looser))
        features[3 * m + 1], features[3 * m + 2] = _log(apart[m, 0]), _log(apart[m, 1])
        x, y, z = own[m, 0] - looser[0], own[m, 1] - looser[1], own[m, 2] - looser[2]
        _turned(heading, x, y, z, scale, features, _VECTORS + 3 * m)


@njit(cache=True, error_model="numpy")
def _describe_predictions(own, weights, noise, heading, scale, features):
    """Where the mean by predictions is beside the middle expert, how stiff it is, and the noise that it found."""
    features[_PREDICTED] = _log(_square(own[PREDICTED], own[MIDDLE]))
    features[_PREDICTED + 1] = 0.5 * np.log(noise + 1e-4) + np.log(MEASUREMENT_SIGMA / 0.01)
    features[_PREDICTED + 2] = 0.0
    for m in range(_SMOOTHERS):
        features[_PREDICTED + 2] += weights[m] * _LOG_DENSITIES[m]
    x, y, z = own[PREDICTED, 0] - own[MIDDLE, 0], own[PREDICTED, 1] - own[MIDDLE, 1], own[PREDICTED, 2] - own[MIDDLE, 2]
    _turned(heading, x, y, z, scale, features, _PREDICTED + 3)


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
