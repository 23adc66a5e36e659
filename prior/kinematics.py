"""Kinematics of the canonical skeleton: forward, from positions to rotations, and a person's bones.

Rotations are local (child in parent's frame), the root's is its orientation in the frame of the positions. The
identity everywhere is a T-pose facing +x, left +y, up +z. Forward kinematics is torch (differentiable, used in
losses and in the live path); the solver is numpy (it runs on one frame, or on a whole recording, at once).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from prior.skeletons import JOINTS, PARENTS, REST_OFFSETS, J, finite_joints

Floats = NDArray[np.float64]


def _levels() -> list[slice]:
    depth = [0] * len(PARENTS)
    for joint, parent in enumerate(PARENTS):
        depth[joint] = 0 if parent < 0 else depth[parent] + 1
    assert depth == sorted(depth), "the canonical order is breadth first"
    return [slice(depth.index(d), len(depth) - depth[::-1].index(d)) for d in range(max(depth) + 1)]


LEVELS: list[slice] = _levels()
"""Joints by depth: those of one level depend only on the level above and are handled together."""

_CHILDREN: tuple[tuple[int, ...], ...] = tuple(
    tuple(c for c, p in enumerate(PARENTS) if p == joint) for joint in range(len(PARENTS))
)

CONTACT_JOINTS: tuple[int, ...] = tuple(
    J[f"{side}_{part}"] for part in ("knee", "ankle", "foot", "wrist") for side in ("left", "right")
)
"""The eight joints of the contact labels: HuMoR's nine without the hips, which are never in contact there."""

CONTACT_SPEED = 0.15
"""m/s: a joint in contact is slower than this."""

CONTACT_HEIGHT: Floats = np.array([0.04 if JOINTS[j].endswith("foot") else 0.08 for j in CONTACT_JOINTS])
"""(8,) metres above the *lowest the joint can be*: see `label_contacts`."""

# Where the joint centre lies when the limb rests on the floor: a heel's contact is labelled at the ankle's centre.
_STANDING_HEIGHT: Floats = np.array(
    [{"knee": 0.05, "ankle": 0.07, "foot": 0.015, "wrist": 0.02}[JOINTS[j].split("_")[1]] for j in CONTACT_JOINTS]
)


