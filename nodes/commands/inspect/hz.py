"""``steadypose hz``: how often messages come."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro

from steadypose.msgs.topics import TOPICS
from steadypose.nodes.commands.inspect.topic import (
    Address,
    Count,
    LaunchFile,
    Topics,
    messages_of,
    receive,
    subscribe,
)

HZ_EVERY_S = 1.0


def hz(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    window: float = 10.0,
    count: Count = None,
    topics: Topics = (),
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> None:
    """Measure how often messages come: of a topic by the time they arrive, of a recording by their stamps.

    Try:
      steadypose hz pose/world
      steadypose hz pose/raw --launch kiosk

    Args:
        target: a topic, such as pose/clean, or a recording.
        window: seconds to look back; a recording is measured as a whole.
        count: stop after so many messages.
        topics: of a recording, this topic alone. May be given again.
        launch: the launch file, or the name of one of the project's own, whose addresses to look at.
        endpoints: the address to look at. May be given again.
    """
    if target not in TOPICS:
        stamps: dict[str, list[float]] = {}
        for topic, message in messages_of(target, topics, launch, endpoints):
            stamps.setdefault(topic, []).append(message.stamp_ns / 1e9)
        for topic, found in stamps.items():
            print(f"{topic}: {Rate.of(found[:count])}")
        return
    with subscribe(target, launch, endpoints) as subscriber:
        arrivals = (time.monotonic() for _ in receive(subscriber, target))
        lost = 0
        for rate in measure(arrivals, window, count):
            missed = subscriber.dropped[target] - lost
            lost = subscriber.dropped[target]
            print(f"{rate}" + (f" lost: {missed}" if missed else ""), flush=True)


@dataclass(frozen=True)
class Rate:
    """How often something came: mean rate in Hz, and the intervals between in seconds."""

    mean_hz: float
    shortest_s: float
    longest_s: float
    deviation_s: float
    count: int
    """things that came"""

    @classmethod
    def of(cls, times: list[float] | deque[float]) -> Rate:
        """Of times in seconds, in the order they came; NaN for fewer than two."""
        steps = np.diff(np.array(times))
        if not len(steps):
            return cls(np.nan, np.nan, np.nan, np.nan, len(times))
        span = float(steps.sum())
        mean = len(steps) / span if span > 0 else np.nan
        return cls(mean, float(steps.min()), float(steps.max()), float(steps.std()), len(times))

    @property
    def brief(self) -> str:
        """In a few words, to follow the number of messages."""
        return f", {self.mean_hz:.2f} Hz, longest gap {self.longest_s * 1e3:.0f} ms" if self.count > 1 else ""

    def __str__(self) -> str:
        return (
            f"average rate: {self.mean_hz:.3f} Hz  min: {self.shortest_s:.4f} s  max: {self.longest_s:.4f} s  "
            f"std dev: {self.deviation_s:.5f} s  window: {self.count}"
        )


def measure(arrivals: Iterator[float], window_s: float, count: int | None = None) -> Iterator[Rate]:
    """The rate over the last ``window_s`` seconds, once a second while something arrives, and at the end.

    Args:
        arrivals: times of arrival in seconds, rising, given as they come.
        window_s: seconds to look back.
        count: arrivals after which to end.
    """
    recent: deque[float] = deque()
    reported_at = None
    for number, now in enumerate(arrivals, start=1):
        recent.append(now)
        while now - recent[0] > window_s:
            recent.popleft()
        reported_at = now if reported_at is None else reported_at
        if number == count:
            break
        if now - reported_at >= HZ_EVERY_S:
            reported_at = now
            yield Rate.of(recent)
    if recent and recent[-1] != reported_at:
        yield Rate.of(recent)
