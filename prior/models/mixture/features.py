"""Input features of the mixture's network, `FEATURES` numbers per joint and frame, and bounds of its outputs.

The features are invariant under translation and rotation about the vertical: they are lengths, and vectors in the frame
of the body's heading.
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.body.skeleton import PARENTS, J
from steadypose.prior.compiled import njit
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    LAGS,
    LOG_FLOOR,
    MEAN_FRAMES,
    MEASUREMENT_SIGMA,
    MULTIPLE_MODEL,
    RAW,
    SHARED,
    multiple_model_weights,
)
from steadypose.prior.timing.rate import FPS

POSE_EXPERT, NOISE_EXPERT, HEADING_EXPERT = 3, 4, 2
"""Indices of the smoothers that give the body's pose, the residuals for the noise estimate, and the heading."""

SHORT_MEAN_FRAMES, BONE_MEAN_FRAMES = 3, 30
"""Lengths of the short running mean of distances and of the running mean of bone lengths, frames; see `MEAN_FRAMES`."""

SPEED_UNIT = 2.0  # unit of velocities, m/s

MAX_NOISE = 0.3
"""Bound at which residuals are clipped in the noise estimate, metres; it limits outliers that passed the gate."""

_CENTIMETRES = float(np.log(100.0))
_DELAYS = (0, 1, 2, 4, 8)
_SMOOTHERS = len(DENSITIES)
_LOG_DENSITIES = np.log(DENSITIES)

_VECTORS = 3 * _SMOOTHERS
_SIZES = 2 * _VECTORS
_BONE = _SIZES + len(LAGS)
_POSE = _BONE + 6
_MULTIPLE_MODEL = _POSE + 6
_OBSERVED = _MULTIPLE_MODEL + 6
_DELAY = _OBSERVED + 6
"""Offsets of the groups of features. The groups are: three log-distances for each pair of neighbouring experts (the
smoothers by density, then the raw joint), vectors between these experts, sizes of differences, bone, pose,
multiple-model estimate, observation, and delay."""
FEATURES = _DELAY + len(_DELAYS) + 1  # number of features of a joint

OUTPUTS = 2 * EXPERTS + 4
"""Number of outputs of a joint: logits of the weights w, then b, the correction r (3), the log standard deviation."""

GATES = 3
"""Number of gates of a joint, the weights of the last frame's output: for w and b, for r, and for the deviation."""

REACH = 1.0  # bound of each b, which limits how far the estimate may leave the experts' convex hull
CORRECTION = 2.0  # bound of the correction along an axis, in units of the estimated noise
COASTING = 0.1  # least growth of a joint's standard deviation with the time to its nearest observation, m/s

MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 6.0
"""Range of the natural logarithm of the standard deviation, which is in millimetres."""


@njit(cache=True)
def _log(square):
    """Natural logarithm of a length in centimetres, given its square in m²."""
    return 0.5 * np.log(square + LOG_FLOOR**2) + _CENTIMETRES


