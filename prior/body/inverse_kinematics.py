"""Inverse kinematics: joint positions to local rotations and back, with one person's bones, frame by frame.

The directions of bones determine the swing, the bend of elbows and knees the twist. Rotations are local (child in the
parent's frame). The root's rotation is its orientation in the frame of the positions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import CHILDREN, COLLARS, HIPS, PARENT, PARENTS, SHOULDERS, J, finite_joints
from steadypose.prior.body.vectors import (
    cross,
    difference,
    dot,
    frame_axes,
    middle_of,
    normalised,
    point,
    rotated,
    rotated_back,
    write_product,
    write_rotation,
    write_swing,
)
from steadypose.prior.compiled import njit

# Joints that determine the frames of pelvis and chest, best first: a left-right pair, and a point above, which is the
# midpoint of two joints.
_RIGID_PARTS = np.array([J["pelvis"], J["spine3"]])
_PART_LEFT = np.array([[HIPS, SHOULDERS], [SHOULDERS, COLLARS]])
_PART_UP = np.array(
    [
        [(J["spine3"],) * 2, (J["spine2"],) * 2, (J["neck"],) * 2, SHOULDERS],
        [(J["neck"],) * 2, (J["head"],) * 2, (J["head"],) * 2, (J["head"],) * 2],
    ]
)
# Rigid segments: every bone, and all pairs of joints fixed to the pelvis or to the chest.
_PELVIS_GROUP = (*HIPS, J["spine1"], J["pelvis"])
_CHEST_GROUP = (*COLLARS, J["neck"], J["spine3"])
RIGID = np.array(
    sorted(
        {(joint, parent) for joint, parent in enumerate(PARENTS) if parent >= 0}
        | {(max(a, b), min(a, b)) for group in (_PELVIS_GROUP, _CHEST_GROUP) for a in group for b in group if a != b}
    )
)
"""(R, 2) the joints at the two ends of each rigid segment."""
HELD = 1e-6  # mobility of an observed joint in `fit_lengths`; an unobserved one has 1
_SWEEPS = 20

# Points below which a hidden pelvis is placed upright, best first: each is the midpoint of two joints.
_BELOW = np.array([HIPS, (J["spine3"],) * 2, (J["neck"],) * 2, SHOULDERS])


def _aims() -> NDArray[np.intp]:
    """(22, 4) joints at which each bone aims, nearest first, down to the first branch of the chain; -1 for none."""
    aims = np.full((len(PARENTS), 4), -1)
    for joint in set(range(len(PARENTS))) - set(_RIGID_PARTS.tolist()):
        below = joint
        for k in range(4):
            if len(CHILDREN[below]) != 1:
                break
            below = CHILDREN[below][0]
            aims[joint, k] = below
    return aims


_AIM = _aims()

# Hinge axes of elbows and knees in the rest pose (right-hand rule, flexion positive).
HINGE = np.zeros((len(PARENTS), 3))
HINGE[list(HIPS)] = (0.0, 1.0, 0.0)
HINGE[SHOULDERS[0]] = (0.0, 0.0, -1.0)
HINGE[SHOULDERS[1]] = (0.0, 0.0, 1.0)
_HINGED = np.array([hinge.any() for hinge in HINGE])
# Sines of the bend below which the plane of a limb does not determine its twist, and above which it does so fully.
_BEND_NONE, _BEND_FULL = 0.1, 0.35


def solve_rotations(
    positions: NDArray[np.floating],
    offsets: NDArray[np.floating],
    fallback: NDArray[np.floating] | None = None,
    root: NDArray[np.floating] | None = None,
) -> Floats:
    """Solve local rotations from joint positions.

    The pelvis takes the frame spanned by hips and spine, the chest that of shoulders and neck. Every other joint swings
    its bone from its position in forward kinematics towards the next observed joint below, so that errors do not
    accumulate along the chain. Shoulders and hips also twist, so that the limb bends in the observed plane, as far as
    it is bent enough to show one. 22 positions do not show the twist of neck, head, wrists and feet; it is the
    identity. If the hips are hidden, the pelvis is assumed to be upright below the shoulders.

    Args:
        positions: (..., 22, 3) metres, z up; NaN where unobserved.
        offsets: (22, 3) or (..., 22, 3) metres, the person's bones.
        fallback: (..., 22, 3, 3) local rotations for joints that cannot be solved, such as the last frame's; identity
            if omitted.
        root: (..., 3, 3) orientations of the pelvis, if known; solved if omitted.

    Returns:
        (..., 22, 3, 3) local.
    """
    return solve_pose(positions, offsets, fallback, root)[0]


def solve_pose(
    positions: NDArray[np.floating],
    offsets: NDArray[np.floating],
    fallback: NDArray[np.floating] | None = None,
    root: NDArray[np.floating] | None = None,
) -> tuple[Floats, Floats]:
    """Return the rotations of `solve_rotations`, and the positions (..., 22, 3) that they give with these bones."""
    shape = np.shape(positions)
    p, bones = _frames(positions, shape), _frames(offsets, shape)
    local, placed = np.empty((*p.shape, 3)), np.empty_like(p)
    local[...] = np.eye(3) if fallback is None else np.reshape(fallback, local.shape)
    if root is not None:
        local[:, 0] = np.reshape(root, (-1, 3, 3))
    _solve(p, np.asarray(finite_joints(p)), bones, local, placed, root is not None)
    return local.reshape(*shape, 3), placed.reshape(shape)


def fit_lengths(
    positions: NDArray[np.floating],
    offsets: NDArray[np.floating],
    mobility: NDArray[np.floating],
    length_variance: NDArray[np.floating] | float = 0.0,
) -> Floats:
    """Return the joints nearest to the positions that have the lengths of these bones.

    `solve_pose` follows the chain, so the whole error of a bone's length moves the joint at its end and all joints
    below. Here, every bone and every rigid segment of the trunk pulls at both its ends until the lengths match, by
    Gauss-Newton sweeps over the distances (position-based dynamics, Müller et al. 2007). Uncertain lengths are
    compliant constraints, with their variance as the compliance (XPBD, Macklin et al. 2016).

    Args:
        positions: (..., 22, 3) metres, all finite.
        offsets: (22, 3) or (..., 22, 3) metres, the person's bones.
        mobility: (..., 22) variance of each joint, in any unit.
        length_variance: (..., R) variance of the length of each `RIGID` segment, in the same unit.

    Returns:
        (..., 22, 3) metres.
    """
    shape = np.shape(positions)
    p, bones = _frames(positions, shape), _frames(offsets, shape)
    yields, variance = np.empty(shape[:-1]), np.empty((*shape[:-2], len(RIGID)))
    yields[...], variance[...] = mobility, length_variance
    _constrain(p, bones, yields.reshape(p.shape[:-1]), variance.reshape(len(p), len(RIGID)))
    return p.reshape(shape)


def place_joints(rotations: NDArray[np.floating], offsets: NDArray[np.floating]) -> Floats:
    """Forward kinematics without gradients: positions (..., 22, 3) metres, with the root at the origin, of local
    rotations (..., 22, 3, 3) and offsets (22, 3) or (..., 22, 3) metres."""
    bones = _frames(offsets, shape := np.shape(rotations)[:-1])
    placed = np.empty_like(bones)
    _place(np.array(rotations, dtype=np.float64, order="C").reshape(*bones.shape, 3), bones, placed)
    return placed.reshape(shape)


def _frames(values: NDArray[np.floating], shape: tuple[int, ...]) -> Floats:
    """(B, 22, 3) float64 copy of values broadcast to ``shape``. Compiled code does not accept read-only arrays."""
    frames = np.empty(shape)
    frames[...] = values
    return frames.reshape(-1, *shape[-2:])


@njit(cache=True)
def _write_rest(offsets, rest):
    """Write the joints (22, 3) of the rest pose with these bones."""
    for i in range(3):
        rest[0, i] = 0.0
        for joint in range(1, len(PARENT)):
            rest[joint, i] = rest[PARENT[joint], i] + offsets[joint, i]


@njit(cache=True)
def _pelvis(p, observed, rest):
    """The pelvis: observed, between the hips, or upright below the best observed point of the trunk."""
    if observed[0]:
        return point(p, 0)
    for k in range(len(_BELOW)):
        if observed[_BELOW[k, 0]] and observed[_BELOW[k, 1]]:
            place = middle_of(p, _BELOW[k])
            return place[0], place[1], place[2] - middle_of(rest, _BELOW[k])[2]
    return 0.0, 0.0, 0.0


@njit(cache=True)
def _write_trunk(which, p, observed, rest, here, above, out):
    """Write the rotation of pelvis (0) or chest (1), local to its parent's ``above``, if this frame determines it."""
    joint = _RIGID_PARTS[which]
    for k in range(len(_PART_LEFT[which])):
        left, right = _PART_LEFT[which, k]
        for m in range(len(_PART_UP[which])):
            a, b = _PART_UP[which, m]
            if observed[left] and observed[right] and observed[a] and observed[b]:
                shown = frame_axes(difference(point(p, left), point(p, right)), difference(middle_of(p, (a, b)), here))
                resting = frame_axes(
                    difference(point(rest, left), point(rest, right)),
                    difference(middle_of(rest, (a, b)), point(rest, joint)),
                )
                x, y, z = rotated_back(above, shown[0]), rotated_back(above, shown[1]), rotated_back(above, shown[2])
                for i in range(3):
                    for j in range(3):
                        out[i, j] = x[i] * resting[0][j] + y[i] * resting[1][j] + z[i] * resting[2][j]
                return


