"""The recorder: topics into a rosbag2 directory."""

from __future__ import annotations

from pathlib import Path

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.launch import Launch, LaunchError
from steadypose.nodes.graph.runtime import Clock, Node

QUIET_S = 0.3
"""nothing came for so long: all that was on its way is here"""


class Filing:
    """Under which stamps messages are filed, so that a recording plays in the order in which it came.

    That is the stamp of capture, or where a topic's stamps went back, the highest before.
    """

    def __init__(self) -> None:
        self._highest_ns: dict[str, int] = {}

    def stamp(self, topic: str, stamp_ns: int) -> int:
        """Where the topic's next message belongs, whose own stamp is ``stamp_ns``."""
        self._highest_ns[topic] = max(stamp_ns, self._highest_ns.get(topic, 0))
        return self._highest_ns[topic]


class RecorderNode(Node):
    """Writes what is published, loses nothing, and completes the recording when it is stopped."""

    name = "recorder"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        if not launch.recorder.directory:
            raise LaunchError("[recorder] directory: expected the recording to make, got none; give --record")
        self._directory = Path(launch.recorder.directory)
        self._topics = frozenset(launch.recorder.topics)
        self._filing = Filing()
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
        # a node that has not seen a pose yet reports at no time
        self._write(topic, message, message.stamp_ns or self._pose_ns or 0)

    def _write(self, topic: str, message: Message, stamp_ns: int) -> None:
        self._writer.write(topic, message, self._filing.stamp(topic, stamp_ns))
        self._written += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._written), "recording": str(self._directory)}
