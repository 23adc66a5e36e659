"""The queue of a node: messages received and not yet processed."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import zmq

from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, Message

READ_AHEAD = 64
"""messages a node takes off a socket before it works on one"""


class Inbox:
    """Messages received and not yet processed.

    With several subscribers, as for the kiosks of a server, each has a queue of its own, and they take turns: one that
    floods the node loses only its own messages.

    Args:
        subscribers: where it comes from.
        limit: frames to keep of each, beyond which the oldest goes; None loses nothing and leaves the rest to the
            sender.
    """

    def __init__(self, subscribers: Sequence[Subscriber], limit: int | None) -> None:
        self._queues = deque(_Queue(subscriber, limit) for subscriber in subscribers)
        self._poller = zmq.Poller()
        if len(subscribers) > 1:
            for subscriber in subscribers:
                self._poller.register(subscriber.socket, zmq.POLLIN)

    @property
    def overrun(self) -> int:
        """Frames dropped because this node was late."""
        return sum(queue.overrun for queue in self._queues)

    def __len__(self) -> int:
        return sum(len(queue.waiting) for queue in self._queues)

    def next(self, timeout_s: float) -> tuple[str, Message] | None:
        """The oldest message of the queue whose turn it is, or None if none comes in time."""
        if len(self._queues) == 1:
            self._queues[0].fill(timeout_s)
        else:
            for queue in self._queues:
                queue.fill(0)
            if not len(self) and self._poller.poll(round(timeout_s * 1000)):
                for queue in self._queues:
                    queue.fill(0)
        for _ in range(len(self._queues)):
            queue = self._queues[0]
            self._queues.rotate(-1)
            if queue.waiting:
                return queue.waiting.popleft()
        return None


class _Queue:
    """What came from one subscriber."""

    def __init__(self, subscriber: Subscriber, limit: int | None) -> None:
        self.overrun = 0
        self.waiting: deque[tuple[str, Message]] = deque()
        self._subscriber = subscriber
        self._limit = limit

    def fill(self, timeout_s: float) -> None:
        for _ in range(READ_AHEAD):
            if self._limit is None and len(self.waiting) >= READ_AHEAD:
                break
            received = self._subscriber.receive(0 if self.waiting else timeout_s)
            if received is None:
                break
            self.waiting.append(received)
            if self._limit is not None and len(self.waiting) > self._limit:
                self._drop_oldest_frame()

    def _drop_oldest_frame(self) -> None:
        for index, (_, message) in enumerate(self.waiting):
            if not isinstance(message, Diagnostics) and not message.end_of_stream:
                del self.waiting[index]
                self.overrun += 1
                return
