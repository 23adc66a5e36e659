"""What a node does that falls behind: a queue that drops the oldest frames, and a limit to the number of bodies."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import zmq

from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import Clock

READ_AHEAD = 64
"""messages a node takes off a socket before it works on one"""
LONGEST = 512
"""messages of one publisher that wait, at most, whatever number of streams it has"""
LOOK_S = 0.5
"""after which a subscriber is asked though nothing has come: it mends its connections meanwhile"""
DEADLINE_NS = 50_000_000
"""that a frame may wait for a node, and be older than the newest of its stream; then it is that one's turn. Two nodes
have such a queue, so this bounds how old a published pose is under load. Such gaps are bridged"""


class Inbox:
    """Messages received and not yet processed.

    Who can drop frames works on the newest first: once the oldest has waited too long, all but the newest go. Frames
    that came late, as those of a camera that stopped for a moment, are not late for that: they have not waited here.

    With several subscribers, as for the clients of a server, each has a queue of its own, and they take turns: one that
    floods the node loses only its own messages.

    Args:
        subscribers: where it comes from.
        limit: frames to keep of each stream, beyond which its oldest goes; None loses nothing and leaves the rest to
            the sender.
        clock: of the node.
    """

    def __init__(self, subscribers: Sequence[Subscriber], limit: int | None, clock: Clock) -> None:
        self._queues = deque(_Queue(subscriber, limit, clock) for subscriber in subscribers)
        self._clock = clock
        self._poller = zmq.Poller()
        if len(subscribers) > 1:
            for subscriber in subscribers:
                self._poller.register(subscriber.socket, zmq.POLLIN)

    def dropped_of(self, message: Message) -> bool:
        """Whether frames of a message's stream were dropped since this was last asked of it."""
        source = _source(message)
        dropped = [queue.sources for queue in self._queues if source in queue.sources]
        for sources in dropped:
            sources.discard(source)
        return bool(dropped)

    @property
    def sources(self) -> frozenset[str]:
        """Of which frames were dropped and none has been worked on since."""
        return frozenset(source for queue in self._queues for source in queue.sources)

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
            self._fill(0)
            if not len(self):
                self._fill(timeout_s)
        for _ in range(len(self._queues)):
            queue = self._queues[0]
            self._queues.rotate(-1)
            if queue.waiting:
                received = queue.waiting.popleft()
                return received.topic, received.message
        return None

    def _fill(self, timeout_s: float) -> None:
        """Take what has come: to ask every subscriber would cost more than a message does."""
        ready = dict(self._poller.poll(round(timeout_s * 1000)))
        now_ns = self._clock.monotonic_ns()
        for queue in self._queues:
            if queue.socket in ready or now_ns - queue.filled_ns > LOOK_S * 1e9:
                queue.fill(0)
            else:
                queue.empty_ns = now_ns


class _Received(NamedTuple):
    topic: str
    message: Message
    since_ns: int
    """it came after this, by the clock that never steps"""


