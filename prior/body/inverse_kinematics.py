"""From joint positions to local rotations and back, on one person's bones, frame by frame.

Swing comes from the directions of the bones, twist from the bend of elbows and knees. The loops are compiled by numba:
the live node solves two poses a body thirty times a second, where an array operation a step would cost ten times the
arithmetic. Rotations are local (child in parent's frame); the root's is its orientation in the frame of the positions.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import CHILDREN, COLLARS, HIPS, PARENT, PARENTS, SHOULDERS, J, finite_joints

Floats = NDArray[np.float64]

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
# The sine of the bend below which the plane of a limb says nothing of its twist, and above which it says all.
_BEND_NONE, _BEND_FULL = 0.1, 0.35


def solve_rotations(
    positions: NDArray[np.floating], offsets: NDArray[np.floating], fallback: NDArray[np.floating] | None = None
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

    Returns:
        (..., 22, 3, 3) local rotation matrices, float64.
    """
    return solve_pose(positions, offsets, fallback)[0]


def solve_pose(
    positions: NDArray[np.floating], offsets: NDArray[np.floating], fallback: NDArray[np.floating] | None = None
) -> tuple[Floats, Floats]:
    """`solve_rotations`, and the positions (..., 22, 3) where those rotations put the joints on these bones."""
    shape = np.shape(positions)
    p, bones = _frames(positions, shape), _frames(offsets, shape)
    local, placed = _initial(fallback, p), np.empty_like(p)
    _solve(p, np.asarray(finite_joints(p)), bones, local, placed)
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
    shape = np.shape(rotations)[:-1]
    bones = _frames(offsets, shape)
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
# Vectors (3,) and matrices (3, 3)


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True)
def _normalised(v):
    return v / max(np.sqrt(_dot(v, v)), 1e-9)


@njit(cache=True)
def _product(a, b):
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@njit(cache=True)
def _turned(m, v):
    return np.array([_dot(m[0], v), _dot(m[1], v), _dot(m[2], v)])


@njit(cache=True)
def _turned_back(m, v):
    return m[0] * v[0] + m[1] * v[1] + m[2] * v[2]


@njit(cache=True)
def _frame(left, up):
    """Right-handed frame, columns forward, left, up: y along ``left``, z in the plane of ``up``."""
    y = _normalised(left)
    x = _normalised(_cross(y, up))
    z = _cross(x, y)
    out = np.empty((3, 3))
    out[:, 0], out[:, 1], out[:, 2] = x, y, z
    return out


@njit(cache=True)
def _about(axis, angle):
    """The rotation about unit ``axis`` by ``angle`` radians."""
    s, c = np.sin(angle), np.cos(angle)
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = (1.0 - c) * axis[i] * axis[j]
        out[i, i] += c
    out[0, 1] -= s * axis[2]
    out[0, 2] += s * axis[1]
    out[1, 0] += s * axis[2]
    out[1, 2] -= s * axis[0]
    out[2, 0] -= s * axis[1]
    out[2, 1] += s * axis[0]
    return out


