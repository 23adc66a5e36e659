"""The input node: publishes a source's skeletons at their capture rate, at another rate, or as fast as possible."""

import dataclasses
from collections.abc import Iterable, Iterator
from contextlib import closing
from typing import NamedTuple

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.checks.problem import Problem
from steadypose.nodes.graph.clock import POLL_S, Clock, Timeline
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.relay import CONTEXT
from steadypose.nodes.sources.recording import end_of
from steadypose.nodes.sources.registry import InputSettings, open_input
from steadypose.nodes.sources.source import LiveSource, RecordedSource

LEAP_NS = 15_000_000_000
"""Step of stamps, in either direction, that is a clock reset instead of a pause to wait for, nanoseconds."""
LOOP_PAUSE_NS = 1_000_000_000
"""Pause before a looped recording restarts, nanoseconds: long enough for every stage to drop its bodies."""


class Position(NamedTuple):
    """The playback position in a recording."""

    loops_ns: int = 0  # offset of stamps against the recording from earlier loops, nanoseconds
    messages: int = 0  # number of messages published in this loop


class _Played(NamedTuple):
    at: Position
    topic: str
    message: Message


class PoseInputNode(Node):
    """Publishes ``pose/raw``, and ``pose/truth`` if the source has it. Ends when the source ends.

    If it is restarted while it plays a recording to reliable subscribers, it resumes at the first message that they
    have not acknowledged.
    """

    name = "pose_input"

    def __init__(
        self, launch: Launch, clock: Clock | None = None, source: RecordedSource | LiveSource | None = None
    ) -> None:
        super().__init__(launch, clock)
        settings = launch.settings(InputSettings)
        self._source = source or open_input(launch, self.clock)
        if launch.transport.lossless and not isinstance(self._source, LiveSource):  # a camera cannot repeat its frames
            self._lag = CONTEXT
        self._rate, self._loop, self._pose = settings.rate, settings.loop, settings.calibration.pose
        self._last_ns: int | None = None
        self._at = Position()
        self._pace: Timeline | None = None  # on the monotonic clock, so that setting the wall clock has no effect

    def handle(self, topic: str, message: Message) -> None:
        raise AssertionError("the input node subscribes to none")

    def work(self) -> None:
        if isinstance(self._source, LiveSource):
            self._pass_on(self._source)
        else:
            self._play(self._source)

    def _pass_on(self, source: LiveSource) -> None:
        with closing(source.frames()) as frames:
            for frame in frames:
                if self.stopping:
                    return
                if frame:
                    if self.timeline is None:
                        now = self.clock.now_ns()
                        # a subscribed topic may be a replay with old stamps
                        wall_ns = frame.stamp_ns if abs(now - frame.stamp_ns) < LEAP_NS else now
                        self.timeline = Timeline(frame.stamp_ns, wall_ns, 1.0)
                        self.report()
                    try:
                        self.publish(POSE_RAW, self._with_pose(frame))
                    except ValueError as error:  # more bodies than a message holds
                        self.refuse(POSE_RAW, error)
                    self.settle()  # a restarted process continues the sequence numbers; older ones would be refused
                self.report_if_due()

    def _play(self, source: RecordedSource) -> None:
        began = Position(*self._relay.begun.mark) if self._relay and self._relay.begun else Position()
        last: PoseRaw | None = None
        for played, due_ns in _with_due(self._messages(source, began.loops_ns)):
            self._at, topic, message = played
            last = message if isinstance(message, PoseRaw) else last
            if self._at <= began:
                continue  # this node's predecessor published it, and it was acknowledged
            if message.stamp_ns != self._last_ns:
                self._wait_for(message.stamp_ns, due_ns)
            if self.stopping:
                return
            try:
                self.publish(topic, self._with_pose(message))
            except ValueError as error:  # a recorded message that breaks a limit of the transport
                self.refuse(topic, error)
            self.settle()
            self.report_if_due()
        if last and not self.stopping:
            self.publish(POSE_RAW, end_of(last))
        while not self.settle(POLL_S):  # unacknowledged messages exist only in this process
            if self.stopping:
                return
            self.report_if_due()
        if self._relay:
            self._relay.forget()

    def mark(self, message: Message) -> tuple[int, int]:
        return self._at

    def problems(self) -> list[Problem]:
        return self._source.problems() if isinstance(self._source, LiveSource) else []

    def _set_timeline(self) -> None:
        """Convert the playback timeline to wall time, which may have been set since."""
        if self._pace:
            set_ns = self.clock.now_ns() - self.clock.monotonic_ns()
            self.timeline = dataclasses.replace(self._pace, wall_ns=self._pace.wall_ns + set_ns)

    def status(self) -> dict[str, str]:
        self._set_timeline()
        refused = {f"refused.{cause}": str(n) for cause, n in self._source.refused.items() if n}
        camera = self._source.status() if isinstance(self._source, LiveSource) else {}
        return camera | refused | (self.timeline.values() if self.timeline else {})

    def _with_pose(self, message: Message) -> Message:
        """The message with the launch file's sensor pose, unless the message is calibrated already."""
        if self._pose and isinstance(message, PoseRaw) and not message.calibrated:
            return dataclasses.replace(message, sensor_pose=self._pose, calibrated=True)
        return message

    def _messages(self, source: RecordedSource, shift_ns: int) -> Iterator[_Played]:
        while True:
            newest_ns = 0
            first_ns: int | None = None
            for count, (topic, message) in enumerate(source, start=1):
                first_ns = message.stamp_ns if first_ns is None else first_ns
                newest_ns = max(newest_ns, message.stamp_ns)
                if shift_ns:
                    message = dataclasses.replace(message, stamp_ns=message.stamp_ns + shift_ns)
                yield _Played(Position(shift_ns, count), topic, message)
            if not self._loop or first_ns is None:
                return
            shift_ns += newest_ns - first_ns + LOOP_PAUSE_NS

    def _wait_for(self, stamp_ns: int, due_stamp_ns: int) -> None:
        """Wait until ``due_stamp_ns`` is played. If the source's clock was set, restart the timeline from now."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if not self._rate:
            return
        if self._pace is None or last_ns is None or abs(stamp_ns - last_ns) > LEAP_NS:
            self._pace = Timeline(stamp_ns, self.clock.monotonic_ns(), self._rate)
            self._set_timeline()
            self.report()
        due_ns = self._pace.wall(due_stamp_ns)
        while (left_ns := due_ns - self.clock.monotonic_ns()) > 0 and not self.stopping:
            self.clock.sleep(min(left_ns, round(POLL_S * 1e9)))
            self.report_if_due()


def _with_due(messages: Iterable[_Played]) -> Iterator[tuple[_Played, int]]:
    """Messages, each with the stamp at which it is due.

    This is its own stamp. If that lies ahead of the following message's stamp by mistake, it is the following one's.
    """
    waiting: list[_Played] = []
    last_ns = 0
    for played in messages:
        stamp_ns = played.message.stamp_ns
        if waiting and stamp_ns != (ahead_ns := waiting[0].message.stamp_ns):
            due_ns = stamp_ns if last_ns <= stamp_ns < ahead_ns else ahead_ns
            yield from ((each, due_ns) for each in waiting)
            last_ns, waiting = due_ns, []
        waiting.append(played)
    yield from ((each, each.message.stamp_ns) for each in waiting)
