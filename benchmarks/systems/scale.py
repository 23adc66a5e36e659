"""Throughput: streams per core of a server, and hours of recordings cleaned per hour.

A server's clients are copies of one recorded body. Each has its own clock and is captured at another time of the frame
period. Times are the thread's processor time, which other processes do not lengthen.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.benchmarks.bench import Bench, numpy_ms
from steadypose.benchmarks.provenance import WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.systems.latency import (
    LATENCIES,
    LATEST_MS,
    RECORDING,
    WARM_UP,
    WARM_UP_S,
    crowd,
    percentiles,
    recorded,
)
from steadypose.benchmarks.systems.running import START_S, Running, running_nodes
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.timing.rate import FPS
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = WORLD

CLIENTS = (1, 4, 8, 16)
LIVE_CLIENTS = (1, 4, 8, 16, 32)
NETWORK_NS = 3_000_000  # network latency of a message, nanoseconds
LAST_S = 1.0  # time after the messages that count in which they may be answered, seconds
PERIOD_MS = FRAME_NS / 1e6


def serve(frames: list[PoseRaw], clients: int, periods: int, track: Callable[..., Iterable[int]]) -> dict[str, Any]:
    """Measure the milliseconds per 30 Hz period, of ``periods``, that the prior and the trajectories of these clients
    take.
    """
    prior = StreamBatch(PriorSettings(max_bodies=clients), clients)
    trajectories = [TrajectoryPipeline(TrajectorySettings()) for _ in range(clients)]
    names = [f"client {k}" for k in range(clients)]
    spent: dict[str, list[float]] = {"prior": [], "trajectory": []}
    answers = 0
    for period, raw in zip(track(range(periods + WARM_UP), description=f"{clients} clients"), crowd(frames, 1)):  # noqa: B905
        cost = {"prior": 0.0, "trajectory": 0.0}
        for k, name in enumerate(names):
            captured_ns = raw.stamp_ns + round(k * FRAME_NS / clients)
            # hours apart, as clocks that were never set
            message = dataclasses.replace(raw, source=name, stamp_ns=captured_ns + k * 3_600_000_000_000)
            started = time.thread_time()
            cleaned = prior.process_at(message, captured_ns + NETWORK_NS)
            between = time.thread_time()
            for clean in cleaned:
                answers += bool(clean.bodies)
                trajectories[names.index(clean.source)].process(clean)
            cost["prior"] += (between - started) * 1e3
            cost["trajectory"] += (time.thread_time() - between) * 1e3
        if period >= WARM_UP:
            for node, samples in spent.items():
                samples.append(cost[node])
    return {
        "clients": clients,
        "periods": periods,
        "answered": answers / (clients * (periods + WARM_UP)),
        "refused": {cause: n for cause, n in prior.counters.items() if n},
        **{f"{node}_ms": percentiles(samples) for node, samples in spent.items()},
    }


def serve_live(frames: list[PoseRaw], clients: int, seconds: float) -> dict[str, Any]:
    """Measure milliseconds from capture to arrival of ``pose/world``, minus the delay, of a server's nodes, and losses.

    The clients are publishers in this process, one body each, at 30 Hz, captured one after the other within the period.
    """
    names = [f"client {k}" for k in range(clients)]
    stream = crowd(frames, 1)
    delay_ns = PriorSettings().delay * FRAME_NS
    late_ms: list[float] = []
    sent = answered = 0
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="steadypose-"))
        publishers = [stack.enter_context(Publisher(f"ipc://{folder}/{k}")) for k in range(clients)]
        settings = [
            f"server.clients={json.dumps([publisher.endpoint for publisher in publishers])}",
            f"prior.max_bodies={clients}",
            "transport.lossless=false",
        ]
        nodes = stack.enter_context(running_nodes(["prior", "trajectory"], settings))
        for publisher in publishers:
            if not publisher.wait_for_subscribers({"prior"}, timeout_s=START_S):
                raise RuntimeError(f"expected the prior within {START_S:g} s, and it did not come")
        began_ns = nodes.clock.now_ns()
        counted = range(round(WARM_UP_S * FPS), round((WARM_UP_S + seconds) * FPS))
        # between two clients' stamps
        first_ns, end_ns = (began_ns + (k - 0.5 / clients) * FRAME_NS for k in (counted.start, counted.stop))
        for period in range(counted.stop + round(LAST_S * FPS)):
            raw = next(stream)
            for k, publisher in enumerate(publishers):
                stamp_ns = began_ns + round((period + k / clients) * FRAME_NS)
                for topic, message in _received(nodes, stamp_ns):
                    if topic == POSE_WORLD and first_ns <= message.stamp_ns < end_ns:
                        late_ms.append((nodes.clock.now_ns() - message.stamp_ns - delay_ns) / 1e6)
                        answered += bool(getattr(message, "bodies", ()))
                if nodes.clock.now_ns() - stamp_ns < FRAME_NS:  # otherwise this process is too slow to be a client
                    publisher.publish(POSE_RAW, dataclasses.replace(raw, source=names[k], stamp_ns=stamp_ns))
                    sent += first_ns <= stamp_ns < end_ns
    return {"clients": clients, "sent": sent, "answered": answered, "latency_ms": percentiles(late_ms or [np.nan])}


def _received(nodes: Running, until_ns: int) -> Iterator[tuple[str, Message]]:
    """Yield what the nodes publish until a time, and at least what is there already."""
    while received := nodes.subscriber.receive(max(until_ns - nodes.clock.now_ns(), 0) / 1e9):
        yield received


def clean_rate(recording: Path) -> dict[str, float]:
    """Return the seconds of a recorded stream that one core cleans in a second."""
    with tempfile.TemporaryDirectory() as folder:
        settings: dict[str, dict[str, Any]] = {"prior": {}, "trajectory": {}}
        started = time.process_time()
        done = clean_recording(recording, Path(folder) / "out", settings)
        spent = time.process_time() - started
    return {"stream_s": round(done.duration_s, 2), "cpu_s": round(spent, 2), "rate": round(done.duration_s / spent, 2)}


def run(bench: Bench) -> Result:
    periods = round((2.0 if bench.quick else 10.0) * 30)
    frames = recorded()[:600]
    served = [serve(frames, clients, periods, bench.progress.track) for clients in CLIENTS]
    lived = [serve_live(frames, clients, periods / 30) for clients in LIVE_CLIENTS]
    cleaned = clean_rate(RECORDING)
    numpy = round(numpy_ms(), 3)
    data = {"served": served, "live": lived, "cleaned": cleaned, "streams_a_core": _streams_a_core(served)}
    return Result([_table(served, cleaned, numpy), _live_table(lived)], data | {"numpy_ms": numpy})


def _streams_a_core(served: list[dict[str, Any]]) -> dict[str, int]:
    """Return the largest measured number of clients that a node serves on one core: 99 of 100 periods end in time."""

    return {
        node: max((s["clients"] for s in served if s[f"{node}_ms"]["p99"] < PERIOD_MS), default=0)
        for node in ("prior", "trajectory")
    }


def _live_table(lived: list[dict[str, Any]]) -> Table:
    clients = [
        {
            **r,
            "share": 100 * r["answered"] / r["sent"],
            "timely": "yes" if r["latency_ms"]["p99"] <= LATEST_MS else "no",
        }
        for r in lived
    ]
    return Table.of(
        "scale_live", "A server's clients, from capture to pose/world at 30 Hz, less the delay, ms", clients,
        {"clients": "{clients}", **LATENCIES, "answered, %": "{share:.0f}", "in time": "{timely}"},
        "One body a client. Answered: a client's messages that came back with its body. "
        f"In time: a p99 of {LATEST_MS:g} ms, for what is answered.",
    )  # fmt: skip


def _table(served: list[dict[str, Any]], cleaned: dict[str, float], numpy: float) -> Table:
    most = _streams_a_core(served)
    periods = [
        {**s, "share": s["prior_ms"]["p50"] / s["clients"], "ratio": s["prior_ms"]["p50"] / s["clients"] / numpy}
        for s in served
    ]
    return Table.of(
        "scale", "A server's processor time a period of 33.3 ms, ms", periods,
        {"clients": "{clients}", "prior, p50": "{prior_ms[p50]:.1f}",
         "prior, p99": "{prior_ms[p99]:.1f}", "a client": "{share:.2f}", "of numpy's": "{ratio:.2f}",
         "trajectory, p50": "{trajectory_ms[p50]:.1f}", "p99": "{trajectory_ms[p99]:.1f}"},
        "One body a client. In time 99 of 100 periods, on a core: "
        f"{most['prior']} clients for the prior, and {most['trajectory']} for the trajectory, which is not batched. "
        f"`clean` does {cleaned['rate']:.1f} s of a stream of one body a second and core. A client's is also given in "
        f"units of 30 steps of a Kalman filter of 44 states in numpy, {numpy:.2f} ms here: what machines differ by.",
    )  # fmt: skip
