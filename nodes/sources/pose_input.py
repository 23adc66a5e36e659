"""The input node: gives the skeletons of a source at the pace they were captured, at another, or as they are taken."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Protocol

from steadypose.msgs.keys import Keys
from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import POSE_RAW, POSE_TRUTH
from steadypose.msgs.types import Diagnostics, Message, PoseRaw
from steadypose.nodes.graph.launch import InputSettings, Launch, LaunchError
from steadypose.nodes.graph.runtime import TURN_S, Clock, Node, Timeline
from steadypose.nodes.sources.camera import LiveSource
from steadypose.nodes.sources.csv import CsvSource
from steadypose.nodes.sources.npz import NpzSource

LEAP_NS = 15_000_000_000
"""a step of stamps, either way, that is no pause but another clock: it is not waited for"""
LOOP_PAUSE_NS = 1_000_000_000
"""between the end of a stream and its start over; long enough for every stage to let go of its bodies"""


class Source(Protocol):
    """Skeletons in the order they came, each with its topic: ``pose/raw``, and ``pose/truth`` where it is known."""

    refused: Counter[str]
    """what could not be read, by cause"""

    def __iter__(self) -> Iterator[tuple[str, Message]]: ...


class RecordingSource:
    """The skeletons of a recording, without the mark of its end.

    Raises:
        RecordingError: there is no recording, or no ``pose/raw`` in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with RecordingReader(path) as recording:
            if not recording.count(POSE_RAW):
                raise RecordingError(
                    f"{path}: expected messages on {POSE_RAW}, got {', '.join(recording.topics)}; record that topic too"
                )
            self.refused: Counter[str] = Counter({"bytes of a truncated recording": recording.lost_bytes})
            self._frames = recording.count(POSE_RAW)

    def __len__(self) -> int:
        return self._frames

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        with RecordingReader(self.path) as recording:
            try:
                for topic, _, message in recording.messages([POSE_RAW, POSE_TRUTH]):
                    if not isinstance(message, Diagnostics) and not message.end_of_stream:
                        yield topic, message
            except RecordingError:
                self.refused["damaged recording"] += 1
            self.refused.update({f"undecodable {topic}": n for topic, n in recording.refused.items()})


def open_source(path: str | Path) -> RecordingSource | NpzSource | CsvSource:
    """The recording at ``path``: a rosbag2 directory, an ``.mcap``, an ``.npz`` or a ``.csv``.

    Raises:
        LaunchError: there is nothing at the path.
        RecordingError, NpzError, CsvError: what is there holds no skeletons. All are ValueErrors that say what to do.
    """
    if not str(path):
        raise LaunchError("[input] recording: expected a recording, .npz or .csv to play, got none; give --input")
    path = Path(path)
    if not path.exists():
        raise LaunchError(f"{path} does not exist: expected a rosbag2 directory, an .mcap, an .npz or a .csv")
    return {".npz": NpzSource, ".csv": CsvSource}.get(path.suffix, RecordingSource)(path)


def open_input(settings: InputSettings, clock: Clock, keys: Keys | None = None) -> Source | LiveSource:
    """What ``[input]`` names: a recording, or a camera, which is looked for when its frames are asked for.

    Args:
        settings: of the launch.
        clock: of the node.
        keys: for cameras on other machines.

    Raises:
        LaunchError, RecordingError, NpzError, CsvError: a setting, or the recording, cannot be used.
    """
    if settings.source == "recording":
        return open_source(settings.recording)
    # these bring libraries that a replay does without
    if settings.source == "oak":
        from steadypose.nodes.sources.oak import OakSource

        return OakSource(settings.oak, clock)
    if settings.source == "ros2":
        from steadypose.nodes.sources.ros2 import Ros2Source

        return Ros2Source(settings.ros2)
    if settings.source == "merge":
        from steadypose.nodes.sources.merge import MergeSource

        return MergeSource(settings.merge, keys)
    from steadypose.nodes.sources.webcam import WebcamSource

    return WebcamSource(settings.webcam, settings.calibration, clock)


def with_end(messages: Iterable[tuple[str, Message]]) -> Iterator[tuple[str, Message]]:
    """The messages, and after the last the mark that the stream ends there."""
    last: PoseRaw | None = None
    for topic, message in messages:
        yield topic, message
        if isinstance(message, PoseRaw):
            last = message
    if last:
        yield POSE_RAW, dataclasses.replace(last, bodies=[], end_of_stream=True)


class PoseInputNode(Node):
    """Publishes ``pose/raw``, and ``pose/truth`` where the source has it; ends when the source does."""

    name = "pose_input"

    def __init__(self, launch: Launch, clock: Clock | None = None, source: Source | LiveSource | None = None) -> None:
        super().__init__(launch, clock)
        settings = launch.input
        self._source = source or open_input(settings, self.clock, launch.transport.curve_keys())
        self._rate = settings.rate
        self._loop = settings.loop
        self._pose = settings.calibration.pose
        self._last_ns: int | None = None

    def handle(self, topic: str, message: Message) -> None:
        raise AssertionError("the input node listens to none")

    def work(self) -> None:
        if isinstance(self._source, LiveSource):
            self._relay(self._source)
        else:
            self._play(self._source)

    def _relay(self, source: LiveSource) -> None:
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
                        self.publish(POSE_RAW, self._placed(frame))
                    except ValueError as error:  # more bodies than a message holds
                        self.refuse(POSE_RAW, error)
                self.report_if_due()

    def _play(self, source: Source) -> None:
        for topic, message in with_end(self._messages(source)):
            if message.stamp_ns != self._last_ns:
                self._wait_for(message.stamp_ns)
            if self.stopping:
                return
            try:
                self.publish(topic, self._placed(message))
            except ValueError as error:  # a message that was recorded, and still cannot be sent
                self.refuse(topic, error)
            self.report_if_due()

    def status(self) -> dict[str, str]:
        refused = {f"refused.{cause}": str(n) for cause, n in self._source.refused.items() if n}
        camera = self._source.status() if isinstance(self._source, LiveSource) else {}
        return camera | refused | (self.timeline.values() if self.timeline else {})

    def _placed(self, message: Message) -> Message:
        """The message with the pose that its camera was calibrated to, unless it knows its own."""
        if self._pose and isinstance(message, PoseRaw) and not message.calibrated:
            return dataclasses.replace(message, sensor_pose=self._pose, calibrated=True)
        return message

    def _messages(self, source: Source) -> Iterator[tuple[str, Message]]:
        shift_ns = 0
        while True:
            newest_ns = 0
            first_ns: int | None = None
            for topic, message in source:
                first_ns = message.stamp_ns if first_ns is None else first_ns
                newest_ns = max(newest_ns, message.stamp_ns)
                yield topic, dataclasses.replace(message, stamp_ns=message.stamp_ns + shift_ns) if shift_ns else message
            if not self._loop or first_ns is None:
                return
            shift_ns += newest_ns - first_ns + LOOP_PAUSE_NS

    def _wait_for(self, stamp_ns: int) -> None:
        """Wait until a stamp is due; where the source's clock was set, go on from now."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if not self._rate:
            return
        if self.timeline is None or last_ns is None or abs(stamp_ns - last_ns) > LEAP_NS:
            self.timeline = Timeline(stamp_ns, self.clock.now_ns(), self._rate)
            self.report()
        due_ns = self.timeline.wall(stamp_ns)
        while (left_ns := due_ns - self.clock.now_ns()) > 0 and not self.stopping:
            self.clock.sleep(min(left_ns, round(TURN_S * 1e9)))
            self.report_if_due()
