"""Poses that a sensor cannot have come to: one bad frame must not throw everybody across the room."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Pose

STEP_M, SPEED = 0.5, 10.0
"""Metres, and m/s: how far a sensor may have come since its last frame; a robot that runs does 4 m/s."""
TURN, TURN_RATE = 0.5, 10.0
"""Radians, and rad/s: how far it may have turned; a head that looks round does 6 rad/s."""
LASTING_S = 0.2
"""Seconds after which a pose that was doubted is believed: the sensor was put elsewhere, or calibrated."""


class Verdict(Enum):
    """What a sensor's pose is taken for."""

    BELIEVED = auto()
    DOUBTED = auto()
    """it is not where it was, and may be back in a moment: do without this frame"""
    MOVED = auto()
    """it stays elsewhere: begin anew"""


class _Stand(NamedTuple):
    stamp_ns: int
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]


class SensorPoseGate:
    """Doubts poses that jump. A calm sensor, and one that moves, are believed as they come."""

    def __init__(self) -> None:
        self._believed: _Stand | None = None
        self._doubted_since_ns: int | None = None

    def reset(self) -> None:
        """Forget the sensor."""
        self._believed = self._doubted_since_ns = None

    def judge(self, pose: Pose, stamp_ns: int) -> Verdict:
        """What the pose of the frame of ``stamp_ns``, later than the last, is taken for."""
        stand = _Stand(stamp_ns, pose.position, pose.orientation)
        if self._believed is None or _is_near(self._believed, stand):
            self._believed, self._doubted_since_ns = stand, None
            return Verdict.BELIEVED
        if self._doubted_since_ns is None:
            self._doubted_since_ns = stamp_ns
        if stamp_ns - self._doubted_since_ns < LASTING_S * 1e9:
            return Verdict.DOUBTED
        self._believed, self._doubted_since_ns = stand, None
        return Verdict.MOVED


def _is_near(before: _Stand, after: _Stand) -> bool:
    elapsed_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    turned = 2.0 * np.arccos(min(abs(float(before.orientation @ after.orientation)), 1.0))
    moved = float(np.linalg.norm(after.position - before.position))
    return moved <= STEP_M + SPEED * elapsed_s and turned <= TURN + TURN_RATE * elapsed_s
