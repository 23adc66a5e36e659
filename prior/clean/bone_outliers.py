"""Outliers among a limb's joints, by the lengths of its bones.

The error of a measured length depends on the sensor, the bone and the person: a network that estimates depth from one
picture varies bones all the time, a marker system hardly. So each bone is compared with its own running mean and
standard deviation. A wrist that collapses onto the elbow is found at any speed of the body; a test for jumps alone
takes it for motion. And a joint that is thrown about with all its bones as long as ever has moved, not jumped, if the
sensor is one whose bones are constant.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import CHILDREN, PARENT, limbs
from steadypose.prior.compiled import njit

MIN_SHARE, MIN_DIFFERENCE, DEVIATIONS = 0.5, 0.1, 6.0
"""An impossible length differs from the mean by more than this share of it, these metres and these standard
deviations (chosen on validation, benchmarks/NOTEBOOK.md)."""

MIN_DEVIATION = 0.01
"""metres"""

MEMORY, FIRST = 45, 15
"""Frames of the running mean and deviation; and observations before which nothing is judged."""

WINSORISED = 2.0
"""Standard deviations at which differences are clipped before they update mean and deviation: an outlier changes them
little, but a new length that lasts is accepted within two seconds."""

INTACT_DEVIATIONS, INTACT = 2.0, 0.01
"""A bone is as long as ever within these standard deviations, or metres."""

TELLING = 0.03
"""Share of a joint's distance to its prediction: a bone that varies by more cannot tell a jump from motion."""

MAX_OUTLIERS = 0.5
"""Share of the limbs' bones seen beyond which it is another body, which is measured anew."""

_LIMB_JOINTS = np.sort(np.concatenate(limbs(("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))))
_IN_LIMB = np.isin(np.arange(len(PARENT)), _LIMB_JOINTS)
_CHILD = np.array([children[0] if len(children) == 1 else -1 for children in CHILDREN])


class BoneOutliers:
    """Finds the outliers among the limbs' joints of ``slots`` bodies, and joints that moved with their limb."""

    def __init__(self, slots: int) -> None:
        self._mean = np.zeros((slots, 22))
        self._variance = np.zeros((slots, 22))
        self._sightings = np.zeros((slots, 22))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for values in (self._mean, self._variance, self._sightings):
            values[slot] = 0.0

    def update(self, positions: Floats) -> Bools:
        """Judge a frame's bones, and update their means and deviations.

        An impossible bone makes outliers of its outer joint and of all joints beyond; of the outer joint alone if the
        next bone is impossible too.

        Args:
            positions: (S, 22, 3) metres, NaN where unobserved.

        Returns:
            (S, 22) which joints are outliers.
        """
        bad = np.zeros(positions.shape[:2], dtype=np.bool_)
        _judge(positions, self._mean, self._variance, self._sightings, bad)
        return bad

    def intact(self, positions: Floats, distance: Floats) -> Bools:
        """Joints that move with their limb: all their bones are as long as ever, of a sensor whose bones tell.

        Args:
            positions: (S, 22, 3) metres, NaN where unobserved.
            distance: (S, 22) metres, of the joints to their predictions.

        Returns:
            (S, 22) which joints moved, rather than jumped.
        """
        moved = np.zeros(positions.shape[:2], dtype=np.bool_)
        _hold(positions, distance, self._mean, self._variance, self._sightings, moved)
        return moved


@njit(cache=True)
def _length(positions, joint):
    """Metres from a joint of positions (22, 3) to its parent; NaN if either is unobserved."""
    square = 0.0
    for axis in range(3):
        square += (positions[joint, axis] - positions[PARENT[joint], axis]) ** 2
    return math.sqrt(square)


@njit(cache=True)
def _hold(positions, distance, mean, variance, sightings, moved):
    for row in range(len(positions)):
        bones = np.zeros(len(PARENT), dtype=np.int64)
        moved[row] = True
        for joint in range(1, len(PARENT)):
            off = abs(_length(positions[row], joint) - mean[row, joint])
            if not math.isfinite(off):
                continue
            deviation = math.sqrt(variance[row, joint])
            kept = sightings[row, joint] > 0 and off <= max(INTACT, INTACT_DEVIATIONS * deviation)
            for end in (joint, PARENT[joint]):
                bones[end] += 1
                moved[row, end] &= kept and deviation < TELLING * distance[row, end]
        for joint in range(len(PARENT)):
            moved[row, joint] &= bones[joint] > 0


@njit(cache=True)
def _judge(positions, mean, variance, sightings, bad):
    for row in range(len(positions)):
        seen, outliers = 0, 0
        for joint in range(1, len(PARENT)):
            off = _length(positions[row], joint) - mean[row, joint]
            if not math.isfinite(off):
                continue
            sightings[row, joint] += 1
            count = sightings[row, joint]
            if count > FIRST and _IN_LIMB[joint]:
                seen += 1
                deviation = max(math.sqrt(variance[row, joint]), MIN_DEVIATION)
                bad[row, joint] = abs(off) > max(MIN_SHARE * mean[row, joint], MIN_DIFFERENCE, DEVIATIONS * deviation)
                outliers += bad[row, joint]
                off = min(max(off, -WINSORISED * deviation), WINSORISED * deviation)
            mean[row, joint] += off / min(count, MEMORY)
            if count > 1:
                variance[row, joint] += (off * off - variance[row, joint]) / min(count, MEMORY)
        if outliers > MAX_OUTLIERS * seen:
            bad[row] = False
            sightings[row] = 0.0
            continue
        _attribute(bad[row])


@njit(cache=True)
def _attribute(bad):
    """Turn ``bad`` (22,) from joints at the outer end of an impossible bone into outliers, in place."""
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
