"""How many bodies there is time for: under load, fewer bodies before fewer frames."""

from __future__ import annotations

from steadypose.nodes.graph.clock import Clock

LOOK_NS = 500_000_000
"""between two decisions"""
CALM_NS = 2_000_000_000
"""without a dropped frame, before more bodies are tried"""
SPARE = 0.8
"""of the time that work may take with more bodies"""


class BodyLimit:
    """Lowers the number of bodies while frames are dropped for being late, and raises it again where there is time.

    Args:
        most: bodies, however much time there is.
        clock: of the node.
    """

    def __init__(self, most: int, clock: Clock) -> None:
        self.bodies = self._most = most
        """that there is time for"""
        self._clock = clock
        self._looked_ns = self._late_ns = clock.monotonic_ns()
        self._worked = self._dropped_before = 0
        self._spent_ns = 0
        self._present = 1
        self._settling = False

    def note(self, present: int, spent_ns: int, dropped: int) -> None:
        """A frame was worked on.

        Args:
            present: bodies in it that were worked on.
            spent_ns: how long it took.
            dropped: frames dropped so far for being late.
        """
        self._worked += 1
        self._spent_ns += spent_ns
        self._present = max(present, 1)
        now = self._clock.monotonic_ns()
        if now - self._looked_ns < LOOK_NS:
            return
        late, self._dropped_before = dropped - self._dropped_before, dropped
        busy = self._spent_ns / (now - self._looked_ns)
        if late and not self._settling:
            in_time = max(self._worked / (self._worked + late), 0.5)
            self.bodies = max(1, min(self._present - 1, int(self._present * in_time)))
        elif now - self._late_ns > CALM_NS:  # what is worked on shows what more would take
            self.bodies = min(max(self.bodies, int(self._present * SPARE / max(busy, 0.01))), self._most)
        self._late_ns = now if late else self._late_ns
        self._settling = late > 0 and not self._settling  # what waits is of before
        self._looked_ns, self._worked, self._spent_ns = now, 0, 0
