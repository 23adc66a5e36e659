"""Base class of all nodes: a process that receives and publishes messages, and reports its state once a second.

**Overload.** A recording can wait. With ``lossless``, a node with a full queue applies back-pressure up to the source:
every frame arrives, and a replay is repeatable. A camera cannot wait. Without ``lossless``, a node keeps the newest
frames, drops the oldest and counts them. A node's declared `Delivery` takes precedence over both.

**Order of start.** With ``lossless``, a node opens its publisher, waits until its reliable subscribers are connected,
and only then subscribes. A stream therefore starts once the whole chain is connected, in whatever order the processes
started, and its first frame is not lost. The stream pauses while a node restarts. The restarted node receives again the
messages that its predecessor had not acknowledged (`relay`).

**Latency.** Stamps are capture times; in a replay they lie in the past. The input node publishes in its diagnostics
which stamp it plays at which wall time (`Timeline`), and every node computes its latency from that. No node changes
stamps.

**Bad input.** Unusable input is counted by cause and reported. It never stops a node.
"""

import logging
import math
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from typing import ClassVar

from steadypose.msgs.delivery import DEAF_S, Principals
from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.checks.problem import Problem, check_wire, error
from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.clock import POLL_S, Clock, Timeline
from steadypose.nodes.graph.health import STALL_NS, Health
from steadypose.nodes.graph.inbox import Inbox
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.process import ALIVE, READY, notify
from steadypose.nodes.graph.relay import Relay
from steadypose.nodes.graph.topology import NODES, Delivery

logger = logging.getLogger(__name__)

WAITING = "waiting for"
"""Prefix of the state of a node that waits for its subscribers."""
SUPERVISOR = "STEADYPOSE_SUPERVISOR"
"""Environment variable with the supervisor's process id. The node stops when that process is gone."""
WATCHER = "run"
"""Name under which the supervisor subscribes."""
LAST_WORD_S = 5.0
"""Longest time a finished node waits for the supervisor to subscribe, seconds. A short stream can end before that."""
RUN = "STEADYPOSE_RUN"
"""Name of the environment variable, and of the entry in diagnostics, that identify the node's run."""


def supervisor_id() -> int:
    """Process id of the supervisor that starts and restarts this node; 0 if there is none."""
    return int(os.environ.get(SUPERVISOR, 0))


