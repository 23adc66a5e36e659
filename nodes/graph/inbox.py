"""Overload handling of a node: a queue that drops the oldest frames, and a limit on the number of bodies."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import zmq

from steadypose.msgs.subscriber import REVIVE_S
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import Clock

READ_AHEAD = 64  # largest number of messages that a node takes off a socket before it processes one
LONGEST = 512  # largest number of waiting messages of one publisher, over all its streams
DEADLINE_NS = 50_000_000
"""Longest time a frame waits in a node's queue while newer frames of its stream arrive, nanoseconds.

After that, only the newest frame is kept. Two nodes have such a queue, so this bounds the age of a pose under load."""


class Inbox:
    """Messages received and not yet processed.

    With a limit, the queue drops frames when the node falls behind. Once a stream's oldest frame has waited longer than
    the deadline, all but the newest are dropped. Only time spent in this queue counts: a frame that arrives late, for
    example after a camera stalled, is not dropped for that.

    Each subscriber (for example one per client of a server) has its own queue, and the queues take turns. A publisher
    that floods the node loses only its own messages.

    ``limit`` is the largest number of waiting frames per stream; beyond it the oldest is dropped. With None nothing is
    dropped, and the publisher has to wait (back-pressure).
    """

    def __init__(self, subscribers: Sequence[Subscriber], limit: int | None, clock: Clock) -> None:
        self._queues = deque(_Queue(subscriber, limit, clock) for subscriber in subscribers)
        self._clock = clock
        self._poller = zmq.Poller()
        if len(subscribers) > 1:
            for subscriber in subscribers:
                self._poller.register(subscriber.socket, zmq.POLLIN)

    def dropped_of(self, message: Message) -> bool:
        """Whether frames of the message's stream were dropped since the last call for that stream."""
        source = _source(message)
        dropped = [queue.sources for queue in self._queues if source in queue.sources]
        for sources in dropped:
            sources.discard(source)
        return bool(dropped)

    @property
    def sources(self) -> frozenset[str]:
        """Sources whose frames were dropped and of which no frame was processed since."""
        return frozenset(source for queue in self._queues for source in queue.sources)

    @property
    def overrun(self) -> int:
        """Number of frames dropped because this node was late."""
        return sum(queue.overrun for queue in self._queues)

    def __len__(self) -> int:
        return sum(len(queue.waiting) for queue in self._queues)

    def next(self, timeout_s: float) -> tuple[str, Message] | None:
        """The oldest message of the next queue in turn, or None if none arrives within ``timeout_s``."""
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
        """Read the sockets that are ready. Reading every subscriber would cost more than processing a message.

        The others are read at times, because a subscriber repairs its connections while it is read.
        """
        ready = dict(self._poller.poll(round(timeout_s * 1000)))
        now_ns = self._clock.monotonic_ns()
        for queue in self._queues:
            if timeout_s > 0 or queue.socket not in ready:
                queue.empty_ns = now_ns  # nothing had arrived before the wait, which the first arrival ends
            if queue.socket in ready or now_ns - queue.filled_ns > REVIVE_S * 1e9:
                queue.fill(0)


class _Received(NamedTuple):
    topic: str
    message: Message
    since_ns: int  # lower bound of its arrival time, monotonic clock, nanoseconds


class _Queue:
    """The waiting messages of one subscriber."""

    def __init__(self, subscriber: Subscriber, limit: int | None, clock: Clock) -> None:
        self.overrun = 0
        self.sources: set[str] = set()
        self.waiting: deque[_Received] = deque()
        self.socket = subscriber.socket
        self._subscriber = subscriber
        self._limit = limit
        self._clock = clock
        self.empty_ns = self.filled_ns = clock.monotonic_ns()
        """monotonic times at which the socket was last found empty, and the subscriber last read, nanoseconds"""

    def fill(self, timeout_s: float) -> None:
        since_ns, self.filled_ns = self.empty_ns, self._clock.monotonic_ns()
        for _ in range(READ_AHEAD):
            if self._limit is None and len(self.waiting) >= READ_AHEAD:
                break
            received = self._subscriber.receive(0, taken=False)
            if received is None and self._subscriber.pending:
                continue  # it was refused or too old; fresh ones may be behind it
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
        """Drop all of the stream's older frames if the oldest is late, or only the oldest if the queue is full."""
        stream = newest.topic, _source(newest.message)
        before = [
            frame
            for frame in self.waiting
            if frame is not newest and _is_frame(frame.message) and (frame.topic, _source(frame.message)) == stream
        ]
        if before:
            waited_ns = self._clock.monotonic_ns() - before[0].since_ns
            late = min(waited_ns, newest.message.stamp_ns - before[0].message.stamp_ns) > DEADLINE_NS
            if late or len(before) >= limit:
                self._drop(before if late else before[:1])
        if len(self.waiting) > LONGEST:
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


LOOK_NS = 500_000_000  # interval between decisions, nanoseconds
CALM_NS = 2_000_000_000  # time without dropped frames before the limit is raised, nanoseconds
SPARE = 0.65  # largest predicted load (compute time per elapsed time) with more bodies, ratio
MARGIN = 0.05
"""Margin of the load below `SPARE` at which one more body is tried, ratio. A message has a cost besides its bodies."""
FEW = 0.05  # tolerated share of dropped frames, ratio. For one stream this means none in half a second.
BUSY = 0.5  # load above which fewer bodies help, ratio. Below it, other processes made the frames late.


class BodyLimit:
    """Limits the number of bodies: lowers it while frames are dropped, raises it up to ``most`` in spare time."""

    def __init__(self, most: int, clock: Clock) -> None:
        self.bodies = self._most = most
        """current limit"""
        self._clock = clock
        self._looked_ns = self._late_ns = clock.monotonic_ns()
        self._worked = self._dropped_before = 0
        self._spent_ns = 0
        self._present = 1
        self._settling = False

    def note(self, present: int, spent_ns: int, dropped: int) -> None:
        """Record a frame of ``present`` bodies, of ``spent_ns`` compute time, after ``dropped`` late frames."""
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
        elif now - self._late_ns > CALM_NS:  # scaling the present load gives an upper bound of the load of more bodies
            more = max(int(self._present * SPARE / max(busy, 0.01)), self._present + (busy < SPARE - MARGIN))
            self.bodies = min(max(self.bodies, more), self._most)
        self._late_ns = now if late else self._late_ns
        self._settling = late and not self._settling  # frames still in the queue date from before the change
        self._looked_ns, self._worked, self._spent_ns = now, 0, 0