def forward_kinematics(rotations: Tensor, offsets: Tensor, root: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Joint positions from local rotations and a person's bones.

    Args:
        rotations: (..., 22, 3, 3) local rotation matrices.
        offsets: (..., 22, 3) metres, each joint in its parent's frame; broadcasts over leading dimensions.
        root: (..., 3) metres, position of the pelvis; the origin if left out.

    Returns:
        positions (..., 22, 3) metres and global rotations (..., 22, 3, 3), in the frame of the root's rotation.
    """
    batch = rotations.shape[:-3]
    offsets = offsets.expand(*batch, *offsets.shape[-2:]).unsqueeze(-1)
    origin = rotations.new_zeros(*batch, 3) if root is None else root
    # Lists, not one tensor written in place: autograd needs every level's values kept.
    positions: list[Tensor] = [origin.unsqueeze(-2)]
    orientations: list[Tensor] = [rotations[..., :1, :, :]]
    for above, level in pairwise(LEVELS):
        parents = [p - above.start for p in PARENTS[level]]
        orientation = orientations[-1][..., parents, :, :]
        positions.append(positions[-1][..., parents, :] + (orientation @ offsets[..., level, :, :]).squeeze(-1))
        orientations.append(orientation @ rotations[..., level, :, :])
    return torch.cat(positions, dim=-2), torch.cat(orientations, dim=-3)


# ---------------------------------------------------------------------------------------------------------------
# From positions to rotations


# The live node solves one frame thirty times a second for each body: these few helpers replace np.cross and einsum,
# whose set-up alone would cost several times the arithmetic.

_LEVI_CIVITA: Floats = np.zeros((3, 9))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _LEVI_CIVITA[_i, 3 * _j + _k], _LEVI_CIVITA[_i, 3 * _k + _j] = -1.0, 1.0
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_EYE: Floats = np.eye(3)


def _skew(v: Floats) -> Floats:
    """(..., 3, 3) such that ``_skew(v) @ u == cross(v, u)``."""
    return (v @ _LEVI_CIVITA).reshape(*v.shape, 3)


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


def _dot(a: Floats, b: Floats) -> Floats:
    return (a * b).sum(axis=-1, keepdims=True)


def _apply(matrix: Floats, vector: Floats) -> Floats:
    return (matrix @ vector[..., None])[..., 0]


def _normalised(v: Floats) -> Floats:
    return v / np.maximum(np.sqrt(_dot(v, v)), 1e-9)


def _frame(left: Floats, up: Floats) -> Floats:
    """(..., 3, 3) right-handed frame, columns forward, left, up: y along ``left``, z in the plane of ``up``."""
    y = _normalised(left)
    x = _normalised(_cross(y, up))
    return np.stack([x, y, _cross(x, y)], axis=-1)


def _against(a: Floats) -> Floats:
    """(..., 4, 3) such that times a vector v it is cross(a, v) and a · v: all that turning unit ``a`` to v needs."""
    return np.concatenate([_skew(a), a[..., None, :]], axis=-2)


def _swing(against: Floats, b: Floats) -> Floats:
    """The smallest rotations (..., 3, 3) that turn unit vectors, given by `_against`, into the directions ``b``."""
    products = _apply(against, b) / np.maximum(np.sqrt(_dot(b, b)), 1e-9)
    axis, cosine = products[..., :3], products[..., 3:]
    # Rodrigues without the angle. Opposite directions have no smallest rotation: any half turn will do.
    scaled = axis / np.maximum(1 + cosine, 1e-9)
    rotation = cosine[..., None] * _EYE + _skew(axis) + axis[..., :, None] * scaled[..., None, :]
    opposite = cosine[..., 0] < -1 + 1e-8
    if opposite.any():
        a = against[..., 3, :]
        normal = _normalised(_cross(a, np.where(np.abs(a[..., :1]) < 0.9, _EYE[0], _EYE[1])))
        half_turn = 2 * normal[..., :, None] * normal[..., None, :] - _EYE
        rotation = np.where(opposite[..., None, None], half_turn, rotation)
    return rotation


def swing(a: Floats, b: Floats) -> Floats:
    """The smallest rotation that turns direction ``a`` (..., 3) into ``b`` (..., 3), as (..., 3, 3) matrices."""
    return _swing(_against(_normalised(a)), b)


def _about(axis: Floats, angle: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) about unit ``axis`` (..., 3) by ``angle`` (...) radians."""
    k = _skew(axis)
    angle = np.asarray(angle)[..., None, None]
    return _EYE + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


# The hinge axes in the rest pose, about which elbows and knees flex (right-hand rule, flexion positive).
_HINGE: dict[int, tuple[float, float, float]] = {
    J["left_hip"]: (0.0, 1.0, 0.0),
    J["right_hip"]: (0.0, 1.0, 0.0),
    J["left_shoulder"]: (0.0, 0.0, -1.0),
    J["right_shoulder"]: (0.0, 0.0, 1.0),
}
# The sine of the bend below which the plane of a limb says nothing of its twist, and above which it says all.
_BEND_NONE, _BEND_FULL = 0.1, 0.35

# What shows the frame of pelvis and chest, best first: a left-right pair, and a place above (a mean of joints).
_TRUNK_LEFT: dict[int, list[tuple[int, int]]] = {
    J["pelvis"]: [(J["left_hip"], J["right_hip"]), (J["left_shoulder"], J["right_shoulder"])],
    J["spine3"]: [(J["left_shoulder"], J["right_shoulder"]), (J["left_collar"], J["right_collar"])],
}
_TRUNK_UP: dict[int, list[tuple[int, ...]]] = {
    J["pelvis"]: [(J["spine3"],), (J["spine2"],), (J["neck"],), (J["left_shoulder"], J["right_shoulder"])],
    J["spine3"]: [(J["neck"],), (J["head"],)],
}


def _below(joint: int) -> list[int]:
    """The joints below to aim at, nearest first, as far as the chain does not branch."""
    chain: list[int] = []
    while len(_CHILDREN[joint]) == 1:
        joint = _CHILDREN[joint][0]
        chain.append(joint)
    return chain


# (22, 4) joints to aim at, nearest first; a joint that aims at nothing (trunk, leaf) names itself, unseen.
_AIM: NDArray[np.intp] = np.array(
    [
        (below := [] if j in _TRUNK_UP else _below(j)) + [below[-1] if below else j] * (4 - len(below))
        for j in range(len(PARENTS))
    ]
)
_AIMS: NDArray[np.bool_] = np.array([j not in _TRUNK_UP and bool(_below(j)) for j in range(len(PARENTS))])


def solve_rotations(
    positions: NDArray[np.floating], offsets: NDArray[np.floating], fallback: NDArray[np.floating] | None = None
) -> Floats:
    """Local rotations from joint positions: swing from the bones' directions, twist from elbows and knees.

    The pelvis and the chest take the frame spanned by hips (shoulders) and spine (neck). Every other joint swings
    its bone from where forward kinematics has put it towards the next joint seen below, so that an error is not
    handed down the chain; a shoulder or hip also twists so that the limb bends in the plane seen, as far as it is
    bent enough to show one. The twist of neck, head, wrists and feet cannot be seen in 22 positions: identity.
    With the hips hidden, the pelvis is taken to be upright below the shoulders.

    Args:
        positions: (..., 22, 3) metres, z up; NaN where unobserved.
        offsets: (22, 3) or (..., 22, 3) metres, the person's bones.
        fallback: (..., 22, 3, 3) local rotations for what cannot be solved (the last frame's, say); identity
            if left out.

    Returns:
        (..., 22, 3, 3) local rotation matrices, float64.
    """
    return solve_pose(positions, offsets, fallback)[0]


def solve_pose(
    positions: NDArray[np.floating], offsets: NDArray[np.floating], fallback: NDArray[np.floating] | None = None
) -> tuple[Floats, Floats]:
    """`solve_rotations`, and the positions (..., 22, 3) where those rotations put the joints on these bones."""
    p = np.asarray(positions, dtype=np.float64)
    batch, joints = p.shape[:-2], len(PARENTS)
    offsets = np.asarray(offsets, dtype=np.float64)
    rest = _rest_positions(offsets)
    seen = finite_joints(p)
    p = np.where(seen[..., None], p, 0.0)
    local = np.empty((*batch, joints, 3, 3))
    local[...] = _EYE if fallback is None else fallback

    first = seen[..., _AIM].argmax(axis=-1)
    target = _AIM[np.arange(joints), first]
    aimed = np.take_along_axis(seen, target, axis=-1) & _AIMS
    place = np.take_along_axis(p, target[..., None], axis=-2)
    at_rest = np.take_along_axis(np.broadcast_to(rest, p.shape), target[..., None], axis=-2) - rest
    at_rest[~aimed] = _EYE[0]
    against = _against(_normalised(at_rest))

    orientations: list[Floats] = []
    reached: list[Floats] = []
    for depth, level in enumerate(LEVELS):
        if depth == 0:
            above = np.broadcast_to(_EYE, (*batch, 1, 3, 3))
            here = _pelvis(p, seen, rest)
        else:
            parents = [q - LEVELS[depth - 1].start for q in PARENTS[level]]
            above = orientations[-1][..., parents, :, :]
            here = reached[-1][..., parents, :] + _apply(above, offsets[..., level, :])
        back = above.swapaxes(-1, -2)
        if _AIMS[level].any():
            known = aimed[..., level]
            direction = _apply(back, place[..., level, :] - here)
            direction[~known] = _EYE[0]
            turn = _swing(against[..., level, :, :], direction)
            hinges = [j for j in range(level.start, level.stop) if j in _HINGE]
            if hinges:
                k = slice(hinges[0] - level.start, hinges[-1] + 1 - level.start)
                turn[..., k, :, :] = (
                    _twist(hinges, p, seen, back[..., k, :, :], turn[..., k, :, :], direction[..., k, :])
                    @ turn[..., k, :, :]
                )
            local[..., level, :, :] = np.where(known[..., None, None], turn, local[..., level, :, :])
        for joint in _TRUNK_UP:
            if level.start <= joint < level.stop:
                k = joint - level.start
                solved, world = _solve_trunk(joint, p, seen, rest, here[..., k, :])
                local[..., joint, :, :] = np.where(
                    solved[..., None, None], back[..., k, :, :] @ world, local[..., joint, :, :]
                )
        reached.append(here)
        orientations.append(above @ local[..., level, :, :])
    return local, np.concatenate(reached, axis=-2)


def _pelvis(p: Floats, seen: NDArray[np.bool_], rest: Floats) -> Floats:
    """(..., 1, 3) the pelvis: seen, between the hips, or upright below the highest part of the trunk seen."""
    hips, shoulders = [J["left_hip"], J["right_hip"]], [J["left_shoulder"], J["right_shoulder"]]
    place = p[..., :1, :]
    unseen = ~seen[..., 0]
    for group in (hips, [J["spine3"]], [J["neck"]], shoulders):
        if not unseen.any():
            break
        usable = unseen & seen[..., group].all(axis=-1)
        centre = p[..., group, :].mean(axis=-2) - rest[..., group, :].mean(axis=-2) * _EYE[2]
        place = np.where(usable[..., None, None], centre[..., None, :], place)
        unseen = unseen & ~usable
    return place


def _solve_trunk(
    joint: int, p: Floats, seen: NDArray[np.bool_], rest: Floats, here: Floats
) -> tuple[NDArray[np.bool_], Floats]:
    """Which frames show the frame of pelvis or chest, and its rotation in the frame of the positions."""
    frame = np.broadcast_to(_EYE, (*p.shape[:-2], 3, 3))
    solved = np.zeros(p.shape[:-2], dtype=bool)
    for left, right in _TRUNK_LEFT[joint]:
        for above in _TRUNK_UP[joint]:
            group = list(above)
            usable = seen[..., left] & seen[..., right] & seen[..., group].all(axis=-1) & ~solved
            if not usable.any():
                continue
            left_right = np.where(usable[..., None], p[..., left, :] - p[..., right, :], _EYE[1])
            up = np.where(usable[..., None], p[..., group, :].mean(axis=-2) - here, _EYE[2])
            rest_up = rest[..., group, :].mean(axis=-2) - rest[..., joint, :]
            rest_frame = _frame(rest[..., left, :] - rest[..., right, :], rest_up)
            turned = _frame(left_right, up) @ rest_frame.swapaxes(-1, -2)
            frame = np.where(usable[..., None, None], turned, frame)
            solved |= usable
            if solved.all():
                return solved, frame
    return solved, frame


def _twist(
    joints: list[int], p: Floats, seen: NDArray[np.bool_], to_parent: Floats, swung: Floats, bone: Floats
) -> Floats:
    """The rotation about ``bone`` (parent's frame) that puts the hinge below into the plane of the bent limb."""
    middle = [_CHILDREN[j][0] for j in joints]
    end = [_CHILDREN[m][0] for m in middle]
    visible = seen[..., middle] & seen[..., end]
    bone = _normalised(bone)
    normal = _cross(bone, _normalised(_apply(to_parent, p[..., end, :] - p[..., middle, :])))
    bend = np.sqrt(_dot(normal, normal))[..., 0]
    hinge = _apply(swung, np.array([_HINGE[j] for j in joints]))
    angle = np.arctan2(_dot(_cross(hinge, normal), bone)[..., 0], _dot(hinge, normal)[..., 0])
    trust = np.clip((bend - _BEND_NONE) / (_BEND_FULL - _BEND_NONE), 0.0, 1.0)
    return _about(bone, np.where(visible, angle * trust * trust * (3 - 2 * trust), 0.0))


def _rest_positions(offsets: Floats) -> Floats:
    rest = np.zeros_like(offsets)
    for level in LEVELS[1:]:
        rest[..., level, :] = rest[..., list(PARENTS[level]), :] + offsets[..., level, :]
    return rest


# ---------------------------------------------------------------------------------------------------------------
# A person's bones


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
    for joint, ancestor in _seen_bones(seen):
        path = _path(ancestor, joint)
        lengths = np.linalg.norm(p[:, joint] - p[:, ancestor], axis=-1)
        if np.isfinite(lengths).any():
            scale = np.nanmedian(lengths) / np.linalg.norm(REST_OFFSETS[path].sum(axis=0))
            offsets[path] *= scale
    world = global_rotations(solve_rotations(p, offsets))
    for trunk, children in ((0, (J["left_hip"], J["right_hip"])), (J["spine3"], (J["neck"], *_COLLARS))):
        for joint in children:
            end = joint if joint not in _COLLARS or seen[joint] else joint + _COLLAR_TO_SHOULDER
            vectors = np.einsum("tji,tj->ti", world[:, trunk], p[:, end] - p[:, trunk])
            usable = finite_joints(vectors)
            if usable.any():
                offsets[joint] = np.median(vectors[usable], axis=0) - (offsets[end] if end != joint else 0.0)
    return offsets


_COLLARS = (J["left_collar"], J["right_collar"])
_COLLAR_TO_SHOULDER = J["left_shoulder"] - J["left_collar"]


def _seen_bones(seen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(joint, nearest seen ancestor) of each joint that is ever seen."""
    pairs: list[tuple[int, int]] = []
    for joint in range(1, len(PARENTS)):
        ancestor = PARENTS[joint]
        while ancestor > 0 and not seen[ancestor]:
            ancestor = PARENTS[ancestor]
        if seen[joint] and seen[ancestor]:
            pairs.append((joint, ancestor))
    return pairs


def _path(ancestor: int, joint: int) -> list[int]:
    path = []
    while joint != ancestor:
        path.append(joint)
        joint = PARENTS[joint]
    return path


def global_rotations(local: Floats) -> Floats:
    """Rotations (..., 22, 3, 3) in the root's frame of reference, of local rotations (..., 22, 3, 3)."""
    world = local.copy()
    for level in LEVELS[1:]:
        world[..., level, :, :] = world[..., list(PARENTS[level]), :, :] @ local[..., level, :, :]
    return world


def heading(root_rotation: NDArray[np.floating]) -> Floats:
    """Yaw (...) in radians of root rotations (..., 3, 3), z up: where the body's forward axis points.

    From the body's left axis, which stays near the horizontal in every pose but lying on a side, where its
    forward axis does not: a bow turns forward to the floor.
    """
    left = root_rotation[..., :, 1]
    return np.arctan2(-left[..., 0], left[..., 1])


def yaw_matrix(angle: NDArray[np.floating] | float) -> Floats:
    """Rotation (..., 3, 3) about z by ``angle`` (...) radians."""
    angle = np.asarray(angle, dtype=np.float64)
    return _about(np.broadcast_to(_EYE[2], (*angle.shape, 3)), angle)


def rigid_alignment(source: NDArray[np.floating], target: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """The rotation R (3, 3) and translation t (3,) with the least sum of |R source + t - target|².

    Args:
        source: (..., 3) metres; points not finite in either are left out.
        target: the same shape.

    Raises:
        ValueError: fewer than three points are finite in both.
    """
    both = finite_joints(source) & finite_joints(target)
    a, b = source[both], target[both]
    if len(a) < 3:
        raise ValueError(f"alignment: expected at least 3 points that both have, got {len(a)}")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    rotation = Rotation.align_vectors(b - centre_b, a - centre_a)[0].as_matrix()
    return rotation, centre_b - rotation @ centre_a


def label_contacts(positions: NDArray[np.floating], fps: float) -> NDArray[np.bool_]:
    """Contacts from motion: slow and low, in SI units so that no frame rate changes them (HuMoR labels a frame).

    Joint centres do not touch the floor: height is counted from where the centre lies when the limb rests.

    Args:
        positions: (T, 22, 3) metres, world, floor at z = 0.
        fps: frames a second.

    Returns:
        (T, 8) for `CONTACT_JOINTS`.
    """
    p = np.asarray(positions, dtype=np.float64)[:, list(CONTACT_JOINTS)]
    if len(p) < 2:
        return np.zeros((len(p), len(CONTACT_JOINTS)), dtype=bool)
    speed = np.linalg.norm(np.gradient(p, 1.0 / fps, axis=0), axis=-1)
    return (speed < CONTACT_SPEED) & (p[..., 2] - _STANDING_HEIGHT < CONTACT_HEIGHT)
