from collections.abc import Callable
from dataclasses import replace
from itertools import count, cycle

import numpy as np
from conftest import repeated, running, until
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.topics import POSE_EVENTS, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import EventKind, Phase, PoseEvents, PoseWorld
from steadypose.nodes.graph.events_node import EventsNode, EventStream
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import POSE_NODES, publishers
from steadypose.prior.events.detector import EventSettings


def worlds(seconds: float) -> list[PoseWorld]:
    return [message for topic, message in messages(seconds) if topic == POSE_WORLD and isinstance(message, PoseWorld)]


def test_a_message_is_sent_when_something_changes_and_once_a_second() -> None:
    stream = EventStream(EventSettings())
    told = [(world.stamp_ns, stream.process(world)) for world in worlds(6.0)]
    sent = [(stamp_ns, events) for stamp_ns, events in told if events]
    assert all(stamp_ns == events.stamp_ns for stamp_ns, events in sent)
    changed = [any(event.phase != Phase.HOLDS for event in events.events) for _, events in sent]
    assert any(changed)
    gaps = np.diff([stamp_ns for stamp_ns, _ in sent]) / 1e9
    assert gaps.max() < 1.05
    assert all(gap > 0.95 for gap, changes in zip(gaps, changed[1:], strict=True) if not changes)


def test_the_end_of_the_stream_is_passed_on_and_who_comes_after_it_enters() -> None:
    stream = EventStream(EventSettings())
    first = worlds(1.0)
    for world in first:
        stream.process(world)
    end = stream.process(PoseWorld(first[-1].stamp_ns, "world", first[-1].source, np.array([0, 0, 1, 0]), [], True))
    assert end == PoseEvents(first[-1].stamp_ns, "world", first[-1].source, [], True)
    again = [events for world in worlds(1.0) if (events := stream.process(world))]
    assert any(event.kind == EventKind.ENTERED for events in again for event in events.events)


def test_events_are_off_unless_a_launch_file_has_them(make_launch: Callable[..., Launch]) -> None:
    assert "events" not in make_launch().nodes
    assert "events" not in POSE_NODES
    assert publishers(POSE_EVENTS) == ["events"]


def test_the_node_publishes_what_the_trajectory_node_makes_known(make_launch: Callable[..., Launch]) -> None:
    launch = make_launch(nodes='["trajectory", "events"]', transport__lossless="false")
    stream, stamps = cycle(worlds(1.0)), count(10**9, 33_333_333)
    with (
        Publisher(launch.transport.endpoint("trajectory")) as publisher,
        running(EventsNode(launch)),
        Subscriber([launch.transport.endpoint("events")], [POSE_EVENTS]) as subscriber,
        repeated(lambda: publisher.publish(POSE_WORLD, replace(next(stream), stamp_ns=next(stamps)))),
    ):

        def stands() -> bool:
            received = subscriber.receive(0.01)
            events = received[1].events if received and isinstance(received[1], PoseEvents) else []
            return any(event.kind == EventKind.STANDS for event in events)

        until(stands)
