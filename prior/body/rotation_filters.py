"""Filters of what one frame's joints show badly of rotations: the twist of straight limbs, and how short bones lie.

The plane of a bent limb shows the twist of its upper bone, with an error that grows as the limb straightens: a joint's
noise by the length of the bent part across the bone. A Kalman filter of one angle a limb weighs it so: a process that
returns to the middle of the joint's range (Ornstein and Uhlenbeck), as no limb stays straight and twisted for long.

A bone of 6 to 15 cm shows its direction badly, and turns little: collars, neck, and the spine between chest and pelvis.
They lie to the bones above them as they usually do of this body, the more so the noisier they are. What is usual of a
body is learned from itself: motion files draw these bones each in their own way.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import HINGE
from steadypose.prior.body.kinematics import from_rotation_vectors, to_rotation_vectors
from steadypose.prior.body.skeleton import CHILDREN, COLLARS, HIPS, PARENT, SHOULDERS, J
from steadypose.prior.body.vectors import (
    cross,
    dot,
    normalised,
    point,
    rotated,
    rotated_back,
    write_product,
    write_rotation,
    write_swing,
)
from steadypose.prior.compiled import njit
from steadypose.prior.timing.rate import FPS

TWIST_RANGE, TWIST_MEMORY_S = 0.3, 0.3
"""Standard deviation of a twist that nothing shows, radians, and time in which it returns to the middle, seconds."""
_TWIST_KEPT = math.exp(-1.0 / (TWIST_MEMORY_S * FPS))
UNBENT = 0.2
"""Error of a perfect joint about the plane in which knee or elbow bends, which is no perfect hinge, metres."""

LIMBS = len(HIPS) + len(SHOULDERS)
_BALL = np.array([*HIPS, *SHOULDERS])
_MIDDLE = np.array([CHILDREN[joint][0] for joint in _BALL])
_END = np.array([CHILDREN[joint][0] for joint in _MIDDLE])
_CHAIN_END = np.array([CHILDREN[joint][0] if CHILDREN[joint] else -1 for joint in _END])

_SHORT = [J["spine2"], J["neck"], *COLLARS]
_SHORT_END = [J["spine3"], J["head"], *SHOULDERS]

TURN_RANGE = np.radians((3.0, 25.0, 16.0, 16.0))
"""Standard deviations about an axis by which each of them turns about what is usual of a body, radians."""

BODIES, TURN_MEMORY_S = math.radians(20.0), 60.0
"""Standard deviation about an axis by which what is usual differs between bodies, radians, and time in which it is
forgotten, seconds."""
_TURN_KEPT = math.exp(-1.0 / (TURN_MEMORY_S * FPS))

CORRELATED = 60.0
"""Number of frames that count as one in the estimate of what is usual, as noise and posture last."""

MAX_SIGMA = 0.5
"""Standard deviation of a joint that is not known, metres."""
_LEAST_LENGTH = 0.03  # metres, of a bone


def unknown_twist(slots: int) -> Floats:
    """(S, 4, 2) angle and variance of each limb's twist, of which nothing is known."""
    state = np.zeros((slots, LIMBS, 2))
    state[..., 1] = TWIST_RANGE**2
    return state


def follow_twist(orientations: Floats, offsets: Floats, sigma: Floats, state: Floats) -> None:
    """One frame on: turns limbs about their bones, in place. Directions of bones, and so joints, stay.

    Args:
        orientations: (B, 22, 3, 3) of all joints in one frame of reference, as `solve_rotations` has them.
        offsets: (B, 22, 3) metres, the bones.
        sigma: (B, 22) metres, of the joints solved from, along an axis.
        state: (B, 4, 2) of `unknown_twist`, updated.
    """
    _follow(orientations, offsets, sigma, state)


