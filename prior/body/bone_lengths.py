"""A person's bones from their poses: robust medians of a recording or, live, with human proportions as a prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import (
    COLLARS,
    HIPS,
    LIMB_ENDS,
    MIRROR,
    PARENTS,
    REST_OFFSETS,
    SHOULDERS,
    J,
    finite_joints,
)

STATURE_SPREAD = 0.1
"""Standard deviation of the log of a person's size against the generic adult's."""

LIMB_SPREAD, TRUNK_SPREAD = 0.05, 0.12
"""Standard deviations of the log of a bone's length about the person's size: 2 to 7 % for the arms and legs of 22
people measured by motion capture; more in trunk, head and feet, where sensors mean different places by one name."""

TRUNK_PLACE_SPREAD = 0.05
"""Metres along each axis: deviation between sensors in the places of hips, neck and shoulders on the trunk."""

LENGTH_BIASES = 3.0
"""Least error of a single sample of a bone, as a multiple of the sensor's bias; most of it is shared by
successive samples."""

LIKE_SAMPLES = 12
"""Correlation time of the samples' errors, in samples (two seconds): so many count as one independent sample."""

_COLLAR_TO_SHOULDER = SHOULDERS[0] - COLLARS[0]


class BoneEstimate(NamedTuple):
    """A person's bones.

    Attributes:
        offsets: (22, 3) metres, each joint in its parent's frame.
        length_variance: (22,) metres^2, of each bone's length, as far as more samples will take it away.
    """

    offsets: Floats
    length_variance: Floats


def estimate_bones(positions: Floats, bias_sigma: float, noise_sigma: float, samples: int) -> BoneEstimate:
    """This person's bones, the same on both sides, from a few poses in a row.

    Lengths are the posterior mean of a log-normal model: a person's size varies about the generic adult's, each bone
    about the person's size, and the median length over the samples of both sides about the bone, the less the more
    samples there are. A body first seen from the side, with the far limbs guessed, so starts with human proportions.
    A joint never seen is placed by scaling the rest pose between its neighbours seen. Bones that leave pelvis and
    chest rigidly (hips, neck, collars) go the way of the median vector in the trunk's frame, weighed likewise.

    Args:
        positions: (T, 22, 3) metres, NaN where unobserved; samples of about 6 Hz.
        bias_sigma: metres along an axis, the sensor's bias.
        noise_sigma: metres along an axis, the positions' other error.
        samples: how many there will be in the end.
    """
    counts = np.array([len(positions), max(samples, len(positions))])
    same = 1.0 + counts / LIKE_SAMPLES
    bias, noise = LENGTH_BIASES * bias_sigma, np.sqrt(2.0) * noise_sigma
    seen = np.asarray(finite_joints(positions).any(axis=0))
    seen |= seen[MIRROR]
    bones = _both_sides(_bones(seen))
    log_ratio, sigma = np.zeros(len(bones)), np.full((2, len(bones)), np.inf)  # now, and in the end
    for k, paths in enumerate(bones):
        generic = float(np.linalg.norm(REST_OFFSETS[paths[0]].sum(axis=0)))
        ends = [(path[0], max(PARENTS[path[-1]], 0)) for path in paths]
        lengths = np.concatenate([np.linalg.norm(positions[:, a] - positions[:, b], axis=-1) for a, b in ends])
        lengths = lengths[np.isfinite(lengths)]
        if len(lengths):
            median = _median(lengths)
            deviation = 1.4826 * _median(np.abs(lengths - median))
            log_ratio[k] = np.log(max(median, 0.1 * generic) / generic)
            # what noise does not explain of the deviation is as slow as the bias
            slow = max(deviation**2 - noise**2, bias**2)
            sigma[:, k] = np.sqrt(slow / same + noise**2 / len(lengths) * counts[0] / counts) / generic
    spread = np.array([LIMB_SPREAD if paths[0][0] in LIMB_ENDS else TRUNK_SPREAD for paths in bones])
    weight = 1.0 / (spread**2 + sigma**2)
    stature = 1.0 / (weight.sum(axis=1) + STATURE_SPREAD**-2)
    size = stature[0] * (weight[0] * log_ratio).sum()
    own = spread**2 * weight[0] * (log_ratio - size)
    variance = spread**2 * (1.0 - spread**2 * weight) + stature[:, None] * (1.0 - spread**2 * weight) ** 2
    offsets, to_learn = REST_OFFSETS * np.exp(size), np.zeros(22)
    for paths, factor, (now, then) in zip(bones, np.exp(own), variance.T, strict=True):
        offsets[np.concatenate(paths)] *= factor
        to_learn[np.concatenate(paths)] = max(now - then, 0.0)
    length_variance = to_learn * (offsets**2).sum(axis=-1)
    doubt = bias**2 / same + noise**2 / counts
    weight_measured = TRUNK_PLACE_SPREAD**2 / (TRUNK_PLACE_SPREAD**2 + doubt)
    length_variance[_ON_TRUNK] = TRUNK_PLACE_SPREAD**2 * (weight_measured[1] - weight_measured[0])
    return BoneEstimate(_place_on_trunk(positions, seen, offsets, weight_measured[0]), length_variance)


