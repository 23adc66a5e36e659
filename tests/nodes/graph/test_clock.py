from collections.abc import Callable

import pytest
from conftest import START_NS, VirtualClock, walk

from steadypose.msgs.types import Message
from steadypose.nodes.graph.clock import Timeline
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.sources.pose_input import PoseInputNode

HOUR_NS = 3_600_000_000_000


class SetClock(VirtualClock):
    """Time whose wall clock can be set."""

    set_ns = START_NS

    def now_ns(self) -> int:
        return self.time_ns + self.set_ns


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_a_replay_goes_on_at_its_pace(make_launch: Callable[..., Launch], step_ns: int) -> None:
    clock, frames = SetClock(), walk(10)
    node = PoseInputNode(make_launch(), clock, _Source())  # type: ignore[arg-type]
    for k, frame in enumerate(frames):
        if k == 5:
            clock.set_ns += step_ns
        before = clock.time_ns
        node.report = lambda: None  # type: ignore[method-assign]
        node._wait_for(frame.stamp_ns, frame.stamp_ns)
        assert clock.time_ns - before <= 40_000_000
        node._tell_pace()
        assert node.timeline is not None
        assert abs(node.timeline.wall(frame.stamp_ns) - clock.now_ns()) < 1_000_000


class _Source:
    """In a recording's place: the test itself gives the frames."""


class Listener(Node):
    """A node of the graph that only measures."""

    name = "prior"

    def handle(self, topic: str, message: Message) -> None: ...


@pytest.mark.parametrize("step_ns", [10 * 365 * 86400 * 10**9, -(10**9)])
@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_a_clock_that_is_set_makes_no_frame_late(make_launch: Callable[..., Launch], step_ns: int, rate: float) -> None:
    clock = SetClock()
    node = Listener(make_launch(nodes='["prior"]'), clock)
    node.timeline = timeline = Timeline(1_000, clock.now_ns(), rate)
    clock.time_ns += 1_000_000_000
    stamp_ns = timeline.stamp_at(clock.now_ns()) - round(20_000_000 * rate)
    assert node._late_ns(timeline, stamp_ns) == pytest.approx(20_000_000, abs=1000)
    clock.set_ns += step_ns
    assert node._late_ns(timeline, stamp_ns) == pytest.approx(20_000_000, abs=1000)
