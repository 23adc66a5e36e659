import errno
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import count, cycle
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import START_NS, VirtualClock, listeners, raw, repeated, running, until, walk, walking
from tests.helpers.synthetic_poses import messages_on

from steadypose.msgs.publisher import SEND_HIGH_WATER
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import EventKind, Level, Message, Phase, PoseClean, PoseEvents, PoseRaw, PoseWorld
from steadypose.nodes.graph.clock import Timeline
from steadypose.nodes.graph.events_node import EventsNode, EventStream
from steadypose.nodes.graph.health import Health
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.relay import Relay
from steadypose.nodes.graph.topology import POSE_NODES, publishers
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.prior.events.detector import EventSettings

MakeLaunch = Callable[..., Launch]


def clean(message: PoseRaw) -> PoseClean:
    return PoseClean(
        message.stamp_ns, message.frame_id, message.source, message.sensor_pose, message.calibrated, 0, [],
        message.end_of_stream,
    )  # fmt: skip


class Echo(Node):
    """In the prior's place: publishes for every frame, except those whose skeleton it is to stumble over."""

    name = "prior"

    def handle(self, topic: str, message: Message) -> None:
        if isinstance(message, PoseRaw):
            if message.skeleton == "bad":
                raise ArithmeticError("stumbled")
            self.publish(POSE_CLEAN, clean(message))


class Listener(Subscriber):
    def __init__(self, launch: Launch, node: str, topics: list[str], name: str = "") -> None:
        super().__init__(launch.transport.endpoint(node), topics, name=name)
        self.got: list[Any] = []

    def take_until(self, condition: Callable[[], bool]) -> None:
        while not (self.got and condition()):
            received = self.receive(30.0)
            assert received, "nothing comes any more"
            self.got.append(received[1])


def test_every_frame_arrives_though_the_listener_comes_last_and_goes_away_for_a_while(make_launch: MakeLaunch) -> None:
    launch = make_launch(nodes='["prior", "trajectory"]')
    node = Echo(launch)
    with Publisher(launch.transport.endpoint("pose_input"), reliable={"prior"}) as source, running(node):
        with Listener(launch, "prior", [DIAGNOSTICS]) as news:
            news.take_until(lambda: news.got[-1].values["state"] == "waiting for trajectory")
        assert "prior" not in source.subscribers, "it must not listen before it is heard"
        with Listener(launch, "prior", [POSE_CLEAN], name="trajectory") as trajectory:
            assert source.wait_for_subscribers({"prior"}, timeout_s=10)
            for i in range(50):
                source.publish(POSE_RAW, raw(i))
            trajectory.take_until(lambda: len(trajectory.got) == 50)
            assert [m.stamp_ns for m in trajectory.got] == [raw(i).stamp_ns for i in range(50)]
        until(lambda: "trajectory" not in listeners(node))
        for i in range(50, 60):
            source.publish(POSE_RAW, raw(i))
        with Listener(launch, "prior", [POSE_CLEAN], name="trajectory") as again:
            again.take_until(lambda: len(again.got) == 10)
            assert again.got[0].stamp_ns == raw(50).stamp_ns


def test_a_message_that_fails_is_counted_and_the_next_one_is_served(make_launch: MakeLaunch, caplog) -> None:
    launch = make_launch(nodes='["prior"]')
    node = Echo(launch)
    with (
        Publisher(launch.transport.endpoint("pose_input"), reliable={"prior"}) as source,
        running(node),
        Listener(launch, "prior", [POSE_CLEAN], name="test") as listener,
    ):
        assert source.wait_for_subscribers({"prior"}, timeout_s=10)
        until(lambda: "test" in listeners(node))
        for i in range(6):
            source.publish(POSE_RAW, raw(i, skeleton="bad" if i % 2 else "smpl22"))
        listener.take_until(lambda: len(listener.got) == 3)
        until(lambda: node.health.counts["refused.ArithmeticError"] == 3)  # the last comes after the third output
    assert sum("stumbled" in (record.exc_text or "") for record in caplog.records) == 1, "logged once"
    assert node.diagnostics().values["refused.ArithmeticError"] == "3"


