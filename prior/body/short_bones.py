"""How short bones lie to the bones above them: as they usually do of this body, the more so the noisier they are.

A bone of 6 to 15 cm shows its direction badly, and turns little: collars, neck, and the spine between chest and pelvis.
What is usual of a body is learned from itself: motion files draw these bones each in their own way.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import from_rotation_vectors, to_rotation_vectors
from steadypose.prior.body.skeleton import COLLARS, PARENT, SHOULDERS, J
from steadypose.prior.timing.rate import FPS

_SHORT = [J["spine2"], J["neck"], *COLLARS]
_END = [J["spine3"], J["head"], *SHOULDERS]

RANGE = np.radians((3.0, 25.0, 16.0, 16.0))
"""Radians about an axis, by which each of them turns about what is usual of a body, as a standard deviation."""

BODIES, MEMORY_S = math.radians(20.0), 60.0
"""Radians about an axis, by which what is usual differs between bodies, and seconds in which it is forgotten."""
_KEPT = math.exp(-1.0 / (MEMORY_S * FPS))

CORRELATED = 60.0
"""Frames that count as one in the estimate of what is usual, as noise and posture last."""

MAX_SIGMA = 0.5
"""Metres: standard deviation of a joint that is not known."""
_LEAST_LENGTH = 0.03  # metres, of a bone


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
    length = np.maximum(np.linalg.norm(offsets[:, _END], axis=-1), _LEAST_LENGTH)
    noise = (square[:, _SHORT] + square[:, _END]) / length**2
    variance = _KEPT**2 * turns[..., 3] + (1.0 - _KEPT**2) * BODIES**2
    gain = variance / (variance + CORRELATED * (noise + RANGE**2))
    turns[..., :3] += gain[..., None] * (shown - turns[..., :3])
    turns[..., 3] = (1.0 - gain) * variance
    free = RANGE**2 + turns[..., 3]
    usual = turns[..., :3]
    turned = usual + (free / (free + noise))[..., None] * (shown - usual)
    orientations[:, _SHORT] = above @ from_rotation_vectors(turned)
