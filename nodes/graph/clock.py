"""Time for nodes: the wall clock, and which moment of capture is played when."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from typing_extensions import Self

FRAME_NS = 1_000_000_000 / FPS
"""of the grid the models run on"""
POLL_S = 0.1
"""the longest that a node waits for anything before it checks whether to stop"""


class Clock(Protocol):
    """Time for nodes; tests pass one of their own that does not wait."""

    def now_ns(self) -> int:
        """Wall time, nanoseconds since 1970, for stamps; it steps when the system's clock is set."""
        ...

    def monotonic_ns(self) -> int:
        """For durations, nanoseconds since some moment; never steps."""
        ...

    def sleep(self, duration_ns: int) -> None: ...


class SystemClock:
    """The system's clocks.

    A machine without a battery begins at some time, and is set when it hears of the time; so the wall clock steps.
    """

    def now_ns(self) -> int:
        return time.time_ns()

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def sleep(self, duration_ns: int) -> None:
        time.sleep(max(duration_ns, 0) / 1e9)


@dataclass(frozen=True)
class Timeline:
    """When, on the wall clock, a moment of capture is played: a live source's stamps are its wall times."""

    stamp_ns: int
    wall_ns: int
    rate: float
    """times real time, above 0"""

    def wall(self, stamp_ns: int) -> int:
        """Nanoseconds of wall time at which ``stamp_ns`` is due."""
        return self.wall_ns + round((stamp_ns - self.stamp_ns) / self.rate)

    def stamp_at(self, wall_ns: int) -> int:
        """The moment of capture that is played at a wall time."""
        return self.stamp_ns + round((wall_ns - self.wall_ns) * self.rate)

    @property
    def is_now(self) -> bool:
        """Whether stamps are of the wall clock: a live source's, not a replay's."""
        return self.rate == 1.0 and self.stamp_ns == self.wall_ns

    def values(self) -> dict[str, str]:
        """As the input node's diagnostics carry it."""
        return {
            "timeline.stamp_ns": str(self.stamp_ns),
            "timeline.wall_ns": str(self.wall_ns),
            "timeline.rate": repr(self.rate),
        }

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> Self | None:
        """From diagnostics, or None if they carry none that can be."""
        try:
            stamp_ns, wall_ns = int(values["timeline.stamp_ns"]), int(values["timeline.wall_ns"])
            rate = float(values["timeline.rate"])
        except (KeyError, ValueError):
            return None
        return cls(stamp_ns, wall_ns, rate) if 0 < rate < math.inf else None
