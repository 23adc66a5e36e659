"""The recorder: topics into a rosbag2 directory."""

from __future__ import annotations

from pathlib import Path

from msgs.recording import RecordingWriter
from msgs.topics import DIAGNOSTICS
from msgs.types import Diagnostics, Message
from nodes.launch import Launch, LaunchError
from nodes.runtime import Clock, Node

QUIET_S = 0.3
"""nothing came for so long: all that was on its way is here"""


class RecorderNode(Node):
    """Writes what is published, loses nothing, and completes the recording when it is stopped.

    A message is found under its stamp of capture, or where stamps went back, under the highest before: so a
    recording plays in the order in which it came.
    """

    name = "recorder"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        if not launch.recorder.directory:
            raise LaunchError("[recorder] directory: expected the recording to make, got none; give --record")
        self._directory = Path(launch.recorder.directory)
        self._topics = frozenset(launch.recorder.topics)
        self._filed_ns: dict[str, int] = {}
        self._early: list[Diagnostics] = []
        self._pose_ns: int | None = None
        self._written = 0

    @property
    def queue_limit(self) -> int | None:
        return None

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
            self._early.append(message)
            return
        if not isinstance(message, Diagnostics):
            self._pose_ns = message.stamp_ns
        early, self._early = self._early, []
        for diagnostics in early:
            self._write(DIAGNOSTICS, diagnostics, message.stamp_ns)
        self._write(topic, message, max(message.stamp_ns, 0 if topic != DIAGNOSTICS else self._pose_ns or 0))

    def _write(self, topic: str, message: Message, stamp_ns: int) -> None:
        self._filed_ns[topic] = max(stamp_ns, self._filed_ns.get(topic, 0))
        self._writer.write(topic, message, self._filed_ns[topic])
        self._written += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._written), "recording": str(self._directory)}