_TRUNKS = ((J["pelvis"], (J["left_hip"],)), (J["spine3"], (J["neck"], J["left_collar"])))
_ON_TRUNK = sorted({int(end) for _, joints in _TRUNKS for joint in joints for end in (joint, MIRROR[joint])})


def _bones(seen: NDArray[np.bool_]) -> list[list[int]]:
    """What can be measured of the joints (22,) that are ever ``seen``: for each, the path of joints from it up to, not
    with, its nearest ancestor seen."""
    measurable = []
    for joint in range(1, len(PARENTS)):
        path = [joint]
        while PARENTS[path[-1]] > 0 and not seen[PARENTS[path[-1]]]:
            path.append(PARENTS[path[-1]])
        if seen[joint] and seen[PARENTS[path[-1]]]:
            measurable.append(path)
    return measurable


def _both_sides(paths: list[list[int]]) -> list[list[list[int]]]:
    """The same bones, left and right together."""
    pairs: dict[tuple[int, ...], list[list[int]]] = {}
    for path in paths:
        pairs.setdefault(min(tuple(path), tuple(MIRROR[path].tolist())), []).append(path)
    return list(pairs.values())


def _median(values: Floats) -> Floats:
    """Along the first axis, in a tenth of the time that numpy's takes for as few."""
    ordered = np.sort(values, axis=0)
    return 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def _place_on_trunk(positions: Floats, seen: NDArray[np.bool_], offsets: Floats, weight: float) -> Floats:
    """Offsets (22, 3) with hips, neck and collars moved by ``weight`` to where the samples (T, 22, 3) have them."""
    placed = offsets.copy()
    world = global_rotations(solve_rotations(positions, offsets))
    for trunk, children in _TRUNKS:
        for joint in children:
            both = []
            for end, side in ((joint, 1.0), (int(MIRROR[joint]), -1.0)):
                beyond = 0 if seen[end] or joint != J["left_collar"] else _COLLAR_TO_SHOULDER
                vectors = np.einsum("tji,tj->ti", world[:, trunk], positions[:, end + beyond] - positions[:, trunk])
                vectors -= offsets[end + beyond] if beyond else 0.0
                both.append(vectors[finite_joints(vectors)] * [1.0, side, 1.0])
            vectors = np.concatenate(both)
            if len(vectors):
                moved = offsets[joint] + weight * (_median(vectors) - offsets[joint])
                if MIRROR[joint] == joint:
                    moved[1] = 0.0
                placed[joint], placed[MIRROR[joint]] = moved, moved * [1.0, -1.0, 1.0]
    return placed


def estimate_offsets(positions: NDArray[np.floating]) -> Floats:
    """This person's bones from a set of poses, robustly.

    Bone lengths are medians over the frames. The directions of the rest pose are kept, but for the bones that
    leave the pelvis and the chest rigidly (hips, neck, collars), whose directions differ from sensor to sensor:
    there the median vector in the trunk's frame is taken. A joint that is never seen is placed by scaling the
    rest pose between its neighbours seen.

    Args:
        positions: (T, 22, 3) metres, NaN where unobserved.

    Returns:
        (22, 3) metres, each joint in its parent's frame.
    """
    p = np.asarray(positions, dtype=np.float64)
    offsets = REST_OFFSETS.copy()
    seen = np.asarray(finite_joints(p).any(axis=0))
    for path in _bones(seen):
        lengths = np.linalg.norm(p[:, path[0]] - p[:, PARENTS[path[-1]]], axis=-1)
        if np.isfinite(lengths).any():
            offsets[path] *= np.nanmedian(lengths) / np.linalg.norm(REST_OFFSETS[path].sum(axis=0))
    world = global_rotations(solve_rotations(p, offsets))
    for trunk, children in ((J["pelvis"], HIPS), (J["spine3"], (J["neck"], *COLLARS))):
        for joint in children:
            end = joint if joint not in COLLARS or seen[joint] else joint + _COLLAR_TO_SHOULDER
            vectors = np.einsum("tji,tj->ti", world[:, trunk], p[:, end] - p[:, trunk])
            usable = finite_joints(vectors)
            if usable.any():
                offsets[joint] = np.median(vectors[usable], axis=0) - (offsets[end] if end != joint else 0.0)
    return offsets
