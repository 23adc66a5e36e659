"""A node's self-measurements for `diagnostics`: rates, latency, queue length, dropped and refused messages."""

import resource
import sys
from collections import Counter, deque
from collections.abc import Mapping, Sequence

import numpy as np

from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.checks.problem import Problem, as_values, error
from steadypose.nodes.graph.clock import FRAME_NS, Clock
from steadypose.nodes.graph.topology import NODES

REPORT_NS = 1_000_000_000  # interval between reports, nanoseconds
STALL_NS = 2_000_000_000  # time of input without output after which a node counts as stalled, nanoseconds
SAMPLES = 1000  # number of latencies and compute times kept for the percentiles; half a minute at 30 Hz


class Health:
    """The measurements of one node."""

    def __init__(self, clock: Clock) -> None:
        self.state = "starting"
        """a few words, also ``waiting for prior``; reported as ``stalled`` if frames come in and none go out"""
        self.unread = ""
        """names the reliable subscribers that do not read; replaces the state ``running``"""
        self.counts: Counter[str] = Counter()
        """messages that the node itself refused or dropped, by cause"""
        self.published: Counter[str] = Counter()
        """messages by topic, with those of this node's predecessor if it resumes"""
        self.received: Counter[str] = Counter()
        self.ended: set[str] = set()
        """topics whose end of stream was received"""
        self.stamp_ns = 0
        """capture stamp of the newest frame, nanoseconds"""
        self.queue = 0
        """greatest queue length since the last report"""
        self._clock = clock
        self._received_ns = 0
        self._unanswered_ns: int | None = None  # time of the first input since the last output
        self._latency_ns: deque[int] = deque(maxlen=SAMPLES)
        self.compute_ns: deque[int] = deque(maxlen=SAMPLES)
        """compute times of the newest frames, without the time that their publication waited for subscribers"""
        self._first_and_last_ns: dict[str, tuple[int, int]] = {}
        self._inherited: Counter[str] = Counter()
        self._published_before: Counter[str] = Counter()
        self._rates: dict[str, float] = {}
        self._lost_before = 0
        self._reported_at = self._rated_at = clock.monotonic_ns()

    @property
    def due(self) -> bool:
        return self._clock.monotonic_ns() - self._reported_at >= REPORT_NS

    def go_on_from(self, published: Mapping[str, int]) -> None:
        """Continue counting from what this node's predecessor had published."""
        self._inherited = Counter(published)
        self.published.update(published)
        self._published_before.update(published)

    def note_received(self, topic: str) -> None:
        """Record that processing of a frame starts."""
        self.received[topic] += 1
        self._received_ns = self._clock.monotonic_ns()
        if self._unanswered_ns is None:
            self._unanswered_ns = self._received_ns

    def stall(self, node: str) -> list[Problem]:
        """The problem of a node that receives frames and publishes none."""
        now = self._clock.monotonic_ns()
        if NODES[node].stream is None or self._unanswered_ns is None or now - self._received_ns > STALL_NS:
            return []
        if (silent_ns := now - self._unanswered_ns) <= STALL_NS:
            return []
        remedy = "see which are refused, and which node this one waits for"
        return [error("no_output", f"frames come in, but none went out for {silent_ns / 1e9:.0f} s: {remedy}")]

    def note_published(self, topic: str, at_ns: int, latency_ns: int | None) -> None:
        """Record a message published at a monotonic time, and its latency beyond the intended delay, nanoseconds."""
        self.published[topic] += 1
        if topic != DIAGNOSTICS:
            self._unanswered_ns = None
        self._first_and_last_ns[topic] = self._first_and_last_ns.get(topic, (at_ns, at_ns))[0], at_ns
        if latency_ns is not None:
            self._latency_ns.append(latency_ns)

    def report(
        self, node: str, received: Counter[str], status: Mapping[str, str], problems: Sequence[Problem] = ()
    ) -> Diagnostics:
        """The current `diagnostics`. The worst problem sets the level and the message.

        ``received`` counts messages dropped or refused before the node processed them, by cause; ``status`` are the
        node's own entries.
        """
        self._reported_at = self._clock.monotonic_ns()
        self._measure_rates()
        counts = self.counts + received
        refused_by_node = sum(int(n) for key, n in status.items() if key.startswith(("refused.", "dropped.")))
        lost = counts.total() + refused_by_node
        newly_lost, self._lost_before = lost - self._lost_before, lost
        worst = max(problems, key=lambda problem: problem.level, default=None)
        stalled = any(problem.cause == "no_output" for problem in problems)
        state = self.unread or "stalled" if self.state == "running" and (self.unread or stalled) else self.state
        values = {"state": state, "ended": " ".join(sorted(self.ended)), "queue": str(self.queue)}
        self.queue = 0
        values |= {f"count.{topic}": str(n) for topic, n in self.published.items()}
        values |= {f"in.{topic}": str(n) for topic, n in self.received.items()}
        values |= {f"rate.{topic}": f"{rate:.2f}" for topic, rate in self._rates.items()}
        own = self.published - self._inherited
        values |= {
            f"mean_rate.{topic}": f"{(own[topic] - 1) * 1e9 / (last - first):.2f}"
            for topic, (first, last) in self._first_and_last_ns.items()
            if last - first > FRAME_NS  # messages of one moment have no rate
        }
        values |= _percentiles("latency_ms", self._latency_ns) | _percentiles("compute_ms", self.compute_ns)
        values |= {key: str(n) for key, n in sorted(counts.items())}
        values |= {"memory_mb": f"{resident_bytes() / 1e6:.1f}"} | dict(status) | as_values(problems)
        rates = ", ".join(f"{topic} {rate:.1f} Hz" for topic, rate in self._rates.items())
        return Diagnostics(
            stamp_ns=self.stamp_ns,
            node=node,
            level=worst.level if worst else Level.WARN if newly_lost else Level.OK,
            message=worst.text if worst else f"{newly_lost} dropped or refused" if newly_lost else rates or self.state,
            values=values,
        )

    def _measure_rates(self) -> None:
        now = self._clock.monotonic_ns()
        elapsed = now - self._rated_at
        # an extra report, as at the end of a stream, covers too short a time to measure a rate
        if elapsed < REPORT_NS // 2 and self._rates:
            return
        new = self.published - self._published_before
        self._rates = {topic: new[topic] * 1e9 / max(elapsed, 1) for topic in self.published}
        self._published_before, self._rated_at = self.published.copy(), now


def _percentiles(name: str, samples: deque[int]) -> dict[str, str]:
    if not samples:
        return {}
    values = np.percentile(np.array(samples) / 1e6, (50, 95, 99))
    return {f"{name}.p{p}": f"{value:.3f}" for p, value in zip((50, 95, 99), values, strict=True)}


def resident_bytes() -> int:
    """Resident memory of this process, bytes. On systems without ``/proc`` it is the peak so far."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
