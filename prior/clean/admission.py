"""Outlier rejection of a message's stamp and of its sensor's pose, before its bodies are looked at.

One wrong stamp must not end the stream, and one publisher must not be two; one wrong pose must not displace all bodies.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum, auto

import numpy as np

from steadypose.msgs.types import Pose, PoseRaw

LASTING = 3
"""Messages in a row, of stamps that follow each other, after which a jump of stamps is accepted: a pause, or a clock
that was set."""
SLOWEST_NS = 10_000_000_000
"""Nanoseconds at most between two stamps of a stream; one that is slower is taken for a pause at every message."""
STEP_M, SPEED = 0.5, 10.0
"""Metres and m/s: a sensor may have moved by STEP_M + SPEED * elapsed since its last accepted pose; a running robot
does 4 m/s."""
TURN, TURN_RATE = 0.5, 10.0
"""Radians and rad/s: the same of its orientation; a person's head turns at up to 6 rad/s."""
LASTING_S = 0.2
"""Seconds after which a suspect pose is accepted: the sensor was moved, or calibrated."""


class StampGate:
    """Holds messages back whose stamps jump, until it is seen whether the jump lasts.

    A stream that goes on where it was had one wrong stamp (0, seconds ahead, the year 2037), which is dropped and
    counted. One that goes on from the new stamp was paused, or its clock was set: then nothing is lost, and the two
    messages held back come with the third.

    Args:
        timeout_ns: between two stamps of a stream, unless it is slower throughout.
        back_ns: by which a stamp may be out of order.
        counters: gets ``stamp_outlier``.
    """

    def __init__(self, timeout_ns: float, back_ns: int, counters: Counter[str]) -> None:
        self._timeout_ns, self._back_ns, self._counters = timeout_ns, back_ns, counters
        self._last_ns: int | None = None
        self._step_ns = 0  # between the last two that were admitted
        self._held: list[tuple[PoseRaw, int]] = []

    def admit(self, raw: PoseRaw, at_ns: int = 0, *, gap: bool = False) -> list[tuple[PoseRaw, int]]:
        """The messages that go on with this one, oldest first: none while a jump is looked at.

        Args:
            raw: the newest message.
            at_ns: when it came; given back with it.
            gap: whether messages before it were dropped here, so that its stamp may be later than usual.
        """
        if raw.end_of_stream:
            return [*self.release(), (raw, at_ns)]
        longest_ns = SLOWEST_NS if gap else max(self._timeout_ns, 2 * self._step_ns)
        if self._last_ns is None or -self._back_ns < raw.stamp_ns - self._last_ns <= longest_ns:
            self._drop()
            self._note(raw.stamp_ns)
            return [(raw, at_ns)]
        if self._held and not 0 < raw.stamp_ns - self._held[-1][0].stamp_ns <= SLOWEST_NS:
            self._drop()
        self._held.append((raw, at_ns))
        return self.release() if len(self._held) >= LASTING else []

    def release(self) -> list[tuple[PoseRaw, int]]:
        """The messages that are held, oldest first, as those of a stream that begins with them."""
        held, self._held = self._held, []
        if held:
            self._last_ns = None
        for raw, _ in held:
            self._note(raw.stamp_ns)
        return held

    def _note(self, stamp_ns: int) -> None:
        if self._last_ns is None:
            self._last_ns, self._step_ns = stamp_ns, 0
        elif stamp_ns > self._last_ns:
            self._last_ns, self._step_ns = stamp_ns, stamp_ns - self._last_ns

    def _drop(self) -> None:
        if self._held:
            self._counters["stamp_outlier"] += len(self._held)
            self._held = []


class Verdict(Enum):
    """Outcome for one pose."""

    ACCEPTED = auto()
    SUSPECT = auto()
    """a jump that may be an outlier: skip this frame"""
    MOVED = auto()
    """a jump that has lasted: the sensor was moved, start anew"""


class SensorPoseGate:
    """Rejects poses that jump, until the jump has lasted for `LASTING_S`. A still or moving sensor passes unchanged."""

    def __init__(self) -> None:
        self._accepted: tuple[int, Pose] | None = None
        self._suspect_since_ns: int | None = None

    def reset(self) -> None:
        """Forget the sensor."""
        self._accepted = self._suspect_since_ns = None

    def judge(self, pose: Pose, stamp_ns: int) -> Verdict:
        """Judge the sensor's pose in the frame of ``stamp_ns``, which is later than the last."""
        if self._accepted is None or _is_near(*self._accepted, stamp_ns, pose):
            self._accepted, self._suspect_since_ns = (stamp_ns, pose), None
            return Verdict.ACCEPTED
        if self._suspect_since_ns is None:
            self._suspect_since_ns = stamp_ns
        if stamp_ns - self._suspect_since_ns < LASTING_S * 1e9:
            return Verdict.SUSPECT
        self._accepted, self._suspect_since_ns = (stamp_ns, pose), None
        return Verdict.MOVED


def _is_near(before_ns: int, before: Pose, after_ns: int, after: Pose) -> bool:
    """Whether a sensor may have moved from one pose to the other."""
    elapsed_s = (after_ns - before_ns) * 1e-9
    turned = 2.0 * np.arccos(min(abs(float(before.orientation @ after.orientation)), 1.0))
    moved = float(np.linalg.norm(after.position - before.position))
    return moved <= STEP_M + SPEED * elapsed_s and turned <= TURN + TURN_RATE * elapsed_s
