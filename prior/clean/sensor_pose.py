"""Outlier rejection of the sensor's pose: one wrong pose must not displace all bodies."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Pose

STEP_M, SPEED = 0.5, 10.0
"""Metres and m/s: a sensor may have moved by STEP_M + SPEED * elapsed since its last accepted pose; a running robot
does 4 m/s."""
TURN, TURN_RATE = 0.5, 10.0
"""Radians and rad/s: the same of its orientation; a person's head turns at up to 6 rad/s."""
LASTING_S = 0.2
"""Seconds after which a suspect pose is accepted: the sensor was moved, or calibrated."""


class Verdict(Enum):
    """Outcome for one pose."""

    ACCEPTED = auto()
    SUSPECT = auto()
    """a jump that may be an outlier: skip this frame"""
    MOVED = auto()
    """a jump that has lasted: the sensor was moved, start anew"""


class _StampedPose(NamedTuple):
    stamp_ns: int
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]


class SensorPoseGate:
    """Rejects poses that jump, until the jump has lasted for `LASTING_S`. A still or moving sensor passes unchanged."""

    def __init__(self) -> None:
        self._accepted: _StampedPose | None = None
        self._suspect_since_ns: int | None = None

    def reset(self) -> None:
        """Forget the sensor."""
        self._accepted = self._suspect_since_ns = None

    def judge(self, pose: Pose, stamp_ns: int) -> Verdict:
        """Judge the sensor's pose in the frame of ``stamp_ns``, which is later than the last."""
        stamped = _StampedPose(stamp_ns, pose.position, pose.orientation)
        if self._accepted is None or _is_near(self._accepted, stamped):
            self._accepted, self._suspect_since_ns = stamped, None
            return Verdict.ACCEPTED
        if self._suspect_since_ns is None:
            self._suspect_since_ns = stamp_ns
        if stamp_ns - self._suspect_since_ns < LASTING_S * 1e9:
            return Verdict.SUSPECT
        self._accepted, self._suspect_since_ns = stamped, None
        return Verdict.MOVED


def _is_near(before: _StampedPose, after: _StampedPose) -> bool:
    elapsed_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    turned = 2.0 * np.arccos(min(abs(float(before.orientation @ after.orientation)), 1.0))
    moved = float(np.linalg.norm(after.position - before.position))
    return moved <= STEP_M + SPEED * elapsed_s and turned <= TURN + TURN_RATE * elapsed_s
