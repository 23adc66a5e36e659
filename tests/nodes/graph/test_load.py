import dataclasses
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq
from conftest import VirtualClock, listeners, raw, running, until, walk, walking
from tests.helpers.msg_strategies import clean

from steadypose.msgs.security import create_keys
from steadypose.msgs.subscriber import HANDSHAKE
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import Diagnostics, Level, Message, Pose, PoseRaw, PoseWorld
from steadypose.nodes.checks.problem import from_values
from steadypose.nodes.checks.stream import AT_ONCE, StreamChecks
from steadypose.nodes.graph.inbox import CALM_NS, DEADLINE_NS, LONGEST, LOOK_NS, READ_AHEAD, BodyLimit, Inbox
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.prior_node import PriorNode
from steadypose.nodes.graph.run_state import Ledger
from steadypose.nodes.graph.trajectory_node import TrajectoryNode
from steadypose.nodes.settings import LaunchError
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.pipeline import CATCH_UP, PriorPipeline
from steadypose.prior.clean.settings import PriorSettings

FRAME_NS = 33_333_333
SIMPLE = {stage: {"enabled": False} for stage in ("score", "impute")}


class Line:
    """In a subscriber's place: gives what has come by now."""

    socket = 0

    def __init__(self, clock: VirtualClock, messages: Sequence[tuple[int, PoseRaw | Diagnostics | None]]) -> None:
        self._clock, self.messages = clock, deque(messages)  # None: a frame that is refused

    @property
    def pending(self) -> bool:
        return bool(self.messages) and self.messages[0][0] <= self._clock.time_ns

    def receive(self, timeout_s: float, *, taken: bool = True) -> tuple[str, Message] | None:
        if self.pending and (message := self.messages.popleft()[1]):
            return DIAGNOSTICS if isinstance(message, Diagnostics) else POSE_RAW, message
        return None


def inbox_of(clock: VirtualClock, *lines: Line, limit: int | None = 8) -> Inbox:
    return Inbox(lines, limit=limit, clock=clock)  # type: ignore[arg-type]


def at_once(*messages: PoseRaw | Diagnostics) -> list[tuple[int, PoseRaw | Diagnostics]]:
    return [(0, message) for message in messages]


def frames(count: int) -> list[PoseRaw]:
    return [raw(k) for k in range(count)]


def camera(clock: VirtualClock, seconds: float, source: str = "test") -> Line:
    count, start_ns = round(seconds * 30), clock.time_ns
    frames = (dataclasses.replace(raw(k, stamp_ns=start_ns + k * FRAME_NS), source=source) for k in range(count))
    return Line(clock, [(frame.stamp_ns, frame) for frame in frames])


@pytest.mark.parametrize(("work_ms", "latest_ms"), [(20, 34), (60, 134), (100, 200)])
def test_the_newest_is_worked_on_however_slow_the_work(clock: VirtualClock, work_ms: int, latest_ms: int) -> None:
    inbox, late = inbox_of(clock, camera(clock, 10.0)), []
    end_ns = clock.time_ns + 10 * 10**9
    while clock.time_ns < end_ns:
        received = inbox.next(0)
        if received is None:
            clock.time_ns += 1_000_000
            continue
        clock.time_ns += work_ms * 1_000_000
        late.append(clock.time_ns - received[1].stamp_ns - work_ms * 1_000_000)
    assert max(late) <= min(latest_ms * 1_000_000, DEADLINE_NS + FRAME_NS)
    assert len(late) + inbox.overrun >= 290, "each is worked on or counted"


def test_frames_too_old_in_a_clients_socket_do_not_keep_back_the_fresh_ones_behind(clock: VirtualClock) -> None:
    """They had cost one call each: a client that had once fallen behind a busy server was never heard again."""
    lines = [Line(clock, [(0, None)] * 30 + at_once(raw(30))), Line(clock, at_once(*frames(2)))]
    inbox = inbox_of(clock, *lines)
    assert [inbox.next(0), inbox.next(0)] == [(POSE_RAW, raw(30)), (POSE_RAW, raw(0))]


