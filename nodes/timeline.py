"""Events with begin and end: those of each frame, and those of a whole stream, each once."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import EventKind, Hand, Phase, PoseWorld
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
    """capture time at which it was seen to have ended; of the newest frame, while it holds; for ENTERED and LEFT, as
    `begin_ns`"""
    confidence: float
    """0 to 1: probability of the event's condition when it began"""
    direction: NDArray[np.float64]
    """(3,) direction of POINTS when it began: unit vector, world; zeros for other events"""
    phase: Phase
    """what it does in the newest frame: it begins, holds or ends; ENTERED and LEFT begin and are over. In the events of
    a whole stream, HOLDS if the stream ended first"""


_Key = tuple[int, EventKind, Hand]
_MOMENTS = (EventKind.ENTERED, EventKind.LEFT)


class FrameEvents:
    """Detects the events of each frame of one stream, with begin and end."""

    def __init__(self, settings: EventSettings | None = None) -> None:
        self._detector = EventDetector(settings)
        self._open: dict[_Key, TimedEvent] = {}
        self._stamp_ns = -1

    def update(
        self, world: PoseWorld, sensor: NDArray[np.float64] = NOWHERE, *, calibrated: bool = False
    ) -> list[TimedEvent]:
        """Return the events that begin, hold or end with the next message of ``pose/world``; the arguments are those of
        `EventDetector.update`.

        An event holds until it is seen to have ended, so also while its body is hidden for a moment.
        """
        now = world.stamp_ns
        if world.end_of_stream or now <= self._stamp_ns:
            self._open.clear()
        self._stamp_ns = now
        self._open = {key: event._replace(end_ns=now, phase=Phase.HOLDS) for key, event in self._open.items()}
        over: list[TimedEvent] = []
        for event in self._detector.update(world, sensor, calibrated=calibrated):
            key = event.body, event.kind, event.hand
            if event.phase == Phase.ENDS:
                over.append(self._open.pop(key)._replace(phase=Phase.ENDS))
            elif event.phase == Phase.BEGINS:
                end_ns = event.since_ns if event.kind in _MOMENTS else now
                direction = np.array(event.direction)
                begun = TimedEvent(*key, event.since_ns, end_ns, event.confidence, direction, Phase.BEGINS)
                if event.kind in _MOMENTS:
                    over.append(begun)
                else:
                    self._open[key] = begun
        return [*over, *self._open.values()]


class EventTimeline:
    """Collects the events of one stream."""

    def __init__(self, settings: EventSettings | None = None) -> None:
        self._frames = FrameEvents(settings)
        self._events: dict[tuple[Any, ...], TimedEvent] = {}

    def add(self, world: PoseWorld, sensor: NDArray[np.float64] = NOWHERE, *, calibrated: bool = False) -> None:
        """Add the next message of ``pose/world``; arguments as of `FrameEvents.update`."""
        for event in self._frames.update(world, sensor, calibrated=calibrated):
            self._events[event.body, event.kind, event.hand, event.begin_ns] = event

    def events(self) -> list[TimedEvent]:
        """All events so far, by begin. Those that have not ended last until the newest message."""
        return sorted(self._events.values(), key=lambda event: (event.begin_ns, event.body))
