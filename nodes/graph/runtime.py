"""What every node is: a process that takes messages, gives messages, and says once a second how it is doing.

**When a node falls behind.** A recording can wait: with ``lossless`` a full node holds up the one before it, back to
the source, so that every frame arrives and a replay repeats. A camera cannot: otherwise a node keeps the newest
frames, drops the oldest and counts them. Recorders lose nothing either way.

**Order of start.** With ``lossless``, a node opens its publisher, waits until those that must hear it listen, and
only then listens itself. So a stream starts when the whole way to its end is open, whatever the order in which the
processes came up, and its first frame is not lost; and it halts while a node on the way is started again.

**Latency.** Stamps are of capture, and in a replay long past. The input node says in its diagnostics which stamp
it plays at which time (`Timeline`); with that, every node knows how late it is. Stamps are never touched.

**Bad input.** What cannot be used is counted by its cause and reported; it stops nothing.
"""

from __future__ import annotations

import logging
import math
import os
import resource
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import Diagnostics, Level, Message
from steadypose.nodes.graph.launch import LISTENS, Launch

if TYPE_CHECKING:
    from typing_extensions import Self

logger = logging.getLogger(__name__)

FRAME_NS = 1_000_000_000 / 30
"""of the grid the models run on"""
REPORT_NS = 1_000_000_000
TURN_S = 0.1
"""the longest a node waits for anything before it looks whether it should stop"""
SAMPLES = 1000
"""latencies and compute times kept for the percentiles: half a minute at 30 Hz"""
READ_AHEAD = 64
"""messages a node takes off its socket before it works on one"""
SUPERVISOR = "STEADYPOSE_SUPERVISOR"
"""environment: the process that started this node; without it, the node stops"""


class Clock(Protocol):
    """Time for nodes; tests pass one of their own that does not wait."""

    def now_ns(self) -> int:
        """Wall time, nanoseconds since 1970; never steps back."""
        ...

    def sleep(self, duration_ns: int) -> None: ...


class SystemClock:
    """The wall clock as it was at the start, carried on by the monotonic clock, so that it never steps."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        return self._offset_ns + time.monotonic_ns()

    def sleep(self, duration_ns: int) -> None:
        time.sleep(max(duration_ns, 0) / 1e9)


@dataclass(frozen=True)
class Timeline:
    """When, on the wall clock, a moment of capture is played: a live source's stamps are its wall times."""

    stamp_ns: int
    wall_ns: int
    rate: float
    """times real time, above 0"""

    def wall(self, stamp_ns: int) -> int:
        """Nanoseconds of wall time at which ``stamp_ns`` is due."""
        return self.wall_ns + round((stamp_ns - self.stamp_ns) / self.rate)

    def values(self) -> dict[str, str]:
        """As the input node's diagnostics carry it."""
        return {
            "timeline.stamp_ns": str(self.stamp_ns),
            "timeline.wall_ns": str(self.wall_ns),
            "timeline.rate": repr(self.rate),
        }

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> Self | None:
        """From diagnostics, or None if they carry none that can be."""
        try:
            stamp_ns, wall_ns = int(values["timeline.stamp_ns"]), int(values["timeline.wall_ns"])
            rate = float(values["timeline.rate"])
        except (KeyError, ValueError):
            return None
        return cls(stamp_ns, wall_ns, rate) if 0 < rate < math.inf else None


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