class _Queue:
    """What came from one subscriber."""

    def __init__(self, subscriber: Subscriber, limit: int | None, clock: Clock) -> None:
        self.overrun = 0
        self.sources: set[str] = set()
        self.waiting: deque[_Received] = deque()
        self.socket = subscriber.socket
        self._subscriber = subscriber
        self._limit = limit
        self._clock = clock
        self.empty_ns = self.filled_ns = clock.monotonic_ns()
        """when the socket was last seen without a message, and when the subscriber was last asked"""

    def fill(self, timeout_s: float) -> None:
        since_ns, self.filled_ns = self.empty_ns, self._clock.monotonic_ns()
        for _ in range(READ_AHEAD):
            if self._limit is None and len(self.waiting) >= READ_AHEAD:
                break
            received = self._subscriber.receive(0, taken=False)
            if received is None:
                if not self.waiting and timeout_s > 0:
                    received = self._subscriber.receive(timeout_s, taken=False)
                self.empty_ns = self._clock.monotonic_ns()
                if received is None:
                    break
                since_ns = self.empty_ns
            self.waiting.append(_Received(*received, since_ns))
            if self._limit is not None and _is_frame(received[1]):
                self._make_room(self.waiting[-1], self._limit)

    def _make_room(self, newest: _Received, limit: int) -> None:
        """Drop the frames before the newest of a stream, if the oldest of them is late; else that one, if more than
        the limit wait."""
        before = [
            frame
            for frame in self.waiting
            if frame.topic == newest.topic
            and frame is not newest
            and _is_frame(frame.message)
            and _source(frame.message) == _source(newest.message)
        ]
        if before:
            waited_ns = self._clock.monotonic_ns() - before[0].since_ns
            late = min(waited_ns, newest.message.stamp_ns - before[0].message.stamp_ns) > DEADLINE_NS
            if late or len(before) >= limit:
                self._drop(before if late else before[:1])
        elif len(self.waiting) > LONGEST:
            self._drop([next(frame for frame in self.waiting if _is_frame(frame.message))])

    def _drop(self, frames: list[_Received]) -> None:
        dropped = {id(frame) for frame in frames}
        self.waiting = deque(frame for frame in self.waiting if id(frame) not in dropped)
        self.overrun += len(frames)
        self.sources.update(_source(frame.message) for frame in frames)


def _is_frame(message: Message) -> bool:
    return not isinstance(message, Diagnostics) and not message.end_of_stream


def _source(message: Message) -> str:
    return "" if isinstance(message, Diagnostics) else message.source


LOOK_NS = 500_000_000
"""between two decisions"""
CALM_NS = 2_000_000_000
"""without a dropped frame, before more bodies are tried"""
SPARE = 0.65
"""of the time that work may take with more bodies"""
MARGIN = 0.05
"""Share of the time below `SPARE` from which on one more body is tried: messages take time, too, whoever is in them."""
FEW = 0.05
"""Share of the frames that may be dropped without bodies being left out: of one stream none in half a second."""
BUSY = 0.5
"""Share of the time that bodies take from which on fewer of them help: else it is other work that made frames late."""


class BodyLimit:
    """Lowers the number of bodies while frames are dropped for being late, and raises it again where there is time.

    Args:
        most: bodies, however much time there is.
        clock: of the node.
    """

    def __init__(self, most: int, clock: Clock) -> None:
        self.bodies = self._most = most
        """that there is time for"""
        self._clock = clock
        self._looked_ns = self._late_ns = clock.monotonic_ns()
        self._worked = self._dropped_before = 0
        self._spent_ns = 0
        self._present = 1
        self._settling = False

    def note(self, present: int, spent_ns: int, dropped: int) -> None:
        """A frame was worked on.

        Args:
            present: bodies in it that were worked on.
            spent_ns: how long it took.
            dropped: frames dropped so far for being late.
        """
        self._worked += 1
        self._spent_ns += spent_ns
        self._present = max(present, 1)
        now = self._clock.monotonic_ns()
        if now - self._looked_ns < LOOK_NS:
            return
        in_time = self._worked / (self._worked + dropped - self._dropped_before)
        busy, self._dropped_before = self._spent_ns / (now - self._looked_ns), dropped
        late = in_time < 1.0 - FEW and busy > BUSY
        if late and not self._settling:
            in_time = max(in_time, 0.5)
            self.bodies = max(1, min(self._present - 1, int(self._present * in_time)))
        elif now - self._late_ns > CALM_NS:  # what is worked on shows what more would take, at most
            more = max(int(self._present * SPARE / max(busy, 0.01)), self._present + (busy < SPARE - MARGIN))
            self.bodies = min(max(self.bodies, more), self._most)
        self._late_ns = now if late else self._late_ns
        self._settling = late and not self._settling  # what waits is of before
        self._looked_ns, self._worked, self._spent_ns = now, 0, 0
