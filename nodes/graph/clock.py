"""Time for nodes: the clock, and the timeline that maps capture stamps to wall time."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from typing_extensions import Self

FRAME_NS = 1_000_000_000 / FPS
"""Frame period of the models' 30 Hz grid, nanoseconds."""
POLL_S = 0.1
"""Longest time a node waits for anything before it checks whether to stop, seconds."""


class Clock:
    """The system's clocks. Tests pass one that does not wait.

    The wall clock can step: a machine without a clock battery boots with a wrong time, and sets it later.
    """

    def now_ns(self) -> int:
        """Wall time for stamps, nanoseconds since 1970."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Monotonic time for durations, nanoseconds since an arbitrary start. It never steps."""
        return time.monotonic_ns()

    def sleep(self, duration_ns: int) -> None:
        time.sleep(max(duration_ns, 0) / 1e9)


@dataclass(frozen=True)
class Timeline:
    """Maps capture stamps to the wall time at which they are played. A live source's stamps are wall times."""

    stamp_ns: int
    wall_ns: int
    rate: float
    """playback speed relative to real time, above 0"""

    def wall(self, stamp_ns: int) -> int:
        """Wall time at which ``stamp_ns`` is due, nanoseconds."""
        return self.wall_ns + round((stamp_ns - self.stamp_ns) / self.rate)

    def stamp_at(self, wall_ns: int) -> int:
        """Capture stamp that is played at a wall time, nanoseconds."""
        return self.stamp_ns + round((wall_ns - self.wall_ns) * self.rate)

    @property
    def is_now(self) -> bool:
        """Whether stamps are wall times: true for a live source, false for a replay."""
        return self.rate == 1.0 and self.stamp_ns == self.wall_ns

    def values(self) -> dict[str, str]:
        """The entries of the input node's diagnostics."""
        return {
            "timeline.stamp_ns": str(self.stamp_ns),
            "timeline.wall_ns": str(self.wall_ns),
            "timeline.rate": repr(self.rate),
        }

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> Self | None:
        """The timeline in the values of diagnostics; None if there is none or it is invalid."""
        try:
            stamp_ns, wall_ns = int(values["timeline.stamp_ns"]), int(values["timeline.wall_ns"])
            rate = float(values["timeline.rate"])
        except (KeyError, ValueError):
            return None
        return cls(stamp_ns, wall_ns, rate) if 0 < rate < math.inf else None
