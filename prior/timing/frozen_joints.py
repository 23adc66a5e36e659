"""Frozen joints: those for which a tracker repeats its last output."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.compiled import median, njit

RECENT = 15
"""Frames in which a joint that repeats itself must do so mostly."""

SAME = 1e-6
"""Metres: a joint that has moved less from one frame to the next repeats itself."""

MIN_NOISE = 0.001
"""Metres along an axis, from frame to frame: of a sensor with less, a joint that repeats itself may be at rest."""

MAX_ALIKE = 0.1
"""Share of the coordinates of joints that did move that may repeat themselves: with more, the sensor rounds, and what
rests repeats itself."""

_MIN_NEW = 5
"""frames that were no repetition of the whole body"""


@njit(cache=True)
def frozen_joints(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(B, 22) joints that a tracker has lost and for which it repeats its last output.

    These repeat in most of the frames in which the body as a whole does not, while other joints jitter.

    Args:
        positions: (B, T, 22, 3) metres as the sensor gave them, NaN where it did not; the last frames count.
    """
    count, frames, joints, _ = positions.shape
    found = np.zeros((count, joints), dtype=np.bool_)
    for b in range(count):
        recent = positions[b, max(frames - RECENT - 1, 0) :]
        new, repeated, most = 0, np.zeros(joints), 0
        coordinates, alike = 0, 0
        for t in range(1, len(recent)):
            same, repeats = np.zeros(joints, dtype=np.uint8), 0
            for joint in range(joints):
                for axis in range(3):
                    same[joint] += abs(recent[t, joint, axis] - recent[t - 1, joint, axis]) < SAME
                repeats += same[joint] == 3
                if same[joint] < 3 and math.isfinite(recent[t, joint, 0] - recent[t - 1, joint, 0]):
                    coordinates += 3
                    alike += same[joint]
            if 2 * repeats <= joints:
                new += 1
                for joint in range(joints):
                    repeated[joint] += same[joint] == 3
                    most = max(most, repeated[joint])
        limit = 0.5 * max(new, _MIN_NEW)
        if most > limit and alike <= MAX_ALIKE * coordinates and median(_noise(recent)) > MIN_NOISE:
            for joint in range(joints):
                found[b, joint] = repeated[joint] > limit
    return found


@njit(cache=True)
def _noise(positions):
    """(22,) metres along an axis, from frame to frame, of positions (T, 22, 3): from their second differences."""
    frames, joints, _ = positions.shape
    noise = np.empty(joints)
    for joint in range(joints):
        squares, seen = 0.0, 0
        for t in range(2, frames):
            square = 0.0
            for axis in range(3):
                shaken = positions[t, joint, axis] - 2 * positions[t - 1, joint, axis] + positions[t - 2, joint, axis]
                square += shaken * shaken
            if math.isfinite(square):
                squares += square
                seen += 3
        noise[joint] = math.sqrt(squares / 6 / max(seen, 1))
    return noise