class Node(ABC):
    """A node of the graph. Subclasses implement `handle`.

    A node may be created in one thread and run in another; `stop` may be called from any thread.
    """

    name: ClassVar[str]
    """the node's name in `topology.NODES`"""
    _lag = 0
    """number of acknowledged messages that a restarted process of this node publishes again"""

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        if extra := NODES[self.name].extra:
            require_extra(extra)
        self.launch = launch
        self.clock = clock or Clock()
        self._timeline: Timeline | None = None
        self._set_ns = 0
        self.health = Health(self.clock)
        self.stopping = False
        """whether the node was asked to stop"""
        self._required = launch.reliable_subscribers(self.name)
        self._blocked_ns = 0
        self._disconnected: Counter[str] = Counter()
        self._deaf: frozenset[str] = frozenset()
        self.inbox = Inbox([], None, self.clock)
        self._subscribers: list[Subscriber] = []
        self._refused_before: dict[str, Counter[str]] = {}
        self._supervisor = supervisor_id()
        self._run = os.environ.get(RUN, "")
        self._relay: Relay | None = None

    @property
    def timeline(self) -> Timeline | None:
        """Mapping of capture stamps to wall time; None until it is known."""
        return self._timeline

    @timeline.setter
    def timeline(self, timeline: Timeline | None) -> None:
        self._timeline = timeline
        self._set_ns = self.clock.now_ns() - self.clock.monotonic_ns()

    def _late_ns(self, timeline: Timeline, stamp_ns: int) -> int:
        """Time since a stamp was due, nanoseconds.

        If the wall clock was set since the timeline became known, it is unknown whether the stamp was taken before or
        after: frames captured before the step still arrive after it. The smaller of the two latencies is returned.
        """
        now_ns = self.clock.now_ns()
        set_by_ns = now_ns - self.clock.monotonic_ns() - self._set_ns
        late_ns = now_ns - timeline.wall(stamp_ns)
        return min(late_ns, late_ns - set_by_ns, key=abs)

    @abstractmethod
    def handle(self, topic: str, message: Message) -> None:
        """Process one message. An exception is counted and logged, and the node goes on with the next message."""

    def status(self) -> dict[str, str]:
        """This node's own entries in `diagnostics`, besides those of every node."""
        return {}

    def problems(self) -> list[Problem]:
        """Problems with this node's stream since the last call."""
        return []

    def mark(self, message: Message) -> tuple[int, int]:
        """What a restarted node needs to know of the last published and acknowledged message: stamp, end of stream."""
        return message.stamp_ns, int(not isinstance(message, Diagnostics) and message.end_of_stream)

    @property
    def queue_limit(self) -> int | None:
        """Largest number of frames kept when this node falls behind; None if it must not lose any."""
        transport = self.launch.transport
        delivery = NODES[self.name].delivery
        reliable = transport.lossless if delivery is Delivery.AS_LAUNCHED else delivery is Delivery.RELIABLE
        return None if reliable else transport.queue

    @property
    def behind(self) -> bool:
        """Whether frames are waiting that may be dropped if this node does not catch up."""
        return self.queue_limit is not None and len(self.inbox) > 0

    def stop(self) -> None:
        """Ask the node to stop. `run` returns within `POLL_S` plus the processing time of the current message."""
        self.stopping = True

    def run(self) -> None:
        """Run the node until it is stopped. Raises TransportError if an address or the keys cannot be used."""
        transport = self.launch.transport
        keys = transport.curve_keys()
        folder, declared = transport.make_ipc_directory(), NODES[self.name]
        if not declared.subscribes or (transport.lossless and declared.delivery is not Delivery.BEST_EFFORT):
            self._relay = Relay(folder / f"{self.name}.progress", declared.publishes, self._supervisor, self._lag)
        access = {"keys": keys, "clear_text": transport.clear_text}
        with ExitStack() as stack:
            resume = self._relay.resume if self._relay else None
            publisher = Publisher(transport.endpoint(self.name), reliable=self._required, resume=resume, **access)
            self._publisher = stack.enter_context(publisher)
            if self._relay:
                self._relay.begin(publisher)
            if resume:
                self.health.go_on_from(resume.sequence)
            self._await_subscribers()
            if declared.subscribes:
                waits = self.queue_limit is None
                options = access | {
                    "reliable": transport.lossless and waits,
                    "context": self._relay.context if self._relay else 0,
                    "lifespan_s": math.inf if waits else transport.lifespan_s,
                    "name": self.name,
                    "principals": Principals(),
                }
                for addresses in self._addresses():
                    subscriber = Subscriber(addresses, sorted(declared.topics), **options)
                    self._subscribers.append(stack.enter_context(subscriber))
                self.inbox = Inbox(self._subscribers, self.queue_limit, self.clock)
            self.health.state = "running"
            self.report()
            notify(READY)
            self.work()
            if self._supervisor and not self.stopping:
                self._publisher.wait_for_subscribers({WATCHER}, timeout_s=LAST_WORD_S)
            self.health.state = "stopped"
            self.report()

    def _addresses(self) -> Iterator[list[str]]:
        """Publishers' addresses, one list per subscriber. Each client has its own, so that none starves another.

        A node that wants only diagnostics of the input, for its timeline, does not hear clients: each has another
        timeline.
        """
        nodes, clients = NODES[self.name].subscribes, self.launch.server.clients
        if {*nodes.get("pose_input", ())} - {DIAGNOSTICS}:
            yield from ([address] for address in clients)
        others = [address for node in nodes for address in self.launch.addresses(node) if address not in clients]
        if others:
            yield others

    def work(self) -> None:
        while not self.stopping:
            self.take_next(POLL_S)
            self.report_if_due()

    def take_next(self, timeout_s: float) -> bool:
        """Process the next message; returns False if none arrives within ``timeout_s``."""
        received = self.inbox.next(timeout_s)
        if received is None:
            self.settle()
            return False
        self.health.queue = max(self.health.queue, len(self.inbox))
        topic, message = received
        if isinstance(message, Diagnostics):
            # several clients have different timelines
            if message.node == "pose_input" and not self.launch.server.clients:
                self.timeline = Timeline.from_values(message.values)
        else:
            self.health.stamp_ns = message.stamp_ns
            self.health.note_received(topic)
        started, self._blocked_ns = self.clock.monotonic_ns(), 0
        try:
            self.handle(topic, message)
        except Exception as error:
            self.refuse(topic, error)
        if not isinstance(message, Diagnostics):
            self.health.compute_ns.append(self.clock.monotonic_ns() - started - self._blocked_ns)
            if self._relay:
                self._relay.handled()
                # includes the messages that this node's predecessor handled, each once
                self.health.received[topic] = self._subscribers[0].arrived(topic)
            if message.end_of_stream:
                self.note_end(topic)
        self.settle()  # immediately: a message not acknowledged before a crash is delivered again
        return True

    def settle(self, timeout_s: float = 0.0) -> bool:
        """Acknowledge answered messages to their publishers. Returns whether all own messages were acknowledged."""
        if self._relay is None:
            return True
        answered = self._relay.settle(self._publisher, timeout_s)
        if answered and self.queue_limit is None:
            self._subscribers[0].take(answered)
        return self._relay.settled

    def refuse(self, topic: str, error: Exception) -> None:
        """Count a message that could not be processed, and log the first of its kind."""
        cause = f"refused.{type(error).__name__}"
        if cause not in self.health.counts:
            logger.error("%s: a message on %s failed; any more are only counted", self.name, topic, exc_info=error)
        self.health.counts[cause] += 1

    def publish(self, topic: str, message: Message, *, delay_ns: int = 0) -> bool:
        """Publish a message. In a lossless launch, wait until all reliable subscribers have room.

        Latency is measured beyond ``delay_ns``, the pipeline's intended delay, nanoseconds of stream time. Returns
        False if the node was stopped while it waited.
        """
        if self._relay and self._subscribers and self._relay.knows(topic, message):
            return True
        asked_ns = self.clock.monotonic_ns()
        self._await_subscribers()
        while not self._publisher.publish(topic, message, timeout_s=POLL_S):
            if self.stopping:
                self.health.counts[f"dropped.stopped {topic}"] += 1
                return False
            if self.health.state == "running" and self.clock.monotonic_ns() - asked_ns > STALL_NS:
                waited_for = self._publisher.deliveries.waited_for(topic)
                self.health.state = f"{WAITING} {', '.join(sorted(waited_for))} to go on"
            self.report_if_due()
        if self.health.state.startswith(WAITING):
            self.health.state = "running"
        now = self.clock.monotonic_ns()
        self._blocked_ns += now - asked_ns
        of_frame = not isinstance(message, Diagnostics) and not message.end_of_stream
        latency_ns = None
        if of_frame and self.timeline:  # the delay is in stream time, which may run faster than real time
            latency_ns = self._late_ns(self.timeline, message.stamp_ns) - round(delay_ns / self.timeline.rate)
        self.health.note_published(topic, now, latency_ns)
        if self._relay:
            self._relay.published(self._publisher, topic, self.mark(message))
        if not isinstance(message, Diagnostics):
            self.health.stamp_ns = message.stamp_ns
            if message.end_of_stream:
                self.note_end(topic)
        return True

    def note_end(self, topic: str) -> None:
        """Report the end of a stream at once, not only with the next second's diagnostics."""
        self.health.ended.add(topic)
        self.report()

    def report_if_due(self) -> None:
        if self.health.due:
            self.report()

    def report(self) -> None:
        if self._supervisor and os.getppid() != self._supervisor:
            logger.error("%s: the process that started this node is gone; stopping", self.name)
            self.stopping = True
        notify(ALIVE)
        self._publisher.check()
        if self._relay and self._subscribers:
            self._subscribers[0].take(0)  # a sign of life: a node that waits in `publish` must not count as deaf
        self._disconnected, self._deaf = self._publisher.refused, self._publisher.deliveries.silent(DEAF_S)
        unread = self._publisher.deliveries.silent(STALL_NS / 1e9)
        self.health.unread = f"{WAITING} {', '.join(sorted(unread))} to read" if unread else ""
        # a subscriber whose queue is full misses this report and gets the next one
        self._publisher.publish(DIAGNOSTICS, self.diagnostics(), timeout_s=0)

    def diagnostics(self) -> Diagnostics:
        received = Counter({f"refused.{cause}": n for cause, n in self._disconnected.items()})
        received["dropped.late"] = self.inbox.overrun
        for subscriber in self._subscribers:
            received.update({f"dropped.lost {topic}": n for topic, n in subscriber.dropped.items()})
            received.update({f"dropped.expired {topic}": n for topic, n in subscriber.late.items()})
            received.update({f"refused.{cause}": n for cause, n in subscriber.refused.items()})
        problems = [*self._wire_problems(), *self._deaf_problems(), *self.problems(), *self.health.stall(self.name)]
        run = {RUN: self._run} if self._run else {}
        return self.health.report(self.name, received, self.status() | run, problems)

    def _deaf_problems(self) -> Iterator[Problem]:
        if self._deaf:
            text = f"{', '.join(sorted(self._deaf))} has not read for {DEAF_S:g} s, and is not waited for any more"
            yield error("deaf", f"{text}: restart it or, if it is a second subscriber of that name, rename it")

    def _wire_problems(self) -> Iterator[Problem]:
        """Problems with refused frames since the last call."""
        refused = {subscriber.addresses: subscriber.refused.copy() for subscriber in self._subscribers}
        before, self._refused_before = self._refused_before, refused
        return check_wire({at: counts - before.get(at, Counter()) for at, counts in refused.items()})

    def _await_subscribers(self) -> None:
        """Wait until all reliable subscribers are connected, or the node is stopped."""
        if self._required <= self._publisher.subscribers:
            return
        missing = ", ".join(sorted(self._required - self._publisher.subscribers))
        logger.info("%s: waiting for %s", self.name, missing)
        state, self.health.state = self.health.state, f"{WAITING} {missing}"
        self.report()
        while not self.stopping and not self._publisher.wait_for_subscribers(self._required, timeout_s=POLL_S):
            self.report_if_due()
        self.health.state = state