@njit(cache=True)
def describe(bank, count, back, parents, whiteness, experts, features, scale, gap, between):
    """Write the experts and features of a frame, and update the running means. Call it once per frame, in order.

    Args:
        bank: a `Bank`.
        count: number of frames processed, including the newest.
        back: frames between the newest and this one.
        parents: (J,) parent of each joint; 0 for the root.
        whiteness: (S,) share of the noise that is white, and therefore equal in all tracks; see `SHARED`.
        experts: (S, J, EXPERTS, 3) metres, written; NaN for a joint that has not been observed yet.
        features: (S, J, FEATURES) float32, written.
        scale: (S,) metres along an axis, estimated noise of the body's joints, written.
        gap: (S, J) frames to the nearest observation, before or after, written; 0 if the joint is observed in this
            frame, -1 if it has not been observed yet.
        between: (S, J) metres along an axis, standard deviation of the multiple-model estimate of a joint in a gap
            between two observations, if other joints of the body are observed in this frame; otherwise 0; written.
    """
    bodies, joints, _, frames, _ = bank.position.shape
    slot = (count - 1 - back) % frames
    weights, noise = np.empty((joints, _SMOOTHERS)), np.empty(joints)
    for s in range(bodies):
        total, observed_joints = 0.0, 0.0
        write_experts(
            bank.position[s, :, :, slot], bank.modes[s], bank.squared_innovations[s], bank.log_variances[s],
            bank.observations[s], bank.raw[s, :, slot], bank.since[s, :, slot], SHARED * whiteness[s], experts[s],
            weights, noise,
        )  # fmt: skip
        for j in range(joints):
            gap[s, j], between[s, j] = bank.since[s, j, slot], 0.0
            if gap[s, j] > 0.0:
                for since in range(1, back + 1):
                    if bank.since[s, j, (slot + since) % frames] == 0.0:
                        gap[s, j] = min(gap[s, j], since)
                        scales = bank.squared_innovations[s, j] / max(bank.observations[s, j], 1.0)
                        between[s, j] = _deviation(experts[s, j], weights[j], bank.variance[s, j, :, slot], scales)
                        break
            if gap[s, j] == 0.0:
                bank.age[s, j, 0] += 1.0
                for m in range(_SMOOTHERS):
                    square = _square(experts[s, j, m], experts[s, j, _neighbour(m)])
                    for k, memory in enumerate((SHORT_MEAN_FRAMES, MEAN_FRAMES)):
                        bank.distances[s, j, m, k] += (square - bank.distances[s, j, m, k]) / min(
                            bank.age[s, j, 0], memory
                        )
                square = min(_square(experts[s, j, NOISE_EXPERT], experts[s, j, RAW]), MAX_NOISE**2)
                bank.noise[s, j] += (square - bank.noise[s, j]) / min(bank.age[s, j, 0], MEAN_FRAMES)
            if bank.age[s, j, 0] > 0.0:
                total += bank.noise[s, j]
                observed_joints += 1.0
        scale[s] = np.sqrt(total / max(observed_joints, 1.0) / 3.0) + LOG_FLOOR
        if not (gap[s] == 0.0).any():
            between[s] = 0.0
        _update_heading(experts[s], bank.heading[s])
        unobserved = bank.since[s, :, slot]
        for j in range(joints):
            confidence, age = bank.confidence[s, j, slot], bank.age[s, j]
            _describe_observation(unobserved[j], gap[s, j], confidence, age[0], back, scale[s], features[s, j])
            if unobserved[j] >= 0.0:
                heading = bank.heading[s]
                _describe_experts(experts[s, j], bank.distances[s, j], heading, scale[s], features[s, j])
                _describe_multiple_model(experts[s, j], weights[j], noise[j], heading, scale[s], features[s, j])
                if age[1] > 0.0:
                    for k in range(len(LAGS)):
                        features[s, j, _SIZES + k] = bank.sizes[s, j, k] + _CENTIMETRES
                length = bank.length[s, j]
                _describe_bone(j, parents[j], unobserved, length, age, experts[s], heading, scale[s], features[s, j])
                _describe_pose(j, unobserved[0], experts[s], bank.place[s, j], heading, features[s, j])
        for j in range(joints):
            for axis in range(3):
                bank.place[s, j, axis] = experts[s, j, POSE_EXPERT, axis]


