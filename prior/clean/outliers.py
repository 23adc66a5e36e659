"""Outlier detection without a prediction of motion: by bone lengths, and by exact repetition.

The error of a measured bone length depends on the sensor, the bone and the person. A network that estimates depth from
one image changes lengths in every frame; a marker system hardly does. Each bone is therefore compared with its own
running mean and standard deviation. This detects a wrist that collapses onto the elbow at any speed, where a test for
jumps would take it for motion. Conversely, if the sensor's bone lengths are constant, a joint far from its prediction
whose bones kept their lengths has moved and not jumped.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import CHILDREN, PARENT, limbs
from steadypose.prior.body.vectors import apart
from steadypose.prior.compiled import median, njit

MIN_SHARE, MIN_DIFFERENCE, DEVIATIONS = 0.5, 0.1, 6.0
"""Thresholds of an impossible length: its difference from the mean exceeds this share of the mean, this many metres and
this many standard deviations (chosen on validation, benchmarks/NOTEBOOK.md)."""

MIN_DEVIATION = 0.01  # least standard deviation of a length, metres

MEMORY, FIRST = 45, 15
"""Length of the running mean and deviation, and number of observations before a bone is judged, frames."""

WINSORISED = 2.0
"""Bound at which differences are clipped before they update mean and deviation, standard deviations. A single outlier
then has little effect, but a length that stays changed is accepted within two seconds."""

INTACT_DEVIATIONS, INTACT = 2.0, 0.01  # largest change of length of an intact bone, standard deviations or metres

TELLING = 0.03
"""Largest standard deviation of the length of a bone that can distinguish motion from a jump, relative to the distance
of the joint from its prediction."""

MAX_OUTLIERS = 0.5
"""Share of impossible bones among the limbs' observed bones above which the body is taken for another person's."""

RECENT = 15  # number of recent frames in most of which a frozen joint must repeat itself
SAME = 1e-6  # largest motion between two frames of a joint that repeats itself, metres

MIN_NOISE = 0.001
"""Least noise along an axis, from frame to frame, for frozen joints to be detected, metres. With a quieter sensor, a
joint that repeats itself may be at rest."""

MAX_ALIKE = 0.1
"""Largest share of repeated coordinates among joints that moved. Above it the sensor rounds its output, and any joint
at rest repeats itself."""

_MIN_NEW = 5  # least number of frames that do not repeat the whole body

_LIMB_JOINTS = np.sort(np.concatenate(limbs(("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))))
_IN_LIMB = np.isin(np.arange(len(PARENT)), _LIMB_JOINTS)
_CHILD = np.array([children[0] if len(children) == 1 else -1 for children in CHILDREN])


class BoneOutliers:
    """Detects outliers among the limbs' joints of ``slots`` bodies, and joints that moved with their limb."""

    def __init__(self, slots: int) -> None:
        self._mean = np.zeros((slots, 22))
        self._variance = np.zeros((slots, 22))
        self._observed = np.zeros((slots, 22))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for values in (self._mean, self._variance, self._observed):
            values[slot] = 0.0

    def update(self, positions: Floats) -> Bools:
        """Judge a frame's bones and update their means and deviations.

        The outer joint of an impossible bone and all joints beyond it are outliers. If the next bone is impossible too,
        only the outer joint is.

        Args:
            positions: (S, 22, 3) metres, NaN where unobserved.

        Returns:
            (S, 22) which joints are outliers.
        """
        bad = np.zeros(positions.shape[:2], dtype=np.bool_)
        _judge(positions, self._mean, self._variance, self._observed, bad)
        return bad

    def intact(self, positions: Floats, distance: Floats) -> Bools:
        """Detect joints that moved with their limb: their bones kept their lengths, and those are constant enough to
        tell.

        Args:
            positions: (S, 22, 3) metres, NaN where unobserved.
            distance: (S, 22) metres from the joints to their predictions.

        Returns:
            (S, 22) which joints moved and did not jump.
        """
        moved = np.zeros(positions.shape[:2], dtype=np.bool_)
        _hold(positions, distance, self._mean, self._variance, self._observed, moved)
        return moved


@njit(cache=True)
def _hold(positions, distance, mean, variance, observed, moved):
    for row in range(len(positions)):
        bones = np.zeros(len(PARENT), dtype=np.int64)
        moved[row] = True
        for joint in range(1, len(PARENT)):
            off = abs(apart(positions[row], joint, PARENT[joint]) - mean[row, joint])
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
        judged, outliers = 0, 0
        for joint in range(1, len(PARENT)):
            off = apart(positions[row], joint, PARENT[joint]) - mean[row, joint]
            if not math.isfinite(off):
                continue
            observed[row, joint] += 1
            count = observed[row, joint]
            if count > FIRST and _IN_LIMB[joint]:
                judged += 1
                deviation = max(math.sqrt(variance[row, joint]), MIN_DEVIATION)
                bad[row, joint] = abs(off) > max(MIN_SHARE * mean[row, joint], MIN_DIFFERENCE, DEVIATIONS * deviation)
                outliers += bad[row, joint]
                off = min(max(off, -WINSORISED * deviation), WINSORISED * deviation)
            mean[row, joint] += off / min(count, MEMORY)
            if count > 1:
                variance[row, joint] += (off * off - variance[row, joint]) / min(count, MEMORY)
        if outliers > MAX_OUTLIERS * judged:
            bad[row] = False
            observed[row] = 0.0
            continue
        _attribute(bad[row])


@njit(cache=True)
def _attribute(bad):
    """Convert ``bad`` (22,), the joints at the outer ends of impossible bones, into outliers, in place."""
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
def frozen_joints(positions: Floats) -> Bools:
    """(B, 22) which joints of a sensor's output (B, T, 22, 3), NaN where it has none, are frozen in the last frames:
    the tracker lost them and repeats its last output.

    A frozen joint repeats itself in most of the frames in which the body as a whole does not, while other joints
    jitter.
    """
    count, frames, joints, _ = positions.shape
    frozen = np.zeros((count, joints), dtype=np.bool_)
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
                frozen[b, joint] = repeated[joint] > limit
    return frozen


@njit(cache=True)
def _noise(positions):
    """(22,) metres along an axis, noise from frame to frame of positions (T, 22, 3), from their fourth differences.

    Second differences would contain acceleration, and a foot at rest in a recording without noise would be frozen.
    """
    frames, joints, _ = positions.shape
    noise = np.empty(joints)
    for joint in range(joints):
        squares, count = 0.0, 0
        for t in range(4, frames):
            square = 0.0
            for axis in range(3):
                p = positions[t - 4 : t + 1, joint, axis]
                shaken = p[0] - 4 * p[1] + 6 * p[2] - 4 * p[3] + p[4]
                square += shaken * shaken
            if math.isfinite(square):
                squares += square
                count += 3
        noise[joint] = math.sqrt(squares / 70 / max(count, 1))
    return noise