@njit(cache=True)
def _constrain(positions, offsets, mobility, length_variance):
    """Move ``positions`` (B, 22, 3) of B frames, in place, until the rigid segments have their lengths."""
    rest = np.empty((len(PARENT), 3))
    length = np.empty(len(RIGID))
    force = np.empty(len(RIGID))
    for frame in range(len(positions)):
        p, yields, compliance = positions[frame], mobility[frame], length_variance[frame]
        _write_rest(offsets[frame], rest)
        for k in range(len(RIGID)):
            bone = difference(point(rest, RIGID[k, 0]), point(rest, RIGID[k, 1]))
            length[k] = math.sqrt(dot(bone, bone))
            force[k] = 0.0
        for _ in range(_SWEEPS):
            for k in range(len(RIGID)):
                a, b = RIGID[k]
                apart = difference(point(p, a), point(p, b))
                now = max(math.sqrt(dot(apart, apart)), 1e-9)
                pull = (now - length[k] - compliance[k] * force[k]) / (yields[a] + yields[b] + compliance[k])
                force[k] += pull
                for i in range(3):
                    along = pull / now * apart[i]
                    p[a, i] -= yields[a] * along
                    p[b, i] += yields[b] * along


@njit(cache=True)
def _twist(joint, p, observed, above, turn, bone):
    """Return the angle about unit ``bone`` (parent's frame) by which to twist ``turn``.

    It makes the hinge axis normal to the plane of the limb, as far as the limb is bent.
    """
    middle, end = _AIM[joint, 0], _AIM[joint, 1]
    if not (observed[middle] and observed[end]):
        return 0.0
    normal = cross(bone, normalised(rotated_back(above, difference(point(p, end), point(p, middle)))))
    share = (math.sqrt(dot(normal, normal)) - _BEND_NONE) / (_BEND_FULL - _BEND_NONE)
    share = min(max(share, 0.0), 1.0)
    hinge = rotated(turn, point(HINGE, joint))
    angle = math.atan2(dot(cross(hinge, normal), bone), dot(hinge, normal))
    return angle * share * share * (3.0 - 2.0 * share)