class Node(ABC):
    """A node of the graph. A subclass says what it does with a message; all else is here.

    Made in one thread, it may run in another; `stop` may be called from anywhere.
    """

    name: ClassVar[str]

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        self.launch = launch
        self.clock: Clock = clock or SystemClock()
        self.timeline: Timeline | None = None
        self.counts: Counter[str] = Counter()
        """refused and dropped, by cause"""
        self._stopping = False
        self._state = "starting"
        self._required = launch.listeners(self.name)
        self._ended: set[str] = set()
        self._published: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._rates: dict[str, float] = {}
        self._span_ns: dict[str, tuple[int, int]] = {}
        self._latency_ns: deque[int] = deque(maxlen=SAMPLES)
        self._compute_ns: deque[int] = deque(maxlen=SAMPLES)
        self._blocked_ns = 0
        self._queue = 0
        self._stamp_ns = 0
        self._troubles = 0
        self._reported_at = self._rated_at = self.clock.now_ns()
        self._supervisor = int(os.environ.get(SUPERVISOR, 0))

    @abstractmethod
    def handle(self, topic: str, message: Message) -> None:
        """Work on one message. What it raises is counted and logged, and the next message comes."""

    def status(self) -> dict[str, str]:
        """What this node has to say in `diagnostics` beyond what every node says."""
        return {}

    @property
    def queue_limit(self) -> int | None:
        """Frames kept when this node falls behind; None: it loses nothing."""
        return None if self.launch.transport.lossless else self.launch.transport.queue

    @property
    def behind(self) -> bool:
        """Whether frames wait that will be dropped if this node does not catch up."""
        return self.queue_limit is not None and self._inbox is not None and len(self._inbox) > 0

    def stop(self) -> None:
        """Ask the node to end; `run` returns within `TURN_S` and what the message at hand takes."""
        self._stopping = True

    @property
    def stopping(self) -> bool:
        return self._stopping

    def run(self) -> None:
        """Work until stopped.

        Raises:
            TransportError: an address cannot be bound.
            LaunchError: keys are asked for and cannot be used.
        """
        transport = self.launch.transport
        keys = transport.curve_keys()
        transport.ipc_directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with ExitStack() as stack:
            self._publisher = stack.enter_context(
                Publisher(transport.endpoint(self.name), keys=keys, lossless=transport.lossless)
            )
            self._inbox: Inbox | None = None
            self._await_listeners()
            listens = LISTENS[self.name]
            if listens:
                self._subscriber = stack.enter_context(
                    Subscriber(
                        [address for node in listens for address in self.launch.addresses(node)],
                        sorted({topic for topics in listens.values() for topic in topics}),
                        keys=keys,
                        name=self.name,
                    )
                )
                self._inbox = Inbox(self._subscriber, self.queue_limit)
            self._state = "running"
            self.report()
            self.work()
            self._state = "stopped"
            self.report()

    def work(self) -> None:
        """Take messages until stopped."""
        while not self._stopping:
            self.take_next(TURN_S)
            self.report_if_due()

    def take_next(self, timeout_s: float) -> bool:
        """Work on the next message; False if none came in ``timeout_s``."""
        assert self._inbox is not None, "a node that listens to none has no messages to take"
        received = self._inbox.next(timeout_s)
        if received is None:
            return False
        self._queue = max(self._queue, len(self._inbox))
        topic, message = received
        if isinstance(message, Diagnostics):
            # of several kiosks each has its own
            if message.node == "pose_input" and not self.launch.server.kiosks:
                self.timeline = Timeline.from_values(message.values)
        else:
            self._stamp_ns = message.stamp_ns
        started, self._blocked_ns = self.clock.now_ns(), 0
        try:
            self.handle(topic, message)
        except Exception as error:
            self.refuse(topic, error)
        if not isinstance(message, Diagnostics):
            self._compute_ns.append(self.clock.now_ns() - started - self._blocked_ns)
            if message.end_of_stream:
                self.note_end(topic)
        return True

    def refuse(self, topic: str, error: Exception) -> None:
        """Count a message that could not be worked on, and log the first of its kind."""
        cause = f"refused.{type(error).__name__}"
        if cause not in self.counts:
            logger.error("%s: a message of %s failed; more are only counted", self.name, topic, exc_info=error)
        self.counts[cause] += 1

    def publish(self, topic: str, message: Message, *, delay_ns: int = 0) -> bool:
        """Publish a message; if the launch is lossless, as soon as all who must hear it have room.

        Args:
            delay_ns: how much of its age is meant; latency is what goes beyond.

        Returns:
            False if the node was stopped while it waited.
        """
        asked = self.clock.now_ns()
        self._await_listeners()
        while not self._publisher.publish(topic, message, timeout_s=TURN_S):
            if self._stopping:
                self.counts[f"dropped.stopped {topic}"] += 1
                return False
            self.report_if_due()
        now = self.clock.now_ns()
        self._blocked_ns += now - asked
        self._published[topic] += 1
        self._span_ns[topic] = self._span_ns.get(topic, (now, now))[0], now
        if not isinstance(message, Diagnostics):
            self._stamp_ns = message.stamp_ns
            if message.end_of_stream:
                self.note_end(topic)
            elif self.timeline:
                self._latency_ns.append(now - self.timeline.wall(message.stamp_ns) - delay_ns)
        return True

    def note_end(self, topic: str) -> None:
        """A stream has ended; whoever waits for that should not have to wait a second."""
        self._ended.add(topic)
        self.report()

    def report_if_due(self) -> None:
        if self.clock.now_ns() - self._reported_at >= REPORT_NS:
            self.report()

    def report(self) -> None:
        """Publish `diagnostics` now."""
        if self._supervisor and os.getppid() != self._supervisor:
            logger.error("%s: the process that started this node is gone; stopping", self.name)
            self._stopping = True
        self._reported_at = self.clock.now_ns()
        diagnostics = self.diagnostics()
        # a listener without room for news of this second can have those of the next
        self._publisher.publish(DIAGNOSTICS, diagnostics, timeout_s=0)

    def diagnostics(self) -> Diagnostics:
        """How this node is doing."""
        self._measure_rates()
        counts = self.counts.copy()
        if self._inbox is not None:
            counts["dropped.late"] += self._inbox.overrun
            counts.update({f"dropped.lost {topic}": n for topic, n in self._subscriber.dropped.items()})
            counts.update({f"refused.{cause}": n for cause, n in self._subscriber.refused.items()})
        status = self.status()
        troubles = counts.total() + sum(int(n) for key, n in status.items() if key.startswith(("refused.", "dropped.")))
        news, self._troubles = troubles - self._troubles, troubles
        values = {"state": self._state, "ended": " ".join(sorted(self._ended)), "queue": str(self._queue)}
        self._queue = 0
        values |= {f"count.{topic}": str(n) for topic, n in self._published.items()}
        values |= {f"rate.{topic}": f"{rate:.2f}" for topic, rate in self._rates.items()}
        values |= {
            f"mean_rate.{topic}": f"{(self._published[topic] - 1) * 1e9 / max(last - first, 1):.2f}"
            for topic, (first, last) in self._span_ns.items()
        }
        values |= _percentiles("latency_ms", self._latency_ns) | _percentiles("compute_ms", self._compute_ns)
        values |= {key: str(n) for key, n in sorted(counts.items()) if n}
        values |= {"memory_mb": f"{resident_bytes() / 1e6:.1f}"} | status
        rates = ", ".join(f"{topic} {rate:.1f} Hz" for topic, rate in self._rates.items())
        return Diagnostics(
            stamp_ns=self._stamp_ns,
            node=self.name,
            level=Level.WARN if news else Level.OK,
            message=f"{news} dropped or refused" if news else rates or self._state,
            values=values,
        )

    def _measure_rates(self) -> None:
        now = self.clock.now_ns()
        elapsed = now - self._rated_at
        # a report out of turn, as at the end of a stream, sees too little time for a rate
        if elapsed < REPORT_NS // 2 and self._rates:
            return
        new = self._published - self._reported
        self._rates = {topic: new[topic] * 1e9 / max(elapsed, 1) for topic in self._published}
        self._reported, self._rated_at = self._published.copy(), now

    def _await_listeners(self) -> None:
        """Wait until all who must hear this node listen, or it is stopped."""
        if self._required <= self._publisher.listeners:
            return
        missing = ", ".join(sorted(self._required - self._publisher.listeners))
        logger.info("%s: waiting for %s", self.name, missing)
        state, self._state = self._state, f"waiting for {missing}"
        self.report()
        while not self._stopping and not self._publisher.wait_for_listeners(self._required, timeout_s=TURN_S):
            self.report_if_due()
        self._state = state


def _percentiles(name: str, samples: deque[int]) -> dict[str, str]:
    if not samples:
        return {}
    values = np.percentile(np.array(samples) / 1e6, (50, 95, 99))
    return {f"{name}.p{p}": f"{value:.3f}" for p, value in zip((50, 95, 99), values, strict=True)}


def resident_bytes() -> int:
    """Memory this process holds now; where the system does not say, the most it ever held."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
