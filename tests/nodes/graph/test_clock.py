"""A clock that is set while nodes run: stamps follow it, and no wait, rate or restart does."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from conftest import VirtualClock, walk

from steadypose.nodes.graph.clock import SystemClock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.supervisor import HUNG_S
from steadypose.nodes.sources.pose_input import PoseInputNode

HOUR_NS = 3_600_000_000_000


class SetClock(VirtualClock):
    """Time whose wall clock can be set."""

    def __init__(self) -> None:
        super().__init__()
        self.set_ns = 0

    def now_ns(self) -> int:
        return self.time_ns + self.set_ns


def test_the_wall_clock_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SystemClock()
    before = clock.monotonic_ns()
    monkeypatch.setattr(time, "time_ns", lambda: 1_800_000_000_000_000_000)
    assert clock.now_ns() == 1_800_000_000_000_000_000
    assert clock.monotonic_ns() - before < HUNG_S * 1e9


@pytest.mark.parametrize("step_ns", [HOUR_NS, -HOUR_NS])
def test_a_replay_goes_on_at_its_pace(make_launch: Callable[..., Launch], step_ns: int) -> None:
    clock, frames = SetClock(), walk(10)
    node = PoseInputNode(make_launch(), clock, _Source())  # type: ignore[arg-type]
    for k, frame in enumerate(frames):
        if k == 5:
            clock.set_ns = step_ns
        before = clock.time_ns
        node.report = lambda: None  # type: ignore[method-assign]
        node._wait_for(frame.stamp_ns, frame.stamp_ns)
        assert clock.time_ns - before <= 40_000_000
        node._tell_pace()
        assert node.timeline is not None
        assert abs(node.timeline.wall(frame.stamp_ns) - clock.now_ns()) < 1_000_000


class _Source:
    """In a recording's place: the test itself gives the frames."""
