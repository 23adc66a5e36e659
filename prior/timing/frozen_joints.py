"""Frozen joints: those of which a tracker repeats its last answer."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

RECENT = 15
"""Frames in which a joint that repeats itself must do so mostly."""

SAME = 1e-6
"""Metres: a joint that has moved less from one frame to the next repeats itself."""

LEAST_NOISE = 0.001
"""Metres along an axis, from frame to frame: of a sensor with less, a joint that repeats itself may be at rest."""

_LEAST_NEW = 5
"""frames that were no repetition of the whole body"""


@njit(cache=True)
def frozen_joints(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(B, 22) joints that a tracker has lost and of which it repeats the last answer.

    They do so in most of the frames in which the body is not repeated whole, and other joints shake.

    Args:
        positions: (B, T, 22, 3) metres as the sensor gave them, NaN where it did not; the last frames count.
    """
    count, frames, joints, _ = positions.shape
    found = np.zeros((count, joints), dtype=np.bool_)
    for b in range(count):
        recent = positions[b, max(frames - RECENT - 1, 0) :]
        new, repeated, noise = 0, np.zeros(joints), np.zeros(joints)
        for t in range(1, len(recent)):
            same = np.ones(joints)
            for joint in range(joints):
                for axis in range(3):
                    if not abs(recent[t, joint, axis] - recent[t - 1, joint, axis]) < SAME:
                        same[joint] = 0.0
            if same.mean() <= 0.5:
                new += 1
                repeated += same
        if not (repeated > 0.5 * max(new, _LEAST_NEW)).any():
            continue
        for joint in range(joints):
            square, seen = 0.0, 0
            for t in range(2, len(recent)):
                shaken = recent[t, joint] - 2 * recent[t - 1, joint] + recent[t - 2, joint]
                if np.isfinite(shaken).all():
                    square += (shaken**2).sum()
                    seen += 3
            noise[joint] = math.sqrt(square / 6 / max(seen, 1))
        if np.median(noise) > LEAST_NOISE:
            found[b] = repeated > 0.5 * max(new, _LEAST_NEW)
    return found