def test_latency_is_from_capture_less_the_delay_and_rates_of_the_last_second(make_launch, clock: VirtualClock) -> None:
    node = Echo(make_launch(nodes='["prior"]'), clock)
    node.timeline = Timeline(START_NS, clock.time_ns, rate=2.0)
    with Publisher(node.launch.transport.endpoint("prior")) as node._publisher:
        clock.time_ns += 1_000_000_000
        for late_ms in range(1, 101):
            # two seconds of capture are one second of a replay at twice the rate
            stamp = START_NS + 2_000_000_000 - 2 * late_ms * 1_000_000
            node.publish(POSE_CLEAN, clean(raw(0, stamp_ns=stamp)), delay_ns=1_000_000)
        values = node.diagnostics().values
    expected = np.percentile(np.arange(1, 101) - 0.5, (50, 95, 99))  # the delay, too, passes twice as fast
    got = [float(values[f"latency_ms.p{p}"]) for p in (50, 95, 99)]
    np.testing.assert_allclose(got, expected, atol=1e-3)
    node = Echo(make_launch(nodes='["prior"]'), clock)
    with Publisher(node.launch.transport.endpoint("prior")) as node._publisher:
        for _ in range(30):
            node.publish(POSE_CLEAN, clean(raw(0)))
        clock.time_ns += 1_000_000_000
        assert float(node.diagnostics().values[f"rate.{POSE_CLEAN}"]) == pytest.approx(30.0)
        clock.time_ns += 1_000_000_000
        assert float(node.diagnostics().values[f"rate.{POSE_CLEAN}"]) == 0.0


def test_a_timeline_goes_through_diagnostics_and_back() -> None:
    timeline = Timeline(START_NS, 12345, 0.1)
    assert Timeline.from_values(timeline.values()) == timeline
    assert Timeline.from_values({"timeline.stamp_ns": "x"}) is None
    assert Timeline.from_values({}) is None
    for rate in ("0", "-1", "nan", "inf"):
        assert Timeline.from_values(timeline.values() | {"timeline.rate": rate}) is None, rate


def test_a_node_stops_though_it_waits_for_a_listener_who_never_comes(make_launch: MakeLaunch) -> None:
    node = Echo(make_launch(nodes='["prior", "trajectory"]'))
    with running(node):  # which stops it
        until(lambda: node.health.state.startswith("waiting"))


def test_a_node_stops_though_its_listener_does_not_read(make_launch: MakeLaunch) -> None:
    launch = make_launch(nodes='["prior", "trajectory"]')
    node = Echo(launch)
    with Publisher(launch.transport.endpoint("pose_input"), reliable={"prior"}) as source, running(node):
        deaf = Subscriber(launch.transport.endpoint("prior"), [POSE_CLEAN], reliable=True, name="trajectory")
        assert source.wait_for_subscribers({"prior"}, timeout_s=10)
        message = raw(0, walking(0))
        before = -1
        while source.publish(POSE_RAW, message, timeout_s=1.0) or node.health.published[POSE_CLEAN] > before:
            before = node.health.published[POSE_CLEAN]
            assert before < 10 * SEND_HIGH_WATER, "nothing holds the node up"
        until(lambda: node.health.unread == "waiting for trajectory to read")
        node.stop()
        until(lambda: node.health.state == "stopped")
        deaf.close()


def test_input_without_output_is_not_called_running(make_launch: MakeLaunch, clock: VirtualClock) -> None:
    node = Echo(make_launch(nodes='["prior"]'), clock)
    node.health.state = "running"
    with Publisher(node.launch.transport.endpoint("prior")) as node._publisher:
        for _ in range(4):
            assert node.diagnostics().values["state"] == "running"
            node.health.note_received(POSE_RAW)
            clock.time_ns += 600_000_000
        report = node.diagnostics()
        assert (report.values["state"], report.level) == ("stalled", Level.ERROR)
        assert "problem.no_output" in report.values
        node.publish(DIAGNOSTICS, report)
        assert node.diagnostics().values["state"] == "stalled", "news of itself are no output"
        node.publish(POSE_CLEAN, clean(raw(0)))
        assert node.diagnostics().values["state"] == "running"
        node.health.note_received(POSE_RAW)
        clock.time_ns += 60_000_000_000
        assert node.diagnostics().values["state"] == "running", "nothing comes any more: that is no fault of its own"


def test_a_restarted_node_counts_on_and_its_rates_are_its_own_and_one_moment_has_no_rate(clock: VirtualClock) -> None:
    health, brief = Health(clock), Health(clock)
    health.go_on_from({POSE_RAW: 1000})
    for _ in range(31):
        health.note_published(POSE_RAW, clock.time_ns, None)
        clock.time_ns += 50_000_000
    values = health.report("pose_input", Counter(), {}).values
    assert values[f"count.{POSE_RAW}"] == "1031"
    assert values[f"rate.{POSE_RAW}"] == values[f"mean_rate.{POSE_RAW}"] == "20.00"
    for _ in range(5):  # as when a recording of one frame ends
        brief.note_published(POSE_CLEAN, clock.time_ns, None)
        clock.time_ns += 100
    assert f"mean_rate.{POSE_CLEAN}" not in brief.report("prior", Counter(), {}).values