@njit(cache=True)
def write_experts(
    tracks, modes, squared_innovations, log_variances, observations, raw, unobserved, shared, experts, weights, noise
):
    """Write the joints' experts (J, EXPERTS, 3), and the tracks' smoother weights (J, M) and noise (J,).

    ``shared`` is the weight, in observations, of the noise of all tracks in that of each.
    """
    joints = len(tracks)
    own, noises = np.empty((joints, _SMOOTHERS)), np.empty(joints)
    mean, logarithm, tracked = np.zeros((joints, 3)), 0.0, 0
    for t in range(joints):
        noises[t] = multiple_model_weights(squared_innovations[t], log_variances[t], observations[t], 0.0, 0.0, own[t])
        if observations[t] > 0.0:
            logarithm += np.log(noises[t])
            tracked += 1
    for t in range(joints):
        if shared > 0.0 and tracked > 0:
            expected = np.exp(logarithm / tracked)
            noises[t] = multiple_model_weights(
                squared_innovations[t], log_variances[t], observations[t], expected, shared, own[t]
            )
        for m in range(_SMOOTHERS):
            for axis in range(3):
                mean[t, axis] += own[t, m] * tracks[t, m, axis]
    for j in range(joints):
        noise[j] = 0.0
        for m in range(_SMOOTHERS):
            weights[j, m] = 0.0
        for m in range(EXPERTS):
            for axis in range(3):
                experts[j, m, axis] = 0.0 if unobserved[j] >= 0.0 else np.nan
        for axis in range(3):
            experts[j, RAW, axis] = raw[j, axis]
        for t in range(joints):
            share = modes[j, t]
            if share == 0.0:
                continue
            noise[j] += share * share * noises[t]
            for m in range(_SMOOTHERS):
                weights[j, m] += share * share * own[t, m]
                for axis in range(3):
                    experts[j, m, axis] += share * tracks[t, m, axis]
            for axis in range(3):
                experts[j, MULTIPLE_MODEL, axis] += share * mean[t, axis]


@njit(cache=True)
def _deviation(experts, weights, variance, scales):
    """Standard deviation of the multiple-model estimate along an axis, that of a mixture of normal distributions.

    Its square is the weighted mean of the smoothers' variances, scaled by their innovations, plus that of their squared
    distances from the mean.
    """
    total = 0.0
    for m in range(_SMOOTHERS):
        total += weights[m] * (scales[m] * variance[m] + _square(experts[m], experts[MULTIPLE_MODEL]) / 3.0)
    return np.sqrt(total)


@njit(cache=True)
def _neighbour(m):
    """Return the expert next to smoother ``m``: the one with the next larger density, or the raw joint."""
    return m + 1 if m + 1 < _SMOOTHERS else RAW