@njit(cache=True)
def _follow(orientations, offsets, sigma, state):
    turn, twist, swing = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    before = np.empty((3, 3, 3))
    for row in range(len(orientations)):
        world, bones = orientations[row], offsets[row]
        for limb in range(LIMBS):
            ball, middle, end = _BALL[limb], _MIDDLE[limb], _END[limb]
            upper = normalised(rotated(world[ball], point(bones, middle)))
            lower = normalised(rotated(world[middle], point(bones, end)))
            above = world[PARENT[ball]]
            write_swing(point(bones, middle), rotated_back(above, upper), swing)
            write_product(above, swing, turn)
            normal = cross(upper, lower)
            bent = math.sqrt(dot(normal, normal))
            hinge = rotated(turn, point(HINGE, ball))
            shown = math.atan2(dot(cross(hinge, normal), upper), dot(hinge, normal))
            square = 0.0
            for joint in (ball, middle, end):
                square = max(square, min(sigma[row, joint], 1.0) ** 2)
            across = math.sqrt(dot(point(bones, end), point(bones, end))) * bent
            noise = 2.0 * square / max(across * across, 1e-8) + (UNBENT / max(bent, 1e-3)) ** 8
            angle, variance = state[row, limb]
            angle, variance = _TWIST_KEPT * angle, _TWIST_KEPT**2 * variance + (1.0 - _TWIST_KEPT**2) * TWIST_RANGE**2
            off = (shown - angle + math.pi) % (2.0 * math.pi) - math.pi
            gain = variance / (variance + noise)
            angle += gain * off
            angle = (angle + math.pi) % (2.0 * math.pi) - math.pi
            state[row, limb, 0], state[row, limb, 1] = angle, (1.0 - gain) * variance
            for i in range(3):
                for j in range(3):
                    before[0, i, j], before[1, i, j] = world[ball, i, j], world[middle, i, j]
                    before[2, i, j] = world[end, i, j]
            write_rotation(upper, math.sin(angle), math.cos(angle), 1.0 - math.cos(angle), twist)
            write_product(twist, turn, world[ball])
            # knee and elbow swing from the upper bone as it is turned now, and carry what hangs on them
            write_swing(point(bones, end), rotated_back(world[ball], lower), swing)
            write_product(world[ball], swing, world[middle])
            last = _CHAIN_END[limb]
            for i in range(3):
                for j in range(3):
                    turn[i, j] = 0.0
                    for k in range(3):
                        turn[i, j] += before[1, k, i] * before[2, k, j]
            if last >= 0:
                toe = rotated(before[2], point(bones, last))
                write_swing(point(bones, last), rotated_back(world[middle], toe), turn)
            write_product(world[middle], turn, world[end])
            if last >= 0:
                for i in range(3):
                    for j in range(3):
                        before[0, i, j] = 0.0
                        for k in range(3):
                            before[0, i, j] += before[2, k, i] * world[last, k, j]
                write_product(world[end], before[0], swing)
                for i in range(3):
                    for j in range(3):
                        world[last, i, j] = swing[i, j]


def unknown_turns(bodies: int) -> Floats:
    """(B, 4, 4) of each short bone the usual rotation vector and its variance about an axis, of which nothing is
    known."""
    turns = np.zeros((bodies, len(_SHORT), 4))
    turns[..., 3] = BODIES**2
    return turns


def follow_short_bones(orientations: Floats, offsets: Floats, sigma: Floats, turns: Floats) -> None:
    """One frame on: turns short bones towards how they usually lie, in place. All others stay.

    Args:
        orientations: (B, 22, 3, 3) of all joints in one frame of reference, as `solve_rotations` has them.
        offsets: (B, 22, 3) metres, the bones.
        sigma: (B, 22) metres, of the joints solved from, along an axis.
        turns: (B, 4, 4) of `unknown_turns`, updated.
    """
    above = orientations[:, PARENT[_SHORT]]
    shown = to_rotation_vectors(above.swapaxes(-1, -2) @ orientations[:, _SHORT])
    square = np.square(np.fmin(sigma, MAX_SIGMA))
    length = np.maximum(np.linalg.norm(offsets[:, _SHORT_END], axis=-1), _LEAST_LENGTH)
    noise = (square[:, _SHORT] + square[:, _SHORT_END]) / length**2
    variance = _TURN_KEPT**2 * turns[..., 3] + (1.0 - _TURN_KEPT**2) * BODIES**2
    gain = variance / (variance + CORRELATED * (noise + TURN_RANGE**2))
    turns[..., :3] += gain[..., None] * (shown - turns[..., :3])
    turns[..., 3] = (1.0 - gain) * variance
    free = TURN_RANGE**2 + turns[..., 3]
    usual = turns[..., :3]
    turned = usual + (free / (free + noise))[..., None] * (shown - usual)
    orientations[:, _SHORT] = above @ from_rotation_vectors(turned)
