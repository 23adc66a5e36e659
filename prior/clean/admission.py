"""Outlier rejection of message stamps and sensor poses, before the bodies are processed.

A single wrong stamp must not end the stream or split it in two. A single wrong pose must not displace all bodies.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum, auto

import numpy as np

from steadypose.msgs.types import Pose, PoseRaw

MAX_DISTANCE = 30.0
"""Largest distance of a joint from the sensor, metres; joints farther away count as missing."""
MAX_PLACE = 10_000.0
"""Largest coordinate of a sensor's position, metres; beyond it, float32 joints would lose millimetres."""
BACKWARDS_NS = 1_000_000_000
"""Least step back in time that starts a new stream, nanoseconds; a smaller one is a frame out of order."""
ACCEPT_AFTER = 3
"""Number of consecutive messages with increasing stamps after which a jump of stamps is accepted: the source paused, or
its clock was set."""
SLOWEST_NS = 10_000_000_000
"""Longest time between two stamps of a stream, nanoseconds. In a slower stream, every message follows a pause."""
STEP_M, SPEED = 0.5, 10.0
"""Largest motion of a sensor since its last accepted pose: STEP_M + SPEED * elapsed, metres and m/s. A running robot
reaches 4 m/s."""
TURN, TURN_RATE = 0.5, 10.0
"""Largest rotation of a sensor since then: TURN + TURN_RATE * elapsed, radians and rad/s. A person's head turns at up
to 6 rad/s."""
ACCEPT_AFTER_S = 0.2
"""Time after which a suspect pose is accepted, seconds. The sensor was moved or calibrated."""


class StampGate:
    """Holds back messages whose stamps jump, until the following messages confirm or refute the jump.

    If the stream continues from the old stamp, the stamp was wrong (0, seconds ahead, the year 2037), and the message
    is dropped and counted. If the stream continues from the new stamp, the source paused or its clock was set. Then the
    two messages held back are released with the third, and nothing is lost.

    Args:
        timeout_ns: longest time between two stamps of a stream, unless the whole stream is slower.
        counters: counts ``stamp_outlier``.
    """

    def __init__(self, timeout_ns: float, counters: Counter[str]) -> None:
        self._timeout_ns, self._counters = timeout_ns, counters
        self._last_ns: int | None = None
        self._step_ns = 0  # between the last two admitted stamps
        self._held: list[tuple[PoseRaw, int]] = []

    def admit(self, raw: PoseRaw, at_ns: int = 0, *, gap: bool = False) -> list[tuple[PoseRaw, int]]:
        """Return the messages to process now, with their times of arrival, oldest first; none while a jump is being
        judged.

        After messages that the node dropped (``gap``), a stamp may be later than usual.
        """
        if raw.end_of_stream:
            return [*self.release(), (raw, at_ns)]
        longest_ns = SLOWEST_NS if gap else max(self._timeout_ns, 2 * self._step_ns)
        if self._last_ns is None or -BACKWARDS_NS < raw.stamp_ns - self._last_ns <= longest_ns:
            self._drop()
            self._note(raw.stamp_ns)
            return [(raw, at_ns)]
        if self._held and not 0 < raw.stamp_ns - self._held[-1][0].stamp_ns <= SLOWEST_NS:
            self._drop()
        self._held.append((raw, at_ns))
        return self.release() if len(self._held) >= ACCEPT_AFTER else []

    def release(self) -> list[tuple[PoseRaw, int]]:
        """Return the messages held back, oldest first, as the beginning of a new stream."""
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
    """Result of judging one pose."""

    ACCEPTED = auto()
    SUSPECT = auto()  # a jump that may be an outlier: skip this frame
    MOVED = auto()  # a confirmed jump: the sensor was moved, start anew


class SensorPoseGate:
    """Rejects sensor poses after a jump, for at most `ACCEPT_AFTER_S`. A still or moving sensor passes."""

    def __init__(self) -> None:
        self._accepted: tuple[int, Pose] | None = None
        self._suspect_since_ns: int | None = None

    def reset(self) -> None:
        """Forget the sensor."""
        self._accepted = self._suspect_since_ns = None

    def judge(self, pose: Pose, stamp_ns: int) -> Verdict:
        """Judge the sensor's pose at ``stamp_ns``, which must be later than the last."""
        if self._accepted is None or _is_near(*self._accepted, stamp_ns, pose):
            self._accepted, self._suspect_since_ns = (stamp_ns, pose), None
            return Verdict.ACCEPTED
        if self._suspect_since_ns is None:
            self._suspect_since_ns = stamp_ns
        if stamp_ns - self._suspect_since_ns < ACCEPT_AFTER_S * 1e9:
            return Verdict.SUSPECT
        self._accepted, self._suspect_since_ns = (stamp_ns, pose), None
        return Verdict.MOVED


def _is_near(before_ns: int, before: Pose, after_ns: int, after: Pose) -> bool:
    """Whether a sensor can have moved from one pose to the other in this time."""
    elapsed_s = (after_ns - before_ns) * 1e-9
    turned = 2.0 * np.arccos(min(abs(float(before.orientation @ after.orientation)), 1.0))
    moved = float(np.linalg.norm(after.position - before.position))
    return moved <= STEP_M + SPEED * elapsed_s and turned <= TURN + TURN_RATE * elapsed_s
