"""Bones of impossible length: a limb's joint that lies where this body's bones, as seen so far, cannot put it.

What a sensor says of a bone's length has an error of its own, by bone and by person: a network that guesses depth
makes bones shorter and longer all the time, a marker system never. So each bone is judged by its own running mean and
deviation. A collapsed wrist, or a limb thrown aside, is found however slowly the body moves, where a test for jumps
alone would take it for motion.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from steadypose.prior.body.skeleton import CHILDREN, PARENT, limbs
from steadypose.prior.clean.frame import Bools, Floats

SHARE, LEAST, DEVIATIONS = 0.5, 0.10, 6.0
"""A length differs from the mean by more than this share of it, so many metres, and so many standard deviations."""

LEAST_DEVIATION = 0.01
"""metres"""

MEMORY, FIRST = 45, 15
"""Frames of the running mean and deviation; and sightings before which nothing is judged."""

WINSORISED = 2.0
"""Standard deviations beyond which a length counts as so much: an outlier does not excuse itself, but bones that stay
as they are, of another person or after a start that went wrong, are the new mean within a few seconds."""

MOST = 0.5
"""Share of the limbs' bones seen beyond which it is another body, which is measured anew."""

_LIMB_JOINTS = np.sort(np.concatenate(limbs(("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))))
_CHILD = np.array([children[0] if len(children) == 1 else -1 for children in CHILDREN])


class BoneOutliers:
    """Joints of limbs at the end of a bone of impossible length, of ``slots`` bodies."""

    def __init__(self, slots: int) -> None:
        self._mean = np.zeros((slots, 22))
        self._variance = np.zeros((slots, 22))
        self._sightings = np.zeros((slots, 22))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for values in (self._mean, self._variance, self._sightings):
            values[slot] = 0.0

    def update(self, positions: Floats) -> Bools:
        """(S, 22) the joints of positions (S, 22, 3) metres that are not to be believed; their lengths are taken in.

        Of a bad bone, the joint farther from the trunk is wrong, and all beyond it; if the next bone is bad too, it
        alone.
        """
        bad = np.zeros(positions.shape[:2], dtype=np.bool_)
        _judge(positions, self._mean, self._variance, self._sightings, bad)
        return bad


@njit(cache=True)
def _judge(positions, mean, variance, sightings, bad):
    for row in range(len(positions)):
        seen, found = 0, 0
        for joint in _LIMB_JOINTS:
            square = 0.0
            for axis in range(3):
                square += (positions[row, joint, axis] - positions[row, PARENT[joint], axis]) ** 2
            if not math.isfinite(square):
                continue
            off = math.sqrt(square) - mean[row, joint]
            sightings[row, joint] += 1
            count = sightings[row, joint]
            if count > FIRST:
                seen += 1
                deviation = max(math.sqrt(variance[row, joint]), LEAST_DEVIATION)
                bad[row, joint] = abs(off) > max(SHARE * mean[row, joint], LEAST, DEVIATIONS * deviation)
                found += bad[row, joint]
                off = min(max(off, -WINSORISED * deviation), WINSORISED * deviation)
            mean[row, joint] += off / min(count, MEMORY)
            if count > 1:
                variance[row, joint] += (off * off - variance[row, joint]) / min(count, MEMORY)
        if found > MOST * seen:
            bad[row] = False
            sightings[row] = 0.0
            continue
        _attribute(bad[row])


@njit(cache=True)
def _attribute(bad):
    """From the joints at the end of a bad bone (22,) to those that are wrong, in place."""
    of_bone = bad.copy()
    for joint in _LIMB_JOINTS:  # from the trunk outwards
        if not of_bone[joint]:
            continue
        child = _CHILD[joint]
        if child >= 0 and of_bone[child]:
            of_bone[child] = bad[child] = False
            continue
        while child >= 0:
            bad[child] = True
            child = _CHILD[child]
