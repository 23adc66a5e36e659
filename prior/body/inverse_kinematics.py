"""From joint positions to local rotations and back, on one person's bones, frame by frame.

Swing comes from the directions of the bones, twist from the bend of elbows and knees. Rotations are local (child in
parent's frame); the root's is its orientation in the frame of the positions.
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

# What shows the frame of pelvis and chest, best first: a left-right pair, and a place above, the middle of two joints.
_RIGID_PARTS = np.array([J["pelvis"], J["spine3"]])
_PART_LEFT = np.array([[HIPS, SHOULDERS], [SHOULDERS, COLLARS]])
_PART_UP = np.array(
    [
        [(J["spine3"],) * 2, (J["spine2"],) * 2, (J["neck"],) * 2, SHOULDERS],
        [(J["neck"],) * 2, (J["head"],) * 2, (J["head"],) * 2, (J["head"],) * 2],
    ]
)
# What is rigid on constant bones: every bone, and what pelvis and chest carry.
_PELVIS_GROUP = (*HIPS, J["spine1"], J["pelvis"])
_CHEST_GROUP = (*COLLARS, J["neck"], J["spine3"])
RIGID = np.array(
    sorted(
        {(joint, parent) for joint, parent in enumerate(PARENTS) if parent >= 0}
        | {(max(a, b), min(a, b)) for group in (_PELVIS_GROUP, _CHEST_GROUP) for a in group for b in group if a != b}
    )
)
"""(R, 2) the joints at the ends of each."""
HELD = 1e-6
"""Mobility of an observed joint in `fit_lengths`, relative to 1 of an unobserved one."""
_SWEEPS = 20

# Where the pelvis is upright below, when it is hidden itself: the middle of two joints, best first.
_BELOW = np.array([HIPS, (J["spine3"],) * 2, (J["neck"],) * 2, SHOULDERS])


def _aims() -> NDArray[np.intp]:
    """(22, 4) joints to aim at, nearest first, as far as the chain below does not branch; -1 for none."""
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

# The hinge axes in the rest pose, about which elbows and knees flex (right-hand rule, flexion positive).
HINGE = np.zeros((len(PARENTS), 3))
HINGE[list(HIPS)] = (0.0, 1.0, 0.0)
HINGE[SHOULDERS[0]] = (0.0, 0.0, -1.0)
HINGE[SHOULDERS[1]] = (0.0, 0.0, 1.0)
_HINGED = np.array([hinge.any() for hinge in HINGE])
# The sine of the bend below which the plane of a limb shows nothing of its twist, and above which it shows all.
_BEND_NONE, _BEND_FULL = 0.1, 0.35


def solve_rotations(
    positions: NDArray[np.floating],
    offsets: NDArray[np.floating],
    fallback: NDArray[np.floating] | None = None,
    root: NDArray[np.floating] | None = None,
) -> Floats:
    """Local rotations from joint positions.

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
        root: (..., 3, 3) orientations of the pelvis, where they are known; solved if left out.

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
    """`solve_rotations`, and the positions (..., 22, 3) where those rotations put the joints on these bones."""
    shape = np.shape(positions)
    p, bones = _frames(positions, shape), _frames(offsets, shape)
    local, placed = _initial(fallback, p), np.empty_like(p)
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
    """The joints nearest to the positions whose bones are as long as these.

    `solve_pose` follows the chain: where a bone seems too long or short, all of that goes to its end, and on to what
    hangs from it. Here every bone and every rigid part of the trunk pulls at both its ends until the lengths are
    right, by sweeps of Gauss-Newton over the distances (position-based dynamics, Müller et al. 2007). Lengths that
    are uncertain give way as their variance says (compliant constraints, XPBD, Macklin et al. 2016).

    Args:
        positions: (..., 22, 3) metres, all of them finite.
        offsets: (22, 3) or (..., 22, 3) metres, the person's bones.
        mobility: (..., 22) how easily each joint yields: its variance, in any unit.
        length_variance: (..., R) of the length of each of `RIGID`, in that unit.

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
    """Forward kinematics without gradients: positions (..., 22, 3) metres, the root at the origin.

    Args:
        rotations: (..., 22, 3, 3) local.
        offsets: (22, 3) or (..., 22, 3) metres.
    """
    bones = _frames(offsets, shape := np.shape(rotations)[:-1])
    placed = np.empty_like(bones)
    _place(np.array(rotations, dtype=np.float64, order="C").reshape(*bones.shape, 3), bones, placed)
    return placed.reshape(shape)


def _initial(fallback: NDArray[np.floating] | None, positions: Floats) -> Floats:
    """(B, 22, 3, 3) local rotations to start from."""
    local = np.empty((*positions.shape, 3))
    local[...] = np.eye(3) if fallback is None else np.reshape(fallback, local.shape)
    return local


def _frames(values: NDArray[np.floating], shape: tuple[int, ...]) -> Floats:
    """(B, 22, 3) float64 of values that broadcast to ``shape``; a copy, as compiled code takes no read-only arrays."""
    frames = np.empty(shape)
    frames[...] = values
    return frames.reshape(-1, *shape[-2:])


@njit(cache=True)
def _write_rest(offsets, rest):
    """Write where the joints (22, 3) of the rest pose are, on these bones."""
    for i in range(3):
        rest[0, i] = 0.0
        for joint in range(1, len(PARENT)):
            rest[joint, i] = rest[PARENT[joint], i] + offsets[joint, i]


@njit(cache=True)
def _pelvis(p, seen, rest):
    """The pelvis: seen, between the hips, or upright below the highest part of the trunk seen."""
    if seen[0]:
        return point(p, 0)
    for k in range(len(_BELOW)):
        if seen[_BELOW[k, 0]] and seen[_BELOW[k, 1]]:
            place = middle_of(p, _BELOW[k])
            return place[0], place[1], place[2] - middle_of(rest, _BELOW[k])[2]
    return 0.0, 0.0, 0.0


@njit(cache=True)
def _write_trunk(which, p, seen, rest, here, above, out):
    """Write the rotation of pelvis (0) or chest (1), local to its parent's, ``above``, if the frame shows it."""
    joint = _RIGID_PARTS[which]
    for k in range(len(_PART_LEFT[which])):
        left, right = _PART_LEFT[which, k]
        for m in range(len(_PART_UP[which])):
            a, b = _PART_UP[which, m]
            if seen[left] and seen[right] and seen[a] and seen[b]:
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
    """Of B frames: moves ``positions`` (B, 22, 3) until what is rigid has its lengths."""
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
def _twist(joint, p, seen, above, turn, bone):
    """The angle about unit ``bone`` (parent's frame) by which ``turn`` is to be twisted so that the hinge below lies in
    the plane of the bent limb."""
    middle, end = _AIM[joint, 0], _AIM[joint, 1]
    if not (seen[middle] and seen[end]):
        return 0.0
    normal = cross(bone, normalised(rotated_back(above, difference(point(p, end), point(p, middle)))))
    share = (math.sqrt(dot(normal, normal)) - _BEND_NONE) / (_BEND_FULL - _BEND_NONE)
    share = min(max(share, 0.0), 1.0)
    hinge = rotated(turn, point(HINGE, joint))
    angle = math.atan2(dot(cross(hinge, normal), bone), dot(hinge, normal))
    return angle * share * share * (3.0 - 2.0 * share)


