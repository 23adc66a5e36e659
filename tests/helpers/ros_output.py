"""An output of the bridge's topics that keeps what is sent."""

from typing import Any

from steadypose.nodes.ros2.definitions import deserialise


class Kept:
    """What is sent, in order."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str, bytes, bool]] = []
        self.dropped: list[str] = []

    def send(self, topic: str, kind: str, cdr: bytes, *, latched: bool = False) -> None:
        self.sent.append((topic, kind, cdr, latched))

    def drop(self, topic: str) -> None:
        self.dropped.append(topic)

    def of(self, topic: str) -> list[Any]:
        return [deserialise(cdr, kind) for name, kind, cdr, _ in self.sent if name == topic]
