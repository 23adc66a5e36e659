"""The events node: ``pose/world`` in, ``pose/events`` out."""

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_EVENTS
from steadypose.msgs.types import Message, Phase, PoseClean, PoseEvents, PoseWorld
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.prior.events.detector import NOWHERE, EventDetector, EventSettings

REPEAT_NS = 1_000_000_000  # interval in stream time at which ongoing events are published again, nanoseconds


class EventStream:
    """Turns one stream of ``pose/world`` into ``pose/events``."""

    def __init__(self, settings: EventSettings) -> None:
        self._detector = EventDetector(settings)
        self._sent_ns: int | None = None
        self.sensor: NDArray[np.float64] = NOWHERE
        """(3,) metres, world: the sensor's position"""
        self.calibrated = False
        """whether it is known, and so the floor"""

    def process(self, world: PoseWorld) -> PoseEvents | None:
        """The events to publish for one ``pose/world``; None if there is nothing to publish."""
        events = self._detector.update(world, self.sensor, calibrated=self.calibrated)
        sent_ns = self._sent_ns
        since_ns = REPEAT_NS if sent_ns is None else abs(world.stamp_ns - sent_ns)
        changed = any(event.phase != Phase.HOLDS for event in events)
        if not changed and not world.end_of_stream and since_ns < REPEAT_NS:
            return None
        self._sent_ns = None if world.end_of_stream else world.stamp_ns
        return PoseEvents(world.stamp_ns, world.frame_id, world.source, events, world.end_of_stream)


class EventsNode(Node):
    """Runs an `EventStream` for each source of the trajectory node's output."""

    name = "events"

    def __init__(self, launch: Launch) -> None:
        super().__init__(launch)
        self._settings = launch.settings(EventSettings)
        self._streams: dict[str, EventStream] = {}

    def handle(self, topic: str, message: Message) -> None:
        if isinstance(message, PoseClean):
            position = message.sensor_pose.position
            if np.isfinite(position).all():
                stream = self._stream(message.source)
                stream.sensor, stream.calibrated = position, message.calibrated
        elif isinstance(message, PoseWorld):
            events = self._stream(message.source).process(message)
            if events is not None:
                self.publish(POSE_EVENTS, events)

    def _stream(self, source: str) -> EventStream:
        stream = self._streams.pop(source, None) or EventStream(self._settings)
        self._streams[source] = stream
        if len(self._streams) > max(len(self.launch.server.clients), 1):  # a client reconnected under another name
            del self._streams[next(iter(self._streams))]
        return stream
