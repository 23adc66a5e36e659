"""The events of a whole stream, each once, with its begin and end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Event, EventKind, Hand, Phase, PoseWorld
from steadypose.prior.events.detector import NOWHERE, EventDetector, EventSettings


class TimedEvent(NamedTuple):
    """An event of one body from begin to end."""

    body: int
    """id of the body"""
    kind: EventKind
    hand: Hand
    """hand of HAND_RAISED, WAVES and POINTS"""
    begin_ns: int
    """capture time at which it began, nanoseconds"""
    end_ns: int
    """capture time at which it was seen to have ended, or the stream ended; for ENTERED and LEFT, as `begin_ns`"""
    confidence: float
    """0 to 1: probability of the event's condition when it began"""
    direction: NDArray[np.float64]
    """(3,) direction of POINTS when it began: unit vector, world; zeros for other events"""


class EventTimeline:
    """Collects the events of one stream.

    Args:
        settings: the thresholds.
    """

    def __init__(self, settings: EventSettings | None = None) -> None:
        self._detector = EventDetector(settings)
        self._ended: list[TimedEvent] = []
        self._open: dict[tuple[int, EventKind, Hand], Event] = {}
        self._stamp_ns = -1

    def add(self, world: PoseWorld, sensor: NDArray[np.float64] = NOWHERE, *, calibrated: bool = False) -> None:
        """Add the next message of ``pose/world``; arguments as of `EventDetector.update`."""
        if world.end_of_stream or world.stamp_ns <= self._stamp_ns:
            self._close_all()
        self._stamp_ns = world.stamp_ns
        for event in self._detector.update(world, sensor, calibrated=calibrated):
            key = event.body, event.kind, event.hand
            if event.kind in (EventKind.ENTERED, EventKind.LEFT):
                self._ended.append(_timed(event, event.since_ns))
            elif event.phase == Phase.BEGINS:
                self._open[key] = event
            elif event.phase == Phase.ENDS:
                self._ended.append(_timed(self._open.pop(key), world.stamp_ns))

    def events(self) -> list[TimedEvent]:
        """All events so far, by begin. Those that have not ended last until the newest message."""
        self._close_all()
        return sorted(self._ended, key=lambda event: (event.begin_ns, event.body))

    def _close_all(self) -> None:
        self._ended += (_timed(event, self._stamp_ns) for event in self._open.values())
        self._open.clear()


def _timed(event: Event, end_ns: int) -> TimedEvent:
    return TimedEvent(
        event.body, event.kind, event.hand, event.since_ns, end_ns, event.confidence, np.array(event.direction)
    )
