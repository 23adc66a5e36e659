"""What a connection to ROS 2's topics can do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Publish = Callable[[bytes], None]
"""a message, as CDR"""
DEPTH = 10
"""messages held for a subscriber that is late"""


class Connection(Protocol):
    """A node in a ROS domain. Not thread-safe."""

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        """A reliable publisher of messages on a topic.

        Args:
            topic: such as ``tf``; without a leading slash.
            kind: such as ``tf2_msgs/msg/TFMessage``.
            latched: whether late subscribers get the last message (TRANSIENT_LOCAL).

        Raises:
            LaunchError: the type is not available.
        """
        ...

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        """Call ``heard`` with each message of a topic from `spin`; publishers may be reliable or best-effort."""
        ...

    def spin(self, timeout_s: float) -> None:
        """Wait for messages, for so long at most, and pass them to their callbacks."""
        ...

    def drop(self, publish: Publish) -> None:
        """Publish there no more."""
        ...

    def close(self) -> None: ...
