"""The queue of a node: what came and is not yet worked on."""

from __future__ import annotations

from collections import deque

from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, Message

READ_AHEAD = 64
"""messages a node takes off its socket before it works on one"""


class Inbox:
    """What came and is not yet worked on.

    Args:
        subscriber: where it comes from.
        limit: frames to keep, beyond which the oldest goes; None loses nothing and leaves the rest to the sender.
    """

    def __init__(self, subscriber: Subscriber, limit: int | None) -> None:
        self.overrun = 0
        """frames dropped because this node was late"""
        self._subscriber = subscriber
        self._limit = limit
        self._waiting: deque[tuple[str, Message]] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def next(self, timeout_s: float) -> tuple[str, Message] | None:
        """The oldest message kept, or None if none comes in time."""
        for _ in range(READ_AHEAD):
            if self._limit is None and len(self._waiting) >= READ_AHEAD:
                break
            received = self._subscriber.receive(0 if self._waiting else timeout_s)
            if received is None:
                break
            self._waiting.append(received)
            if self._limit is not None and len(self._waiting) > self._limit:
                self._drop_oldest_frame()
        return self._waiting.popleft() if self._waiting else None

    def _drop_oldest_frame(self) -> None:
        for index, (_, message) in enumerate(self._waiting):
            if not isinstance(message, Diagnostics) and not message.end_of_stream:
                del self._waiting[index]
                self.overrun += 1
                return