@njit(cache=True)
def swing(a, b):
    """The smallest rotation (3, 3) that turns direction ``a`` (3,) into ``b`` (3,)."""
    a, b = _normalised(a), _normalised(b)
    axis, cosine = _cross(a, b), _dot(a, b)
    if cosine < -1.0 + 1e-8:  # opposite directions have no smallest rotation: any half turn will do
        other = np.array([1.0, 0.0, 0.0]) if abs(a[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        return _about(_normalised(_cross(a, other)), np.pi)
    out = np.empty((3, 3))
    for i in range(3):  # Rodrigues without the angle
        for j in range(3):
            out[i, j] = axis[i] * axis[j] / (1.0 + cosine)
        out[i, i] += cosine
    out[0, 1] -= axis[2]
    out[0, 2] += axis[1]
    out[1, 0] += axis[2]
    out[1, 2] -= axis[0]
    out[2, 0] -= axis[1]
    out[2, 1] += axis[0]
    return out


# ---------------------------------------------------------------------------------------------------------------
# A frame


@njit(cache=True)
def _pelvis(p, seen, rest):
    """The pelvis: seen, between the hips, or upright below the highest part of the trunk seen."""
    if not seen[0]:
        for a, b in _BELOW:
            if seen[a] and seen[b]:
                place = (p[a] + p[b]) / 2.0
                place[2] -= (rest[a, 2] + rest[b, 2]) / 2.0
                return place
    return np.where(np.isfinite(p[0]), p[0], 0.0)


@njit(cache=True)
def _trunk(which, p, seen, rest, here):
    """Whether the frame shows pelvis (0) or chest (1), and its rotation in the frame of the positions."""
    joint = _RIGID_PARTS[which]
    for left, right in _PART_LEFT[which]:
        for a, b in _PART_UP[which]:
            if seen[left] and seen[right] and seen[a] and seen[b]:
                shown = _frame(p[left] - p[right], (p[a] + p[b]) / 2.0 - here)
                at_rest = _frame(rest[left] - rest[right], (rest[a] + rest[b]) / 2.0 - rest[joint])
                return True, _product(shown, at_rest.T)
    return False, np.eye(3)


@njit("(f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[:,::1])", cache=True)
def _constrain(positions, offsets, mobility, length_variance):
    """Of B frames: moves ``positions`` (B, 22, 3) until what is rigid has its lengths."""
    rest = np.empty((len(PARENT), 3))
    length = np.empty(len(RIGID))
    force = np.empty(len(RIGID))
    for frame in range(len(positions)):
        p, yields, compliance = positions[frame], mobility[frame], length_variance[frame]
        rest[0] = 0.0
        for joint in range(1, len(PARENT)):
            rest[joint] = rest[PARENT[joint]] + offsets[frame, joint]
        for k in range(len(RIGID)):
            bone = rest[RIGID[k, 0]] - rest[RIGID[k, 1]]
            length[k] = np.sqrt(_dot(bone, bone))
            force[k] = 0.0
        for _ in range(_SWEEPS):
            for k in range(len(RIGID)):
                a, b = RIGID[k]
                squared = 0.0
                for i in range(3):  # no vectors here: in the innermost loop, making them would take most of the time
                    squared += (p[a, i] - p[b, i]) ** 2
                now = max(np.sqrt(squared), 1e-9)
                pull = (now - length[k] - compliance[k] * force[k]) / (yields[a] + yields[b] + compliance[k])
                force[k] += pull
                for i in range(3):
                    along = pull / now * (p[a, i] - p[b, i])
                    p[a, i] -= yields[a] * along
                    p[b, i] += yields[b] * along


@njit(cache=True)
def _twist(joint, p, seen, above, turn, bone):
    """``turn``, twisted about ``bone`` (parent's frame) so that the hinge below lies in the plane of the bent limb."""
    middle = _AIM[joint, 0]
    end = _AIM[joint, 1]
    if not (seen[middle] and seen[end]):
        return turn
    bone = _normalised(bone)
    normal = _cross(bone, _normalised(_turned_back(above, p[end] - p[middle])))
    share = (np.sqrt(_dot(normal, normal)) - _BEND_NONE) / (_BEND_FULL - _BEND_NONE)
    share = min(max(share, 0.0), 1.0)
    hinge = _turned(turn, _HINGE[joint])
    angle = np.arctan2(_dot(_cross(hinge, normal), bone), _dot(hinge, normal))
    return _product(_about(bone, angle * share * share * (3.0 - 2.0 * share)), turn)


@njit("(f8[:,:,::1], b1[:,::1], f8[:,:,::1], f8[:,:,:,::1], f8[:,:,::1])", cache=True)
def _solve(positions, observed, offsets, local, placed):
    """Of B frames: writes ``placed`` (B, 22, 3), and into ``local`` (B, 22, 3, 3) what can be solved."""
    joints = len(PARENT)
    rest = np.empty((joints, 3))
    world = np.empty((joints, 3, 3))
    for frame in range(len(positions)):
        p, seen, bones = positions[frame], observed[frame], offsets[frame]
        rest[0] = 0.0
        for joint in range(1, joints):
            rest[joint] = rest[PARENT[joint]] + bones[joint]
        for joint in range(joints):
            if joint == 0:
                above, here = np.eye(3), _pelvis(p, seen, rest)
            else:
                above = world[PARENT[joint]]
                here = placed[frame, PARENT[joint]] + _turned(above, bones[joint])
            placed[frame, joint] = here
            for which in range(len(_RIGID_PARTS)):
                if joint == _RIGID_PARTS[which]:
                    solved, orientation = _trunk(which, p, seen, rest, here)
                    if solved:
                        local[frame, joint] = _product(above.T, orientation)
            for target in _AIM[joint]:
                if target >= 0 and seen[target]:
                    direction = _turned_back(above, p[target] - here)
                    turn = swing(rest[target] - rest[joint], direction)
                    if _HINGE[joint].any():
                        turn = _twist(joint, p, seen, above, turn, direction)
                    local[frame, joint] = turn
                    break
            world[joint] = _product(above, local[frame, joint])


@njit("(f8[:,:,:,::1], f8[:,:,::1], f8[:,:,::1])", cache=True)
def _place(local, offsets, placed):
    """Of B frames: writes ``placed`` (B, 22, 3)."""
    world = np.empty((len(PARENT), 3, 3))
    for frame in range(len(local)):
        placed[frame, 0] = 0.0
        world[0] = local[frame, 0]
        for joint in range(1, len(PARENT)):
            above = world[PARENT[joint]]
            placed[frame, joint] = placed[frame, PARENT[joint]] + _turned(above, offsets[frame, joint])
            world[joint] = _product(above, local[frame, joint])
