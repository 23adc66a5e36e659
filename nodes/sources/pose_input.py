"""The input node: gives the skeletons of a source at the pace they were captured, at another, or as they are taken."""

from __future__ import annotations

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
from steadypose.nodes.sources.image import NAME as IMAGE
from steadypose.nodes.sources.recording import end_of
from steadypose.nodes.sources.registry import InputSettings, open_input
from steadypose.nodes.sources.source import LiveSource, RecordedSource

LEAP_NS = 15_000_000_000
"""a step of stamps, either way, that is a clock set anew, not a pause: it is not waited for"""
LOOP_PAUSE_NS = 1_000_000_000
"""between the end of a stream and its start over; long enough for every stage to let go of its bodies"""


class Position(NamedTuple):
    """Where a recording is."""

    loops_ns: int = 0
    """by how much stamps are later than in the recording, because it was played before"""
    messages: int = 0
    """of this time through, that were published"""


class _Played(NamedTuple):
    at: Position
    topic: str
    message: Message


class PoseInputNode(Node):
    """Publishes ``pose/raw``, and ``pose/truth`` where the source has it; ends when the source does.

    When it is restarted while it plays a recording for listeners who miss nothing, it resumes where they are.
    """

    name = "pose_input"

    def __init__(
        self, launch: Launch, clock: Clock | None = None, source: RecordedSource | LiveSource | None = None
    ) -> None:
        super().__init__(launch, clock)
        settings = launch.settings(InputSettings)
        transport = launch.transport
        self._source = source or open_input(
            settings,
            self.clock,
            transport.curve_keys(),
            clear_text=transport.clear_text,
            image_file=transport.ipc_directory / IMAGE if settings.image else None,
        )
        self._rate = settings.rate
        self._loop = settings.loop
        self._pose = settings.calibration.pose
        self._last_ns: int | None = None
        self._at = Position()
        self._pace: Timeline | None = None  # on the monotonic clock, so that setting the wall clock halts nothing

    def handle(self, topic: str, message: Message) -> None:
        raise AssertionError("the input node subscribes to none")

    def work(self) -> None:
        if isinstance(self._source, LiveSource):
            self._pass_on(self._source)
        else:
            self._play(self._source)

    def _pass_on(self, source: LiveSource) -> None:
        """Pass a camera's skeletons on as they come."""
        with closing(source.frames()) as frames:
            for frame in frames:
                if self.stopping:
                    return
                if frame:
                    if self.timeline is None:
                        now = self.clock.now_ns()
                        # a topic may replay what was captured long ago
                        wall_ns = frame.stamp_ns if abs(now - frame.stamp_ns) < LEAP_NS else now
                        self.timeline = Timeline(frame.stamp_ns, wall_ns, 1.0)
                        self.report()
                    try:
                        self.publish(POSE_RAW, self._with_pose(frame))
                    except ValueError as error:  # more bodies than a message holds
                        self.refuse(POSE_RAW, error)
                self.report_if_due()

    def _play(self, source: RecordedSource) -> None:
        began = Position(*self._relay.begun.mark) if self._relay and self._relay.begun else Position()
        last: PoseRaw | None = None
        for played, due_ns in _with_due(self._messages(source, began.loops_ns)):
            self._at, topic, message = played
            last = message if isinstance(message, PoseRaw) else last
            if self._at <= began:
                continue  # the node that was here before has published it, and it was taken
            if message.stamp_ns != self._last_ns:
                self._wait_for(message.stamp_ns, due_ns)
            if self.stopping:
                return
            try:
                self.publish(topic, self._with_pose(message))
            except ValueError as error:  # a message that was recorded, and still cannot be sent
                self.refuse(topic, error)
            self.settle()
            self.report_if_due()
        if last and not self.stopping:
            self.publish(POSE_RAW, end_of(last))
        while not self.settle(POLL_S):  # what was not taken is here alone
            if self.stopping:
                return
            self.report_if_due()
        if self._relay:
            self._relay.forget()

    def mark(self, message: Message) -> tuple[int, int]:
        return self._at

    def problems(self) -> list[Problem]:
        return self._source.problems() if isinstance(self._source, LiveSource) else []

    def _tell_pace(self) -> None:
        """Say in wall time, which may have been set since, which stamp is played when."""
        if self._pace:
            set_ns = self.clock.now_ns() - self.clock.monotonic_ns()
            self.timeline = dataclasses.replace(self._pace, wall_ns=self._pace.wall_ns + set_ns)

    def status(self) -> dict[str, str]:
        self._tell_pace()
        refused = {f"refused.{cause}": str(n) for cause, n in self._source.refused.items() if n}
        camera = self._source.status() if isinstance(self._source, LiveSource) else {}
        return camera | refused | (self.timeline.values() if self.timeline else {})

    def _with_pose(self, message: Message) -> Message:
        """The message with the calibrated pose of its camera, unless it has one of its own."""
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
        """Wait until a frame is due; where the source's clock was set, go on from now.

        Args:
            stamp_ns: its own.
            due_stamp_ns: that of the moment at which it is due.
        """
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if not self._rate:
            return
        if self._pace is None or last_ns is None or abs(stamp_ns - last_ns) > LEAP_NS:
            self._pace = Timeline(stamp_ns, self.clock.monotonic_ns(), self._rate)
            self._tell_pace()
            self.report()
        due_ns = self._pace.wall(due_stamp_ns)
        while (left_ns := due_ns - self.clock.monotonic_ns()) > 0 and not self.stopping:
            self.clock.sleep(min(left_ns, round(POLL_S * 1e9)))
            self.report_if_due()


def _with_due(messages: Iterable[_Played]) -> Iterator[tuple[_Played, int]]:
    """Messages, each with the stamp of the moment at which it is due: its own, but where that is ahead of the next one
    by mistake, the next one's."""
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
