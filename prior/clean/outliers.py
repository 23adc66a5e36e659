"""Outliers among a body's joints that need no prediction: by the lengths of its bones, and by exact repetition.

The error of a measured length depends on the sensor, the bone and the person: a network that estimates depth from one
image varies bones all the time, a marker system hardly. So each bone is compared with its own running mean and
standard deviation. A wrist that collapses onto the elbow is detected at any speed of the body; a test for jumps alone
takes it for motion. And a joint that is thrown about with all its bones as long as ever has moved, not jumped, if the
sensor is one whose bones are constant.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import CHILDREN, PARENT, limbs
from steadypose.prior.compiled import median, njit

MIN_SHARE, MIN_DIFFERENCE, DEVIATIONS = 0.5, 0.1, 6.0
"""An impossible length differs from the mean by more than this share of it, these metres and these standard
deviations (chosen on validation, benchmarks/NOTEBOOK.md)."""

MIN_DEVIATION = 0.01
"""Metres, least standard deviation of a length."""

MEMORY, FIRST = 45, 15
"""Frames of the running mean and deviation; and observations before which nothing is judged."""

WINSORISED = 2.0
"""Standard deviations at which differences are clipped before they update mean and deviation: an outlier changes them
little, but a new length that lasts is accepted within two seconds."""

INTACT_DEVIATIONS, INTACT = 2.0, 0.01
"""A bone is as long as ever within these standard deviations, or metres."""

TELLING = 0.03
"""Share of a joint's distance to its prediction: a bone that varies by more does not distinguish a jump from motion."""

MAX_OUTLIERS = 0.5
"""Share of the limbs' bones observed beyond which it is another body, which is measured anew."""

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
"""Frames, at least, that are no repetition of the whole body."""

_LIMB_JOINTS = np.sort(np.concatenate(limbs(("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))))
_IN_LIMB = np.isin(np.arange(len(PARENT)), _LIMB_JOINTS)
_CHILD = np.array([children[0] if len(children) == 1 else -1 for children in CHILDREN])


class BoneOutliers:
    """Finds the outliers among the limbs' joints of ``slots`` bodies, and joints that moved with their limb."""

    def __init__(self, slots: int) -> None:
        self._mean = np.zeros((slots, 22))
        self._variance = np.zeros((slots, 22))
        self._observed = np.zeros((slots, 22))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for values in (self._mean, self._variance, self._observed):
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
        _judge(positions, self._mean, self._variance, self._observed, bad)
        return bad

    def intact(self, positions: Floats, distance: Floats) -> Bools:
        """Joints that move with their limb: all their bones are as long as ever, of a sensor whose bones show jumps.

        Args:
            positions: (S, 22, 3) metres, NaN where unobserved.
            distance: (S, 22) metres, of the joints to their predictions.

        Returns:
            (S, 22) which joints moved, rather than jumped.
        """
        moved = np.zeros(positions.shape[:2], dtype=np.bool_)
        _hold(positions, distance, self._mean, self._variance, self._observed, moved)
        return moved


@njit(cache=True)
def _length(positions, joint):
    """Metres from a joint of positions (22, 3) to its parent; NaN if either is unobserved."""
    square = 0.0
    for axis in range(3):
        square += (positions[joint, axis] - positions[PARENT[joint], axis]) ** 2
    return math.sqrt(square)


@njit(cache=True)
def _hold(positions, distance, mean, variance, observed, moved):
    for row in range(len(positions)):
        bones = np.zeros(len(PARENT), dtype=np.int64)
        moved[row] = True
        for joint in range(1, len(PARENT)):
            off = abs(_length(positions[row], joint) - mean[row, joint])
            if not math.isfinite(off):
                continue
            deviation = math.sqrt(variance[row, joint])
            kept = observed[row, joint] > 0 and off <= max(INTACT, INTACT_DEVIATIONS * deviation)
            for end in (joint, PARENT[joint]):
                bones[end] += 1
                moved[row, end] &= kept and deviation < TELLING * distance[row, end]
        for joint in range(len(PARENT)):
            moved[row, joint] &= bones[joint] > 0


@njit(cache=True)
def _judge(positions, mean, variance, observed, bad):
    for row in range(len(positions)):
        seen, outliers = 0, 0
        for joint in range(1, len(PARENT)):
            off = _length(positions[row], joint) - mean[row, joint]
            if not math.isfinite(off):
                continue
            observed[row, joint] += 1
            count = observed[row, joint]
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
            observed[row] = 0.0
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