@njit(cache=True)
def _solve(positions, known, offsets, local, placed, root_known):
    """Write ``placed`` (B, 22, 3) and the solvable part of ``local`` (B, 22, 3, 3); the root unless ``root_known``."""
    joints = len(PARENT)
    rest = np.empty((joints, 3))
    world = np.empty((joints, 3, 3))
    turn, twist = np.empty((3, 3)), np.empty((3, 3))
    upright = np.eye(3)
    for frame in range(len(positions)):
        p, observed, bones = positions[frame], known[frame], offsets[frame]
        _write_rest(bones, rest)
        for joint in range(joints):
            if joint == 0:
                above, here = upright, _pelvis(p, observed, rest)
            else:
                above = world[PARENT[joint]]
                bone = rotated(above, point(bones, joint))
                start = point(placed[frame], PARENT[joint])
                here = (start[0] + bone[0], start[1] + bone[1], start[2] + bone[2])
            for i in range(3):
                placed[frame, joint, i] = here[i]
            for which in range(len(_RIGID_PARTS)):
                if joint == _RIGID_PARTS[which] and not (root_known and joint == 0):
                    _write_trunk(which, p, observed, rest, here, above, local[frame, joint])
            for k in range(_AIM.shape[1]):
                target = _AIM[joint, k]
                if target >= 0 and observed[target]:
                    direction = rotated_back(above, difference(point(p, target), here))
                    write_swing(difference(point(rest, target), point(rest, joint)), direction, turn)
                    direction = normalised(direction)
                    angle = _twist(joint, p, observed, above, turn, direction) if _HINGED[joint] else 0.0
                    write_rotation(direction, math.sin(angle), math.cos(angle), 1.0 - math.cos(angle), twist)
                    write_product(twist, turn, local[frame, joint])
                    break
            write_product(above, local[frame, joint], world[joint])


@njit(cache=True)
def _place(local, offsets, placed):
    """Write ``placed`` (B, 22, 3) of B frames."""
    world = np.empty((len(PARENT), 3, 3))
    for frame in range(len(local)):
        for i in range(3):
            placed[frame, 0, i] = 0.0
            for j in range(3):
                world[0, i, j] = local[frame, 0, i, j]
        for joint in range(1, len(PARENT)):
            above = world[PARENT[joint]]
            bone = rotated(above, point(offsets[frame], joint))
            for i in range(3):
                placed[frame, joint, i] = placed[frame, PARENT[joint], i] + bone[i]
            write_product(above, local[frame, joint], world[joint])