@njit(cache=True)
def _square(a, b):
    """Squared distance between two positions (3,)."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True)
def _update_heading(experts, heading):
    """Update the heading from the known ones of hips and shoulders."""
    x, y = 0.0, 0.0
    for left, right in ((_LEFT_HIP, _RIGHT_HIP), (_LEFT_SHOULDER, _RIGHT_SHOULDER)):
        a = experts[left, HEADING_EXPERT, 0] - experts[right, HEADING_EXPERT, 0]
        b = experts[left, HEADING_EXPERT, 1] - experts[right, HEADING_EXPERT, 1]
        if np.isfinite(a) and np.isfinite(b):
            x += a
            y += b
    length = np.sqrt(x * x + y * y)
    if length > 1e-6:
        heading[0], heading[1] = y / length, -x / length


@njit(cache=True)
def _write_vector(heading, x, y, z, unit, features, at):
    """Write a vector in the frame of the heading, as asinh of its components divided by ``unit``."""
    features[at] = np.arcsinh((heading[0] * x + heading[1] * y) / unit)
    features[at + 1] = np.arcsinh((heading[0] * y - heading[1] * x) / unit)
    features[at + 2] = np.arcsinh(z / unit)


# Each function writes one group of a joint's features. None takes the whole bank: compiling its many arrays takes a
# second.


@njit(cache=True)
def _describe_observation(unobserved, gap, confidence, age, back, scale, features):
    """Observation and delay; sets all other features to 0."""
    for k in range(FEATURES):
        features[k] = 0.0
    for k, delay in enumerate(_DELAYS):
        features[_DELAY + k] = 1.0 / (1.0 + (back - delay) ** 2)
    features[_DELAY + len(_DELAYS)] = back / 16.0
    if unobserved < 0.0:
        return
    features[_OBSERVED] = 1.0 if unobserved == 0.0 else 0.0
    features[_OBSERVED + 1] = np.log(1.0 + unobserved)
    features[_OBSERVED + 2] = confidence
    features[_OBSERVED + 3] = 1.0 / (1.0 + age / 10.0)
    features[_OBSERVED + 4] = np.log(scale / 0.01)
    features[_OBSERVED + 5] = np.log(1.0 + gap)


@njit(cache=True)
def _describe_experts(own, distances, heading, scale, features):
    """Distances between neighbouring experts (M + 1, 3), now and their running means, and the vectors between them."""
    for m in range(_SMOOTHERS):
        looser = own[_neighbour(m)]
        features[3 * m] = _log(_square(own[m], looser))
        features[3 * m + 1], features[3 * m + 2] = _log(distances[m, 0]), _log(distances[m, 1])
        x, y, z = own[m, 0] - looser[0], own[m, 1] - looser[1], own[m, 2] - looser[2]
        _write_vector(heading, x, y, z, scale, features, _VECTORS + 3 * m)


@njit(cache=True)
def _describe_multiple_model(own, weights, noise, heading, scale, features):
    """Multiple-model estimate: position relative to `POSE_EXPERT`, mean log-density, and estimated noise."""
    features[_MULTIPLE_MODEL] = _log(_square(own[MULTIPLE_MODEL], own[POSE_EXPERT]))
    features[_MULTIPLE_MODEL + 1] = 0.5 * np.log(noise + 1e-4) + np.log(MEASUREMENT_SIGMA / 0.01)
    features[_MULTIPLE_MODEL + 2] = 0.0
    for m in range(_SMOOTHERS):
        features[_MULTIPLE_MODEL + 2] += weights[m] * _LOG_DENSITIES[m]
    mean, middle = own[MULTIPLE_MODEL], own[POSE_EXPERT]
    x, y, z = mean[0] - middle[0], mean[1] - middle[1], mean[2] - middle[2]
    _write_vector(heading, x, y, z, scale, features, _MULTIPLE_MODEL + 3)


@njit(cache=True)
def _describe_pose(j, root_unobserved, experts, place, heading, features):
    """Position relative to the root, and displacement since the last frame."""
    x, y, z = experts[j, POSE_EXPERT, 0], experts[j, POSE_EXPERT, 1], experts[j, POSE_EXPERT, 2]
    if root_unobserved >= 0.0:
        a, b, c = experts[0, POSE_EXPERT, 0], experts[0, POSE_EXPERT, 1], experts[0, POSE_EXPERT, 2]
        _write_vector(heading, x - a, y - b, z - c, 0.5, features, _POSE)
    if np.isfinite(place[0]):
        _write_vector(heading, x - place[0], y - place[1], z - place[2], SPEED_UNIT / FPS, features, _POSE + 3)


@njit(cache=True)
def _describe_bone(j, parent, unobserved, length, age, experts, heading, scale, features):
    """Bone to the joint's parent: variance of its length, and current deviation from the mean length."""
    if parent == j or unobserved[parent] < 0.0:
        return
    came, middle = 0.0, 0.0
    for axis in range(3):
        came += (experts[j, RAW, axis] - experts[parent, RAW, axis]) ** 2
        middle += (experts[j, POSE_EXPERT, axis] - experts[parent, POSE_EXPERT, axis]) ** 2
    came, middle = np.sqrt(came), np.sqrt(middle)
    if unobserved[j] == 0.0 and unobserved[parent] == 0.0:
        age[2] += 1.0
        length[0] += (came - length[0]) / min(age[2], BONE_MEAN_FRAMES)
        length[1] += ((came - length[0]) ** 2 - length[1]) / min(age[2], BONE_MEAN_FRAMES)
    if age[2] == 0.0:
        return
    features[_BONE] = _log(length[1])
    features[_BONE + 1] = np.arcsinh((came - length[0]) / scale)
    features[_BONE + 2] = np.arcsinh((middle - length[0]) / scale)
    long = (middle - length[0]) / max(middle, 1e-3)
    x = experts[j, POSE_EXPERT, 0] - experts[parent, POSE_EXPERT, 0]
    y = experts[j, POSE_EXPERT, 1] - experts[parent, POSE_EXPERT, 1]
    z = experts[j, POSE_EXPERT, 2] - experts[parent, POSE_EXPERT, 2]
    _write_vector(heading, long * x, long * y, long * z, scale, features, _BONE + 3)


PARENT = np.maximum(np.array(PARENTS), 0)
_LEFT_HIP, _RIGHT_HIP = J["left_hip"], J["right_hip"]
_LEFT_SHOULDER, _RIGHT_SHOULDER = J["left_shoulder"], J["right_shoulder"]
