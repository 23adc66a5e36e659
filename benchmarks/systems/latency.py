"""Latency: computing time per frame, time from capture to ``pose/world``, and frames dropped.

The input is a recorded stream at exactly 30 Hz, played forwards and backwards so that nobody jumps. A crowd is copies
of its body, side by side. Computing time is measured in this process, pinned to one core, with one thread. The rest is
measured from outside: this process subscribes to the node processes and notes when each message arrives.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from steadypose.benchmarks.bench import Bench, numpy_ms
from steadypose.benchmarks.provenance import ROOT, WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.systems.running import START_S, running
from steadypose.msgs.recording import RecordingReader, RecordingWriter
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.types import Diagnostics, PoseRaw, RawBody
from steadypose.nodes.graph.clock import FRAME_NS, Timeline
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = WORLD

RECORDING = ROOT / "sim_data" / "walk_turn"
CROWDS = (1, 4, 8)
LIVE_CROWDS = (1, 2, 4, 8, 16, 32)
LATENCIES = {"p50": "{latency_ms[p50]:.1f}", "p95": "{latency_ms[p95]:.1f}", "p99": "{latency_ms[p99]:.1f}",
             "longest": "{latency_ms[max]:.1f}"}  # fmt: skip
"""Columns of a table of latencies."""
LATEST_MS = 150.0
"""Largest 99th percentile of the latency of a pose of the newest frame, milliseconds, whatever the load."""
SPACING = 0.8  # distance between the copies of a body, metres
WARM_UP, WARM_UP_S = 60, 5.0
"""Frames, and seconds of live nodes, before times count. The first ones load code and fill the window."""


def crowd(frames: list[PoseRaw], bodies: int) -> Iterator[PoseRaw]:
    """Yield an endless stream at exactly 30 Hz of copies of a recording's first body, side by side."""
    seen = [frame for frame in frames if frame.bodies]
    if len(seen) < 2:
        raise ValueError(f"expected a recording with at least 2 frames that show a body, got {len(seen)}")
    beside = np.linspace(-0.5, 0.5, bodies) * SPACING * (bodies - 1)
    for index, frame in enumerate(cycle([*seen, *seen[-2:0:-1]])):
        body = frame.bodies[0]
        copies = [RawBody(i, body.positions + np.array([x, 0, 0]), body.confidence) for i, x in enumerate(beside)]
        yield dataclasses.replace(frame, stamp_ns=seen[0].stamp_ns + round(index * FRAME_NS), bodies=copies)


def compute(frames: list[PoseRaw], bodies: int, count: int, track: Callable[..., Iterable[int]]) -> dict[str, Any]:
    """Measure milliseconds per frame of the prior, and of the trajectory on its output: wall time and processor
    time."""
    prior, trajectory = PriorPipeline(PriorSettings()), TrajectoryPipeline(TrajectorySettings())
    spent: dict[str, list[tuple[float, float]]] = {"prior": [], "trajectory": []}
    stream = crowd(frames, bodies)
    with _one_core():
        for index in track(range(count + WARM_UP), description=f"compute, {bodies} bodies"):
            raw = next(stream)
            times = [_now()]
            cleaned = prior.process(raw)
            times.append(_now())
            for clean in cleaned:
                trajectory.process(clean)
            times.append(_now())
            if index >= WARM_UP:
                for name, start, end in zip(spent, times, times[1:], strict=False):
                    spent[name].append((end[0] - start[0], end[1] - start[1]))
    refused = prior.counters + trajectory.counters
    return {
        "bodies": bodies,
        "frames": count,
        "refused": dict(refused),
        **{
            f"{name}_{clock}_ms": percentiles(np.array(samples)[:, column] * 1e3)
            for name, samples in spent.items()
            for column, clock in enumerate(("wall", "cpu"))
        },
    }


def live(recording: Path, seconds: float, bench: Bench, title: str) -> dict[str, Any]:
    """Measure milliseconds from capture to arrival of ``pose/world``, minus the delay, in nodes that drop late
    frames."""
    delay_ns = PriorSettings().delay * FRAME_NS
    timeline: Timeline | None = None
    late_ms: list[float] = []
    news: dict[str, Diagnostics] = {}
    sent_from = -1
    bar = bench.progress.add_task(title, total=seconds)
    bodies: list[int] = []
    most = f"prior.max_bodies={max(LIVE_CROWDS)}"
    with running(recording, most) as (messages, _, _, clock, _):
        for topic, message in messages:
            now = clock.now_ns()
            if isinstance(message, Diagnostics):
                news[message.node] = message
                if message.node == "pose_input":
                    timeline = Timeline.from_values(message.values) or timeline
            elif topic == POSE_WORLD and timeline and message.stamp_ns > timeline.stamp_ns + WARM_UP_S * 1e9:
                sent_from = message.stamp_ns if sent_from < 0 else sent_from
                bodies.append(len(getattr(message, "bodies", ())))
                late_ms.append((now - timeline.wall(message.stamp_ns) - delay_ns) / 1e6)
                bench.progress.update(bar, completed=(message.stamp_ns - sent_from) / 1e9)
                if message.stamp_ns - sent_from >= seconds * 1e9:
                    expected = round((message.stamp_ns - sent_from) / FRAME_NS) + 1
                    break
        else:
            raise RuntimeError(f"{title}: expected pose/world for {seconds:g} s, got {len(late_ms)} messages")
    dropped: Counter[str] = Counter()
    for node, latest in news.items():
        dropped.update(
            {f"{node} {k}": int(n) for k, n in latest.values.items() if k.startswith(("dropped.", "refused."))}
        )
    return {
        "seconds": seconds,
        "expected": expected,
        "arrived": len(late_ms),
        "counted": dict(dropped),
        "bodies_answered": round(float(np.mean(bodies)), 2),
        "latency_ms": percentiles(late_ms),
    }