@njit(cache=True)
def _solve(positions, observed, offsets, local, placed, root_known):
    """Of B frames: writes ``placed`` (B, 22, 3), and into ``local`` (B, 22, 3, 3) what can be solved; the root's only
    if it is not ``root_known``."""
    joints = len(PARENT)
    rest = np.empty((joints, 3))
    world = np.empty((joints, 3, 3))
    turn, twist = np.empty((3, 3)), np.empty((3, 3))
    upright = np.eye(3)
    for frame in range(len(positions)):
        p, seen, bones = positions[frame], observed[frame], offsets[frame]
        _write_rest(bones, rest)
        for joint in range(joints):
            if joint == 0:
                above, here = upright, _pelvis(p, seen, rest)
            else:
                above = world[PARENT[joint]]
                bone = rotated(above, point(bones, joint))
                start = point(placed[frame], PARENT[joint])
                here = (start[0] + bone[0], start[1] + bone[1], start[2] + bone[2])
            for i in range(3):
                placed[frame, joint, i] = here[i]
            for which in range(len(_RIGID_PARTS)):
                if joint == _RIGID_PARTS[which] and not (root_known and joint == 0):
                    _write_trunk(which, p, seen, rest, here, above, local[frame, joint])
            for k in range(_AIM.shape[1]):
                target = _AIM[joint, k]
                if target >= 0 and seen[target]:
                    direction = rotated_back(above, difference(point(p, target), here))
                    write_swing(difference(point(rest, target), point(rest, joint)), direction, turn)
                    direction = normalised(direction)
                    angle = _twist(joint, p, seen, above, turn, direction) if _HINGED[joint] else 0.0
                    write_rotation(direction, math.sin(angle), math.cos(angle), 1.0 - math.cos(angle), twist)
                    write_product(twist, turn, local[frame, joint])
                    break
            write_product(above, local[frame, joint], world[joint])


@njit(cache=True)
def _place(local, offsets, placed):
    """Of B frames: writes ``placed`` (B, 22, 3)."""
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