def test_frames_that_come_late_together_are_all_worked_on(clock: VirtualClock) -> None:
    """A camera that stood still for a sixth of a second: its frames have waited for it, not for the node."""
    late = [(clock.time_ns + 10**8, raw(k, stamp_ns=clock.time_ns + k * FRAME_NS)) for k in range(5)]
    inbox, worked = inbox_of(clock, Line(clock, late)), 0
    for _ in range(200):
        worked += inbox.next(0) is not None
        clock.time_ns += 8_000_000
    assert (worked, inbox.overrun) == (5, 0)


def test_a_server_that_waited_for_them_processes_all(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    arrival_ns = clock.time_ns + 10**8
    frames = [(arrival_ns, raw(k, stamp_ns=arrival_ns + k * FRAME_NS)) for k in range(3)]

    class Poller:
        """Waits for the frames, by the test's clock."""

        def register(self, *_: object) -> None: ...

        def poll(self, timeout_ms: int) -> list[tuple[int, int]]:
            clock.time_ns = max(clock.time_ns, arrival_ns) if timeout_ms else clock.time_ns
            return [(0, zmq.POLLIN)] if clock.time_ns >= arrival_ns else []

    monkeypatch.setattr(zmq, "Poller", Poller)
    inbox = Inbox([Line(clock, frames), Line(clock, [])], limit=8, clock=clock)  # type: ignore[list-item]
    assert [inbox.next(1.0) is not None for _ in range(4)] == [True, True, True, False]
    assert inbox.overrun == 0


def test_clients_share_what_time_there_is(clock: VirtualClock) -> None:
    names = [f"client {k}" for k in range(20)]
    inbox = Inbox([camera(clock, 20.0, name) for name in names], limit=8, clock=clock)  # type: ignore[misc]
    worked, end_ns = dict.fromkeys(names, 0), clock.time_ns + 19 * 10**9
    while clock.time_ns < end_ns:
        _, message = inbox.next(0)  # type: ignore[misc]
        assert isinstance(message, PoseRaw)
        assert clock.time_ns - message.stamp_ns <= DEADLINE_NS + FRAME_NS
        worked[message.source] += 1
        clock.time_ns += 5_000_000
    assert max(worked.values()) - min(worked.values()) <= 1


def kept(inbox: Inbox) -> list[Message]:
    return [message for _, message in iter(lambda: inbox.next(0), None)]


def test_a_late_node_keeps_the_newest_frames_the_end_of_the_stream_and_the_news(clock: VirtualClock) -> None:
    end, news = dataclasses.replace(raw(5), end_of_stream=True), Diagnostics(0, "pose_input", Level.OK, "")
    line = Line(clock, at_once(*frames(5), end, news, *frames(20)))
    inbox = inbox_of(clock, line, limit=3)
    assert kept(inbox) == [end, news, *frames(20)[17:]]
    assert inbox.overrun == 22


def of_sources(count: int) -> list[PoseRaw]:
    return [dataclasses.replace(raw(0), source=f"client {k}") for k in range(count)]


def test_the_streams_of_one_publisher_do_not_displace_each_other_and_fill_no_memory(clock: VirtualClock) -> None:
    inbox = Inbox([Line(clock, at_once(*of_sources(20)))], limit=1, clock=clock)  # type: ignore[list-item]
    assert len(kept(inbox)) == 20
    assert inbox.overrun == 0
    line = Line(clock, at_once(*of_sources(LONGEST) * 4))
    inbox = inbox_of(clock, line)
    inbox.next(0)
    assert len(line.messages) == 4 * LONGEST - READ_AHEAD, "who sends without end does not keep it from working"
    while line.messages:  # it reads faster than it processes
        inbox.next(0)
        assert len(inbox) <= LONGEST


def test_publishers_take_turns_and_who_floods_loses_its_own(tmp_path: Path, clock: VirtualClock) -> None:
    quiet, loud = (f"ipc://{tmp_path}/{name}" for name in ("quiet", "loud"))
    with ExitStack() as stack:
        publishers = [stack.enter_context(Publisher(address)) for address in (quiet, loud)]
        subscribers = [stack.enter_context(Subscriber(a, POSE_RAW, name="test")) for a in (quiet, loud)]
        for publisher in publishers:
            assert publisher.wait_for_subscribers({"test"}, timeout_s=10)
        for _ in range(50):
            publishers[1].publish(POSE_RAW, raw(1))
        for _ in range(3):
            publishers[0].publish(POSE_RAW, raw(0))
        inbox, got = Inbox(subscribers, limit=3, clock=clock), []
        until(lambda: all(subscriber.socket.poll(0) for subscriber in subscribers))

        def all_accounted_for() -> bool:  # the flood may arrive in parts, and more than three of it be kept
            received = inbox.next(0.1)
            got.extend([received[1]] if received else [])
            return len(got) + inbox.overrun == 53

        until(all_accounted_for)
        assert sum(message.stamp_ns == raw(0).stamp_ns for message in got) == 3
        assert inbox.overrun > 0


def test_a_lossless_node_leaves_the_rest_to_the_sender(clock: VirtualClock) -> None:
    line = Line(clock, at_once(*frames(500)))
    inbox = inbox_of(clock, line, limit=None)
    assert inbox.next(0) is not None
    assert len(line.messages) == 500 - READ_AHEAD, "nor is a fast source read without end"
    assert len(kept(inbox)) == 499
    assert inbox.overrun == 0


def overloaded(clock: VirtualClock, limit: BodyLimit, seconds: float, ms_a_body: float, present: int) -> None:
    """A camera at 30 Hz with so many bodies, whose frames are dropped while there is no time for them."""
    dropped, end_ns = limit._dropped_before, clock.time_ns + seconds * 1e9
    while clock.time_ns < end_ns:
        worked_on = min(present, limit.bodies)
        spent_ns = round(worked_on * ms_a_body * 1e6)
        clock.time_ns += max(spent_ns, FRAME_NS)
        dropped += spent_ns > FRAME_NS
        limit.note(worked_on, spent_ns, dropped)


def test_fewer_bodies_come_before_fewer_frames(clock: VirtualClock) -> None:
    limit = BodyLimit(16, clock)
    overloaded(clock, limit, 3.0, ms_a_body=1.0, present=16)
    assert limit.bodies == 16, "there is time for all"
    overloaded(clock, limit, 3.0, ms_a_body=4.0, present=16)
    assert 6 <= limit.bodies <= 8, "33 ms are time for eight"
    overloaded(clock, limit, 5 * CALM_NS / 1e9, ms_a_body=4.0, present=16)
    assert 6 <= limit.bodies <= 8, "it does not try what it knows to take too long"
    overloaded(clock, limit, 20.0, ms_a_body=1.0, present=16)
    assert limit.bodies == 16, "the load is gone"
    overloaded(clock, limit, 10.0, ms_a_body=100.0, present=16)
    assert limit.bodies == 1, "one is always worked on"


def note_for(clock: VirtualClock, limit: BodyLimit, seconds: float, *, busy: float, in_time: float) -> None:
    """A server's messages, 300 a second, one body in each look."""
    dropped, spent_ns = float(limit._dropped_before), round(busy * 1e9 / 300)
    for _ in range(round(seconds * 300)):
        clock.time_ns += 10**9 // 300
        dropped += 1 / in_time - 1
        limit.note(8, spent_ns, int(dropped))


@pytest.mark.parametrize(("busy", "in_time", "fewer"), [(0.9, 0.7, True), (0.9, 0.98, False), (0.3, 0.7, False)])
def test_bodies_are_left_out_where_they_take_the_time(clock: VirtualClock, busy: float, in_time: float, fewer: bool):
    limit = BodyLimit(8, clock)
    note_for(clock, limit, 1.2, busy=busy, in_time=in_time)
    assert (limit.bodies < 8) == fewer


def test_one_more_body_is_tried_though_messages_without_any_take_half_the_time(clock: VirtualClock) -> None:
    limit = BodyLimit(8, clock)
    limit.bodies = 1
    for _ in range(1200):  # four seconds, of which the messages take half and a body a sixtieth
        clock.time_ns += 10**9 // 300
        limit.note(limit.bodies, round((0.5 + limit.bodies / 60) * 1e9 / 300), 0)
    assert limit.bodies >= 5


def test_the_nearest_bodies_stay() -> None:
    prior = PriorPipeline(PriorSettings.from_dict(SIMPLE))
    bodies = [walking(0, body) for body in range(4)]
    found, placed = [], bodies
    for index in range(10):
        placed = [
            dataclasses.replace(body, positions=body.positions + np.array([3.0 * (4 - body.id), 0, 0], np.float32))
            for body in bodies
        ]
        if index == 5:
            prior.most_bodies = 2
        found = prior.process(raw(index, *placed))
    assert {body.id for body in found[-1].bodies} == {2, 3}
    assert (prior.bodies, prior.offered) == (2, 4)
    assert prior.counters["body_for_load"] == 10
    prior.most_bodies = 8
    for index in range(10, 20):
        found = prior.process(raw(index, *placed))
    assert {body.id for body in found[-1].bodies} == {0, 1, 2, 3}


@pytest.mark.parametrize("lost", [3, 10, 40])
def test_a_gap_of_our_own_making_resets_no_body(lost: int) -> None:
    prior = PriorPipeline(PriorSettings.from_dict(SIMPLE))
    frames, before = walk(45 + lost + 20), []
    for frame in frames[:45]:
        before = prior.process(frame)
    bones = before[-1].bodies[0].bone_lengths
    after = prior.process(frames[45 + lost], gap=True)
    assert len(after) <= CATCH_UP, "what was dropped is not computed after all"
    for frame in frames[45 + lost + 1 :]:
        after = prior.process(frame)
    assert not prior.counters["stream_gap"]
    assert after[-1].bodies[0].id == before[-1].bodies[0].id
    np.testing.assert_allclose(after[-1].bodies[0].bone_lengths, bones, atol=0.01)
    newest = after[-1]
    truth = frames[-1 - round(newest.delay_frames)].bodies[0].positions
    assert np.linalg.norm(newest.bodies[0].positions - truth, axis=1).max() < 0.1


def test_a_server_that_is_late_skips_frames_and_not_bodies() -> None:
    server = StreamBatch(PriorSettings.from_dict(SIMPLE), 1)
    frames = walk(90)
    for frame in frames[:60]:
        server.process_at(frame, frame.stamp_ns)
    found = server.process_at(frames[80], frames[80].stamp_ns, hurry=True, gap=True)
    assert len(found) <= CATCH_UP + 2
    for frame in frames[81:]:
        found += server.process_at(frame, frame.stamp_ns)
    assert found[-1].bodies
    assert not server.counters["stream_gap"]
    assert server.counters["frames_skipped"] > 10


def test_a_tracker_whose_messages_are_dropped_has_not_stopped_and_streams_take_turns(clock: VirtualClock) -> None:
    checks = StreamChecks(PriorSettings(), 2)
    for source in ("door", "desk"):
        checks.see(dataclasses.replace(raw(0, walking(0)), source=source), clock.time_ns)
    clock.time_ns += 3 * 10**9
    checks.heard("door", clock.time_ns)
    assert {problem.cause for problem in checks.problems(clock.time_ns, live=True)} == {"desk.stopped"}
    checks, upside_down = StreamChecks(PriorSettings(), 10), np.array([1.0, -1.0, -1.0], np.float32)
    for k in range(45):
        clock.time_ns += FRAME_NS
        for n in range(10):
            message = dataclasses.replace(raw(0, walking(k)), source=f"client {n}", stamp_ns=clock.time_ns)
            body = message.bodies[0]
            message.bodies = [dataclasses.replace(body, positions=body.positions * upside_down)]
            checks.see(message, clock.time_ns)
    found = [len(checks.problems(clock.time_ns + k, live=True)) for k in range(3)]
    assert found == [AT_ONCE, 2 * AT_ONCE, 10], "what was found stays until a stream is examined again"


def test_the_inbox_says_whose_frames_it_dropped(clock: VirtualClock) -> None:
    inbox = inbox_of(clock, camera(clock, 1.0))
    clock.time_ns += LOOK_NS
    received: Any = inbox.next(0)
    assert inbox.sources == {"test"}
    assert inbox.dropped_of(received[1])
    assert not inbox.dropped_of(received[1]), "the frame after it follows on"
    assert not inbox.sources


def report(node: str, **values: int) -> Diagnostics:
    named = {key.replace("__", ".", 1).replace("__", "/"): str(value) for key, value in values.items()}
    return Diagnostics(0, node, Level.OK, "", named)


@pytest.mark.parametrize("lossless", ["true", "false"])
def test_what_was_dropped_before_a_restart_stays_dropped(make_launch: Callable[..., Launch], lossless: str) -> None:
    ledger = Ledger(make_launch(transport__lossless=lossless))
    ledger.note(report("prior", dropped__late=2, count__pose__clean=10), 0)
    ledger.note(report("prior", dropped__late=3, count__pose__clean=20), 0)
    after = ledger.note(report("prior", dropped__late=1, count__pose__clean=25), 1)
    assert after.values["dropped.late"] == "4"
    # a lossless node counts on itself
    assert after.values["count.pose/clean"] == {"true": "25", "false": "45"}[lossless]
    ledger.note(report("pose_input", count__pose__raw=20), 0)
    after = ledger.note(report("pose_input", count__pose__raw=25), 1)
    assert after.values["count.pose/raw"] == "25", "so does a source"


def test_a_live_stream_is_published_for_nobody_while_a_node_is_away(make_launch: Callable[..., Launch]) -> None:
    ledger = Ledger(make_launch(transport__lossless="false"))
    reports = {
        "pose_input": ledger.note(report("pose_input", count__pose__raw=100), 0),
        "prior": ledger.note(report("prior", in__pose__raw=30, dropped__late=5), 0),
    }
    assert not ledger.away("prior", reports), "it is only on its way"
    reports["prior"] = ledger.note(report("prior", in__pose__raw=40), 1)
    assert ledger.away("prior", reports) == {"dropped.away pose/raw": "25"}


FRAMES = 25


def client(name: str, bodies: int, ahead_ns: int) -> list[PoseRaw]:
    """A client's stream, its clock so far ahead."""
    return [dataclasses.replace(m, source=name, stamp_ns=m.stamp_ns + ahead_ns) for m in walk(FRAMES, bodies)]


@pytest.mark.parametrize("secret", [False, True])
def test_two_clients_and_a_server(make_launch, tmp_path: Path, clock: VirtualClock, secret: bool) -> None:
    streams = {"door": client("door", 1, 0), "desk": client("desk", 2, 3_600_000_000_000)}
    # clients and server have the same keys
    keys = create_keys(tmp_path / "keys") if secret else None
    outputs: dict[str, list[PoseWorld]] = defaultdict(list)
    with ExitStack() as stack:
        door, desk = (stack.enter_context(Publisher("tcp://127.0.0.1:*", keys=keys)) for _ in streams)
        launch = make_launch(
            nodes='["prior", "trajectory"]', server__clients=str([door.endpoint, desk.endpoint]),
            transport__lossless="false", transport__queue=100, transport__keys=tmp_path / "keys" if secret else "",
        )  # fmt: skip
        prior, trajectory = PriorNode(launch, clock), TrajectoryNode(launch, clock)
        stack.enter_context(running(prior, trajectory))
        listener = Subscriber(launch.transport.endpoint("trajectory"), POSE_WORLD, keys=keys, name="test")
        subscriber = stack.enter_context(listener)
        for publisher in (door, desk):
            assert publisher.wait_for_subscribers({"prior"}, timeout_s=20)
        until(lambda: clock.sleep(33_333_333) or {"trajectory"} <= listeners(prior))
        until(lambda: clock.sleep(33_333_333) or {"test"} <= listeners(trajectory))
        for k in range(FRAMES):
            clock.time_ns += 33_333_333
            for publisher, name in ((door, "door"), (desk, "desk")):
                publisher.publish(POSE_RAW, streams[name][k])
            until(lambda k=k: len(prior.health.compute_ns) == 2 * (k + 1))

        def complete() -> bool:
            while received := subscriber.receive(0):
                assert isinstance(received[1], PoseWorld)
                outputs[received[1].source].append(received[1])
            return len(outputs) == 2 and all(len(found) >= FRAMES - 6 for found in outputs.values())

        until(complete)
        assert door.subscribers == {"prior"}, "what a client says of itself is no matter of the trajectory's"
    assert prior.status()["streams"] == "2"
    for name, bodies in (("door", 1), ("desk", 2)):
        captured = {round(m.stamp_ns / 1e6) for m in streams[name]}
        assert {round(m.stamp_ns / 1e6) for m in outputs[name]} <= captured, "stamps are of its own clock"
        assert {body.id for m in outputs[name] for body in m.bodies} == set(range(bodies))
        assert all(len(m.bodies) == bodies for m in outputs[name])


def test_what_is_garbled_or_lacks_keys_is_reported_with_the_address(make_launch, clock: VirtualClock) -> None:
    node = TrajectoryNode(make_launch(nodes='["trajectory"]'), clock)
    door, desk = (
        SimpleNamespace(addresses=f"tcp://{name}:7111", dropped=Counter(), late=Counter(), refused=Counter[str]())
        for name in ("door", "desk")
    )
    node._subscribers = [door, desk]  # type: ignore[list-item]
    door.refused.update(undecodable=2)
    desk.refused.update({HANDSHAKE: 1})
    found = from_values(node.diagnostics().values)
    assert "(undecodable: 2 from tcp://door:7111)" in found["not_a_message"]
    assert "no connection to tcp://desk:7111: expected CurveZMQ keys" in found["keys"]
    assert not from_values(node.diagnostics().values), "until it happens again"


def test_counts_of_a_client_that_came_back_under_another_name_stay(make_launch: Callable[..., Launch]) -> None:
    clients = '["tcp://127.0.0.1:1"]'
    node = TrajectoryNode(make_launch(nodes='["trajectory"]', server__clients=clients, transport__lossless="false"))
    for name in ("door", "desk", "hall"):
        node.handle(POSE_CLEAN, dataclasses.replace(clean(), source=name, sensor_pose=Pose(np.zeros(3), np.zeros(4))))
    assert node.status()["refused.sensor_pose_invalid"] == "3"


def test_what_a_server_cannot_be_and_its_launch_file_goes_with_the_clients(make_launch: Callable[..., Launch]) -> None:
    of = {"server__clients": '["tcp://127.0.0.1:1"]', "transport__lossless": "false"}
    for wrong, expected in (
        ({"nodes": '["pose_input", "prior"]'}, "have their own pose_input"),
        ({"nodes": '["prior"]', "transport__lossless": "true"}, "lossless = false"),
    ):
        with pytest.raises(LaunchError, match=expected):
            make_launch(**(of | wrong))
    server, own = Launch.read("server"), Launch.read("kiosk")
    assert own.transport.endpoint("pose_input") in server.addresses("pose_input")
    assert own.nodes == ["pose_input"]