@contextmanager
def _one_core() -> Iterator[None]:
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.thread_time()


def percentiles(values: ArrayLike) -> dict[str, float]:
    """Return p50, p95, p99 and the maximum."""
    values = np.asarray(values, dtype=np.float64)
    figures = dict(zip(("p50", "p95", "p99"), np.percentile(values, (50, 95, 99)).tolist(), strict=True))
    return {name: round(value, 3) for name, value in (figures | {"max": float(values.max())}).items()}


def run(bench: Bench) -> Result:
    seconds = 10.0 if bench.quick else 60.0
    frames = recorded()
    with tempfile.TemporaryDirectory() as folder:
        computed = [compute(frames, bodies, round(seconds * 30), bench.progress.track) for bodies in CROWDS]
        lived = []
        for bodies in LIVE_CROWDS:
            path = Path(folder) / f"crowd_{bodies}"
            with RecordingWriter(path) as writer:
                # frames played while the nodes start are not counted
                for raw in islice(crowd(frames, bodies), round((seconds + WARM_UP_S + START_S) * 30)):
                    writer.write(POSE_RAW, raw, raw.stamp_ns)
            lived.append({"bodies": bodies} | live(path, seconds, bench, f"live, {bodies} bodies"))
    numpy = round(numpy_ms(), 3)
    return Result(
        [_compute_table(computed, numpy), _live_table(lived)], {"compute": computed, "live": lived, "numpy_ms": numpy}
    )


def recorded() -> list[PoseRaw]:
    with RecordingReader(RECORDING) as reader:
        return [message for _, _, message in reader.messages([POSE_RAW]) if isinstance(message, PoseRaw)]


def _compute_table(results: list[dict[str, Any]], numpy: float) -> Table:
    cells = {"bodies": "{bodies}"} | {
        f"{clock.replace('_', ', ')}, {p}": f"{{{clock}_ms[{p}]:.2f}}"
        for clock in ("prior_wall", "prior_cpu", "trajectory_wall")
        for p in ("p50", "p99")
    }
    return Table.of(
        "compute", "Compute a frame on one core, ms",
        [{**r, "ratio": r["prior_cpu_ms"]["p50"] / numpy} for r in results],
        {**cells, "prior, cpu, p50, of numpy's": "{ratio:.1f}"},
        f"{results[0]['frames']} frames; cpu: the thread's processor time, which other processes do not lengthen. "
        f"numpy's: 30 steps of a Kalman filter of 44 states in numpy, {numpy:.2f} ms here; what machines differ by.",
    )  # fmt: skip


def carried(results: list[dict[str, Any]]) -> int:
    """Return the largest number of bodies that are all processed in 99 of 100 frames; 0 if not even one is."""
    in_full = (
        r["bodies"] for r in results if r["bodies_answered"] * r["arrived"] >= 0.99 * r["bodies"] * r["expected"]
    )
    return max(in_full, default=0)


def _live_table(results: list[dict[str, Any]]) -> Table:
    answers = [
        {**r, "dropped": r["expected"] - r["arrived"], "timely": "yes" if r["latency_ms"]["p99"] <= LATEST_MS else "no"}
        for r in results
    ]
    return Table.of(
        "live", "From capture to pose/world at 30 Hz, less the delay, ms, against the number of bodies", answers,
        {"bodies": "{bodies}", **LATENCIES, "frames": "{expected}", "dropped": "{dropped}",
         "bodies answered": "{bodies_answered:.1f}", "in time": "{timely}"},
        "Three node processes and this subscriber, live transport. Where there is no time for all, the bodies "
        "farthest from the sensor are left out, and then frames, the newest of which are worked on first: in time is a "
        f"p99 of {LATEST_MS:g} ms. This machine carries "
        f"{carried(results)} bodies, all answered in 99 of 100 frames.",
    )  # fmt: skip
