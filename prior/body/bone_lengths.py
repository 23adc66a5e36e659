"""A person's bone lengths: robust medians over a recording or, live, estimates with human proportions as the prior."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, medians
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import (
    COLLARS,
    HIPS,
    JOINTS,
    LIMB_ENDS,
    MIRROR,
    PARENTS,
    REST_OFFSETS,
    SHOULDERS,
    J,
    finite_joints,
)

STATURE_SPREAD = 0.1  # standard deviation of the logarithm of a person's size relative to the generic adult's

LIMB_SPREAD, TRUNK_SPREAD = 0.05, 0.12
"""Standard deviations of the logarithm of a bone's length relative to the person's size. Motion capture of 22 people
gives 0.02 to 0.07 for arms and legs. Trunk, head and feet vary more, because sensors define them differently."""

TRUNK_PLACE_SPREAD = 0.05
"""Standard deviation between sensors, along an axis, of hips, neck and shoulders on the trunk, metres."""

STRAIGHT = 90.0
"""Percentile of the distances between the ends of a limb without its elbow or knee at which the limb is straight."""

LENGTH_BIASES = 3.0
"""Least error of a single sample of a bone, as a multiple of the sensor's bias. Successive samples share most of it."""

LIKE_SAMPLES = 12
"""Correlation time of the samples' errors, samples (two seconds): this number counts as one independent sample."""

_LIMBS_MIDDLES = {joint for joint, name in enumerate(JOINTS) if name.endswith(("elbow", "knee"))}
_COLLAR_TO_SHOULDER = SHOULDERS[0] - COLLARS[0]


class BoneEstimate(NamedTuple):
    """A person's bones."""

    offsets: Floats  # (22, 3) metres, each joint in its parent's frame
    length_variance: Floats  # (22,) metres^2, the part of each bone length's variance that more samples will remove


def estimate_bones(positions: Floats, bias_sigma: float, noise_sigma: float, samples: int) -> BoneEstimate:
    """Estimate a person's bones, equal on both sides, from a few consecutive poses.

    Lengths are posterior means of a log-normal model with three levels. A person's size varies about the generic
    adult's, each bone varies about the person's size, and the median length over the samples of both sides varies about
    the bone, less with more samples. A body first observed from the side, with guessed far limbs, therefore starts with
    human proportions. A joint that was never observed is placed by scaling the rest pose between its observed
    neighbours. Bones fixed to pelvis and chest (hips, neck, collars) take the median vector in the trunk's frame, with
    the same weights.

    Args:
        positions: (T, 22, 3) metres, NaN where unobserved; samples at about 6 Hz.
        bias_sigma: metres along an axis, the sensor's bias.
        noise_sigma: metres along an axis, the remaining error of the positions.
        samples: final number of samples.
    """
    counts = np.array([len(positions), max(samples, len(positions))])
    same = 1.0 + counts / LIKE_SAMPLES
    bias, noise = LENGTH_BIASES * bias_sigma, np.sqrt(2.0) * noise_sigma
    observed = np.asarray(finite_joints(positions).any(axis=0))
    observed |= observed[MIRROR]
    bones = _both_sides(_bones(observed))
    log_ratio, sigma = np.zeros(len(bones)), np.full((2, len(bones)), np.inf)  # now, and in the end
    for k, paths in enumerate(bones):
        generic = float(np.linalg.norm(REST_OFFSETS[paths[0]].sum(axis=0)))
        ends = [(path[0], max(PARENTS[path[-1]], 0)) for path in paths]
        lengths = np.concatenate([np.linalg.norm(positions[:, a] - positions[:, b], axis=-1) for a, b in ends])
        lengths = lengths[np.isfinite(lengths)]
        if len(lengths):
            median = medians(lengths)
            deviation = 1.4826 * medians(np.abs(lengths - median))
            log_ratio[k] = np.log(max(median, 0.1 * generic) / generic)
            # the part of the deviation that noise does not explain varies as slowly as the bias
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
    error = bias**2 / same + noise**2 / counts
    weight_measured = TRUNK_PLACE_SPREAD**2 / (TRUNK_PLACE_SPREAD**2 + error)
    length_variance[_ON_TRUNK] = TRUNK_PLACE_SPREAD**2 * (weight_measured[1] - weight_measured[0])
    return BoneEstimate(_place_on_trunk(positions, observed, offsets, weight_measured[0]), length_variance)


_TRUNKS = ((J["pelvis"], (J["left_hip"],)), (J["spine3"], (J["neck"], J["left_collar"])))
_ON_TRUNK = sorted({int(end) for _, joints in _TRUNKS for joint in joints for end in (joint, MIRROR[joint])})


