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
_HINGE = np.zeros((len(PARENTS), 3))
_HINGE[list(HIPS)] = (0.0, 1.0, 0.0)
_HINGE[SHOULDERS[0]] = (0.0, 0.0, -1.0)
_HINGE[SHOULDERS[1]] = (0.0, 0.0, 1.0)
_HINGED = np.array([hinge.any() for hinge in _HINGE])
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


# ---------------------------------------------------------------------------------------------------------------
# Vectors (x, y, z) are tuples: each assignment of an array to a part of another takes a second more to compile.


@njit(cache=True)
def _at(points, joint):
    return points[joint, 0], points[joint, 1], points[joint, 2]


@njit(cache=True)
def _less(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def _middle(points, joints):
    (ax, ay, az), (bx, by, bz) = _at(points, joints[0]), _at(points, joints[1])
    return (ax + bx) / 2.0, (ay + by) / 2.0, (az + bz) / 2.0


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _normalised(v):
    length = max(math.sqrt(_dot(v, v)), 1e-9)
    return v[0] / length, v[1] / length, v[2] / length


@njit(cache=True)
def _turned(m, v):
    """``m @ v``"""
    return (
        m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2],
        m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2],
        m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2],
    )


@njit(cache=True)
def _turned_back(m, v):
    """``m.T @ v``"""
    return (
        m[0, 0] * v[0] + m[1, 0] * v[1] + m[2, 0] * v[2],
        m[0, 1] * v[0] + m[1, 1] * v[1] + m[2, 1] * v[2],
        m[0, 2] * v[0] + m[1, 2] * v[1] + m[2, 2] * v[2],
    )


@njit(cache=True)
def write_product(a, b, out):
    """Write ``a @ b``, both (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def _axes(left, up):
    """Of a right-handed frame, forward, left and up: y along ``left``, z in the plane of ``up``."""
    y = _normalised(left)
    x = _normalised(_cross(y, up))
    return x, y, _cross(x, y)


@njit(cache=True)
def write_rotation(axis, sine, cosine, rest, out):
    """Write Rodrigues' rotation: ``sine`` times the cross product with ``axis``, ``cosine`` times the identity, and
    ``rest`` times the outer product of ``axis`` with itself."""
    for i in range(3):
        for j in range(3):
            out[i, j] = rest * axis[i] * axis[j]
        out[i, i] += cosine
    out[0, 1] -= sine * axis[2]
    out[0, 2] += sine * axis[1]
    out[1, 0] += sine * axis[2]
    out[1, 2] -= sine * axis[0]
    out[2, 0] -= sine * axis[1]
    out[2, 1] += sine * axis[0]


@njit(cache=True)
def write_swing(a, b, out):
    """Write the smallest rotation (3, 3) that turns direction ``a`` into ``b``."""
    a, b = _normalised(a), _normalised(b)
    cosine = _dot(a, b)
    if cosine < -1.0 + 1e-8:  # opposite directions have no smallest rotation: any half turn will do
        other = (1.0, 0.0, 0.0) if abs(a[0]) < 0.9 else (0.0, 1.0, 0.0)
        write_rotation(_normalised(_cross(a, other)), 0.0, -1.0, 2.0, out)
    else:
        write_rotation(_cross(a, b), 1.0, cosine, 1.0 / (1.0 + cosine), out)


# ---------------------------------------------------------------------------------------------------------------
# A frame


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
        return _at(p, 0)
    for k in range(len(_BELOW)):
        if seen[_BELOW[k, 0]] and seen[_BELOW[k, 1]]:
            place = _middle(p, _BELOW[k])
            return place[0], place[1], place[2] - _middle(rest, _BELOW[k])[2]
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
                shown = _axes(_less(_at(p, left), _at(p, right)), _less(_middle(p, (a, b)), here))
                resting = _axes(
                    _less(_at(rest, left), _at(rest, right)), _less(_middle(rest, (a, b)), _at(rest, joint))
                )
                x, y, z = _turned_back(above, shown[0]), _turned_back(above, shown[1]), _turned_back(above, shown[2])
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
            bone = _less(_at(rest, RIGID[k, 0]), _at(rest, RIGID[k, 1]))
            length[k] = math.sqrt(_dot(bone, bone))
            force[k] = 0.0
        for _ in range(_SWEEPS):
            for k in range(len(RIGID)):
                a, b = RIGID[k]
                apart = _less(_at(p, a), _at(p, b))
                now = max(math.sqrt(_dot(apart, apart)), 1e-9)
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
    normal = _cross(bone, _normalised(_turned_back(above, _less(_at(p, end), _at(p, middle)))))
    share = (math.sqrt(_dot(normal, normal)) - _BEND_NONE) / (_BEND_FULL - _BEND_NONE)
    share = min(max(share, 0.0), 1.0)
    hinge = _turned(turn, _at(_HINGE, joint))
    angle = math.atan2(_dot(_cross(hinge, normal), bone), _dot(hinge, normal))
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
                bone = _turned(above, _at(bones, joint))
                start = _at(placed[frame], PARENT[joint])
                here = (start[0] + bone[0], start[1] + bone[1], start[2] + bone[2])
            for i in range(3):
                placed[frame, joint, i] = here[i]
            for which in range(len(_RIGID_PARTS)):
                if joint == _RIGID_PARTS[which] and not (root_known and joint == 0):
                    _write_trunk(which, p, seen, rest, here, above, local[frame, joint])
            for k in range(_AIM.shape[1]):
                target = _AIM[joint, k]
                if target >= 0 and seen[target]:
                    direction = _turned_back(above, _less(_at(p, target), here))
                    write_swing(_less(_at(rest, target), _at(rest, joint)), direction, turn)
                    direction = _normalised(direction)
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
            bone = _turned(above, _at(offsets[frame], joint))
            for i in range(3):
                placed[frame, joint, i] = placed[frame, PARENT[joint], i] + bone[i]
            write_product(above, local[frame, joint], world[joint])
