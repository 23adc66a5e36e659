"""Filters for rotations that one frame's joints hardly show: the twist of straight limbs, the direction of short bones.

The plane of a bent limb shows the twist of its upper bone. The error of this twist is a joint's noise divided by the
length of the lower bone across the upper one, so it grows as the limb straightens. A Kalman filter with one angle per
limb weighs it accordingly. Its process is an Ornstein-Uhlenbeck process that returns to the middle of the joint's
range, because no limb stays straight and twisted for long.

Bones of 6 to 15 cm (collars, neck, and the spine between chest and pelvis) hardly show their direction, but turn
little. They are rotated towards their usual direction relative to the bone above, by more if their joints are noisier.
The usual direction is learned from the body itself, because motion files draw these bones differently.
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
    write_relative,
    write_rotation,
    write_swing,
)
from steadypose.prior.compiled import njit
from steadypose.prior.timing.rate import FPS

TWIST_RANGE, TWIST_MEMORY_S = 0.3, 0.3
"""Standard deviation of an unobserved twist, radians, and time constant of its return to the middle, seconds."""
_TWIST_KEPT = math.exp(-1.0 / (TWIST_MEMORY_S * FPS))
UNBENT = 0.2
"""Sine of the bend at which the twist's error is 1 radian even without noise, as knee and elbow are no perfect
hinges."""

LIMBS = len(HIPS) + len(SHOULDERS)
_BALL = np.array([*HIPS, *SHOULDERS])
_MIDDLE = np.array([CHILDREN[joint][0] for joint in _BALL])
_END = np.array([CHILDREN[joint][0] for joint in _MIDDLE])
_CHAIN_END = np.array([CHILDREN[joint][0] if CHILDREN[joint] else -1 for joint in _END])

_SHORT = [J["spine2"], J["neck"], *COLLARS]
_SHORT_END = [J["spine3"], J["head"], *SHOULDERS]

TURN_RANGE = np.radians((3.0, 25.0, 16.0, 16.0))
"""Standard deviation about an axis of each short bone's rotation from its usual direction, radians."""

BODIES, TURN_MEMORY_S = math.radians(20.0), 60.0
"""Standard deviation about an axis of the usual directions between bodies, radians, and time constant with which a
usual direction is forgotten, seconds."""
_TURN_KEPT = math.exp(-1.0 / (TURN_MEMORY_S * FPS))

CORRELATED = 60.0
"""Number of frames that count as one in the estimate of the usual direction: noise and posture are time-correlated."""

MAX_SIGMA = 0.5  # standard deviation of an unknown joint, metres
_LEAST_LENGTH = 0.03  # least length of a bone, metres

UNKNOWN_TWIST: Floats = np.tile([0.0, TWIST_RANGE**2], (LIMBS, 1))
"""(4, 2) angle and variance of each limb's twist before the first observation."""

UNKNOWN_TURNS: Floats = np.tile([0.0, 0.0, 0.0, BODIES**2], (len(_SHORT), 1))
"""(4, 4) usual rotation vector of each short bone and its variance about an axis, before any observation."""


@njit(cache=True)
def follow_twist(orientations, offsets, sigma, state):
    """Filter the twist of limbs for one frame, in place. Directions of bones, and so joint positions, do not change.

    Args:
        orientations: (B, 22, 3, 3) of all joints in one frame of reference, from `solve_rotations`.
        offsets: (B, 22, 3) metres, the bones.
        sigma: (B, 22) metres along an axis, standard deviations of the joints used for the solution.
        state: (B, 4, 2) of each body, `UNKNOWN_TWIST` at first, updated.
    """
    turn, twist, swing = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    of_end, of_last = np.empty((3, 3)), np.empty((3, 3))
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
            last = _CHAIN_END[limb]
            write_relative(world[middle], world[end], of_end)
            toe = rotated(world[end], point(bones, last))  # unused without a joint beyond the end
            write_relative(world[end], world[last], of_last)
            write_rotation(upper, math.sin(angle), math.cos(angle), 1.0 - math.cos(angle), twist)
            write_product(twist, turn, world[ball])
            # knee and elbow swing from the upper bone's new orientation, and carry the joints below
            write_swing(point(bones, end), rotated_back(world[ball], lower), swing)
            write_product(world[ball], swing, world[middle])
            if last >= 0:
                write_swing(point(bones, last), rotated_back(world[middle], toe), of_end)
            write_product(world[middle], of_end, world[end])
            if last >= 0:
                write_product(world[end], of_last, world[last])


def follow_short_bones(orientations: Floats, offsets: Floats, sigma: Floats, turns: Floats) -> None:
    """Turn short bones towards their usual directions for one frame, in place. Other bones do not change.

    ``turns`` (B, 4, 4), `UNKNOWN_TURNS` at first, is updated; the other arguments are those of `follow_twist`.
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