def _bones(observed: Bools) -> list[list[int]]:
    """Return the measurable bones, given the joints (22,) that were ever ``observed``.

    Each bone is the path of joints from an observed joint up to, but without, its nearest observed ancestor.
    """
    measurable = []
    for joint in range(1, len(PARENTS)):
        path = [joint]
        while PARENTS[path[-1]] > 0 and not observed[PARENTS[path[-1]]]:
            path.append(PARENTS[path[-1]])
        if observed[joint] and observed[PARENTS[path[-1]]]:
            measurable.append(path)
    return measurable


def _both_sides(paths: list[list[int]]) -> list[list[list[int]]]:
    """Group the bones by left and right counterparts."""
    pairs: dict[tuple[int, ...], list[list[int]]] = {}
    for path in paths:
        pairs.setdefault(min(tuple(path), tuple(MIRROR[path].tolist())), []).append(path)
    return list(pairs.values())


def _place_on_trunk(positions: Floats, observed: Bools, offsets: Floats, weight: float) -> Floats:
    """Return offsets (22, 3) with hips, neck and collars moved by ``weight`` towards the samples (T, 22, 3)."""
    placed = offsets.copy()
    world = global_rotations(solve_rotations(positions, offsets))
    for trunk, children in _TRUNKS:
        for joint in children:
            both = []
            for end, side in ((joint, 1.0), (int(MIRROR[joint]), -1.0)):
                beyond = 0 if observed[end] or joint != J["left_collar"] else _COLLAR_TO_SHOULDER
                vectors = np.einsum("tji,tj->ti", world[:, trunk], positions[:, end + beyond] - positions[:, trunk])
                vectors -= offsets[end + beyond] if beyond else 0.0
                both.append(vectors[finite_joints(vectors)] * [1.0, side, 1.0])
            vectors = np.concatenate(both)
            if len(vectors):
                moved = offsets[joint] + weight * (medians(vectors) - offsets[joint])
                if MIRROR[joint] == joint:
                    moved[1] = 0.0
                placed[joint], placed[MIRROR[joint]] = moved, moved * [1.0, -1.0, 1.0]
    return placed


def _around_shoulder(path: list[int]) -> bool:
    return not {*SHOULDERS}.isdisjoint(path[1:])


def estimate_offsets(positions: NDArray[np.floating]) -> Floats:
    """Estimate a person's bones robustly from a set of poses.

    Bone lengths are medians over the frames. Bones keep their directions from the rest pose. The exceptions are bones
    fixed to pelvis and chest (hips, neck, collars), whose directions differ between sensors. They take the median
    vector in the trunk's frame. A joint that was never observed is placed by scaling the rest pose between its observed
    neighbours: an elbow or a knee to the straight limb, a shoulder to the person's size.

    Args:
        positions: (T, 22, 3) metres, NaN where unobserved.

    Returns:
        (22, 3) metres, each joint in its parent's frame.
    """
    p = np.asarray(positions, dtype=np.float64)
    offsets = REST_OFFSETS.copy()
    observed = np.asarray(finite_joints(p).any(axis=0))
    ratios: list[float] = []
    for path in sorted(_bones(observed), key=_around_shoulder):
        lengths = np.linalg.norm(p[:, path[0]] - p[:, PARENTS[path[-1]]], axis=-1)
        lengths = lengths[np.isfinite(lengths)] / np.linalg.norm(REST_OFFSETS[path].sum(axis=0))
        if len(lengths):
            ratios.append(float(np.percentile(lengths, STRAIGHT if _LIMBS_MIDDLES & {*path[1:]} else 50.0)))
            # with hanging arms, collar and elbow are closer together than the sum of their bones' lengths
            offsets[path] *= np.median(ratios[:-1]) if _around_shoulder(path) and len(ratios) > 1 else ratios[-1]
    world = global_rotations(solve_rotations(p, offsets))
    for trunk, children in ((J["pelvis"], HIPS), (J["spine3"], (J["neck"], *COLLARS))):
        for joint in children:
            end = joint if joint not in COLLARS or observed[joint] else joint + _COLLAR_TO_SHOULDER
            vectors = np.einsum("tji,tj->ti", world[:, trunk], p[:, end] - p[:, trunk])
            usable = finite_joints(vectors)
            if usable.any():
                offsets[joint] = np.median(vectors[usable], axis=0) - (offsets[end] if end != joint else 0.0)
    return offsets
