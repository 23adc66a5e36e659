"""The recorder: topics into a rosbag2 directory."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import DIAGNOSTICS, TOPICS
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError, nearest, path_setting

QUIET_S = 0.3
"""without a message after the stop, until all that was on its way has arrived"""


@dataclass(frozen=True)
class RecorderSettings:
    """``[recorder]``: what is written, where."""

    directory: str = path_setting()
    """the rosbag2 directory to make; a relative path starts at the launch file"""
    topics: list[str] = field(default_factory=lambda: list(TOPICS))

    def __post_init__(self) -> None:
        for topic in self.topics:
            if topic not in TOPICS:
                raise LaunchError(
                    f"[recorder] topics names {topic!r}, which nobody publishes{nearest(topic, TOPICS)}; "
                    f"topics are {', '.join(TOPICS)}"
                )


def check_recorder(launch: Launch) -> None:
    """Raises:
    LaunchError: the recording is there already.
    """
    directory = launch.settings(RecorderSettings).directory
    if Path(directory).exists():
        raise LaunchError(f"{directory} exists: expected a new directory to record to")


class LogTimes:
    """MCAP's log times of messages, such that a recording plays in the order in which it came.

    That is the stamp of capture, or where a topic's stamps went back, the highest before.
    """

    def __init__(self) -> None:
        self._highest_ns: dict[str, int] = {}

    def next(self, topic: str, stamp_ns: int) -> int:
        """Log time, nanoseconds, of the topic's next message, captured at ``stamp_ns``."""
        self._highest_ns[topic] = max(stamp_ns, self._highest_ns.get(topic, 0))
        return self._highest_ns[topic]


class RecorderNode(Node):
    """Writes what is published, loses nothing, and completes the recording when it is stopped."""

    name = "recorder"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        settings = launch.settings(RecorderSettings)
        if not settings.directory:
            raise LaunchError("[recorder] directory: expected the recording to make, got none; give --record")
        self._directory = Path(settings.directory)
        self._topics = frozenset(settings.topics)
        self._log_times = LogTimes()
        self._before_first_pose: list[Diagnostics] = []
        self._pose_ns: int | None = None
        self._written = 0

    def work(self) -> None:
        with RecordingWriter(self._directory) as self._writer:
            super().work()
            while self.take_next(QUIET_S):
                pass

    def handle(self, topic: str, message: Message) -> None:
        if topic not in self._topics:
            return
        if isinstance(message, Diagnostics) and self._pose_ns is None:
            # before the first pose, nobody knows what time it is in the stream
            self._before_first_pose.append(message)
            return
        if not isinstance(message, Diagnostics):
            self._pose_ns = message.stamp_ns
        waiting, self._before_first_pose = self._before_first_pose, []
        for diagnostics in waiting:
            self._write(DIAGNOSTICS, diagnostics, message.stamp_ns)
        # a node that has not seen a pose yet reports at no time
        self._write(topic, message, message.stamp_ns or self._pose_ns or 0)

    def _write(self, topic: str, message: Message, stamp_ns: int) -> None:
        self._writer.write(topic, message, self._log_times.next(topic, stamp_ns))
        self._written += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._written), "recording": str(self._directory)}