HOUR_NS = 3_600_000_000_000


class SetClock(VirtualClock):
    """Time whose wall clock can be set."""

    set_ns = START_NS

    def now_ns(self) -> int:
        return self.time_ns + self.set_ns


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_a_replay_goes_on_at_its_pace(make_launch: Callable[..., Launch], step_ns: int) -> None:
    clock, frames = SetClock(), walk(10)
    node = PoseInputNode(make_launch(), clock, object())  # type: ignore[arg-type]
    for k, frame in enumerate(frames):
        if k == 5:
            clock.set_ns += step_ns
        before = clock.time_ns
        node.report = lambda: None  # type: ignore[method-assign]
        node._wait_for(frame.stamp_ns, frame.stamp_ns)
        assert clock.time_ns - before <= 40_000_000
        node._set_timeline()
        assert node.timeline is not None
        assert abs(node.timeline.wall(frame.stamp_ns) - clock.now_ns()) < 1_000_000


@pytest.mark.parametrize("step_ns", [10 * 365 * 86400 * 10**9, -(10**9)])
@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_a_clock_that_is_set_makes_no_frame_late(make_launch: Callable[..., Launch], step_ns: int, rate: float) -> None:
    clock = SetClock()
    node = Echo(make_launch(nodes='["prior"]'), clock)
    node.timeline = timeline = Timeline(1_000, clock.now_ns(), rate)
    clock.time_ns += 1_000_000_000
    stamp_ns = timeline.stamp_at(clock.now_ns()) - round(20_000_000 * rate)
    assert node._late_ns(timeline, stamp_ns) == pytest.approx(20_000_000, abs=1000)
    clock.set_ns += step_ns
    assert node._late_ns(timeline, stamp_ns) == pytest.approx(20_000_000, abs=1000)


def test_events_are_sent_when_something_changes_and_once_a_second_and_the_end_of_the_stream_is_passed_on() -> None:
    stream = EventStream(EventSettings())
    outputs = [(world.stamp_ns, stream.process(world)) for world in messages_on(POSE_WORLD, 6.0)]
    sent = [(stamp_ns, events) for stamp_ns, events in outputs if events]
    assert all(stamp_ns == events.stamp_ns for stamp_ns, events in sent)
    changed = [any(event.phase != Phase.HOLDS for event in events.events) for _, events in sent]
    assert any(changed)
    gaps = np.diff([stamp_ns for stamp_ns, _ in sent]) / 1e9
    assert gaps.max() < 1.05
    assert all(gap > 0.95 for gap, changes in zip(gaps, changed[1:], strict=True) if not changes)
    stream = EventStream(EventSettings())
    first = messages_on(POSE_WORLD, 1.0)
    for world in first:
        stream.process(world)
    end = stream.process(PoseWorld(first[-1].stamp_ns, "world", first[-1].source, np.array([0, 0, 1, 0]), [], True))
    assert end == PoseEvents(first[-1].stamp_ns, "world", first[-1].source, [], True)
    again = [events for world in messages_on(POSE_WORLD, 1.0) if (events := stream.process(world))]
    assert any(event.kind == EventKind.ENTERED for events in again for event in events.events)


def test_events_are_off_unless_a_launch_file_has_them(make_launch: Callable[..., Launch]) -> None:
    assert "events" not in make_launch().nodes
    assert "events" not in POSE_NODES
    assert publishers(POSE_EVENTS) == ["events"]


def test_the_node_publishes_what_the_trajectory_node_makes_known(make_launch: Callable[..., Launch]) -> None:
    launch = make_launch(nodes='["trajectory", "events"]', transport__lossless="false")
    stream, stamps = cycle(messages_on(POSE_WORLD, 1.0)), count(10**9, 33_333_333)
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


def test_progress_that_cannot_be_written_stops_no_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "pwrite", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with Publisher(f"ipc://{tmp_path}/at") as publisher:
        Relay(tmp_path / "progress", (POSE_RAW,), supervisor=1).begin(publisher)
    assert Relay(tmp_path / "progress", (POSE_RAW,), supervisor=1).resume is None
