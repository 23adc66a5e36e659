"""How long ``pose/world`` is missing at the start and after a node is killed, as a subscriber sees it.

Measured on an idle machine and on one whose processors are all busy.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType

import numpy as np
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.provenance import ROOT, WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.systems.running import START_S, Running, running
from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.transport import Subscriber
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.supervisor import STEADY_S
from steadypose.nodes.graph.topology import POSE_NODES

DEPENDS_ON = WORLD

RECORDING = ROOT / "sim_data" / "walk_turn"
KILLS = 20  # number of times that each node is killed, and that all nodes are started
PAUSE_S = STEADY_S / len(POSE_NODES) + 1.0
"""Time between kills of different nodes, seconds. Each node runs for longer than `STEADY_S`, so none is restarted with
a pause."""
AT_ONCE_S = 0.5
"""Time after a kill within which its gap begins, seconds. A later gap is the pause between two passes of a
recording."""
ALL = "all, started"
FIRST = "all, started for the first time"
FIRST_S = 600.0  # time allowed for compiling the loops, seconds
BUSY = ", processors busy"


@contextmanager
def busy() -> Iterator[None]:
    spin = [sys.executable, "-c", "while True: pass"]
    others = [subprocess.Popen(spin) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def _start(environment: Mapping[str, str] = MappingProxyType({}), limit_s: float = START_S) -> float:
    """Return the seconds from ``steadypose run`` to the first ``pose/world``."""
    with tempfile.TemporaryDirectory(prefix="steadypose-") as folder:
        setting = f"transport.directory={json.dumps(folder)}"
        command = [sys.executable, "-m", "steadypose.nodes.cli", "run", "--input", str(RECORDING), "--set", setting]
        endpoint = Launch.read("replay", [setting]).transport.endpoint("trajectory")
        with Subscriber(endpoint, POSE_WORLD) as subscriber:
            started_s = time.monotonic()
            process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ | environment
            )
            try:
                if subscriber.receive(limit_s) is None:
                    raise RuntimeError(f"expected poses within {limit_s:g} s, got none: {' '.join(command)}")
                return round(time.monotonic() - started_s, 3)
            finally:
                process.terminate()
                process.wait(60)


def restarts(kills: int, progress: Progress) -> dict[str, list[float]]:
    """Return the seconds without ``pose/world`` after each kill of each node."""
    found: dict[str, list[float]] = {name: [] for name in POSE_NODES}
    bar = progress.add_task("kills", total=kills * len(POSE_NODES))
    with running(RECORDING, "input.loop=true") as nodes:
        _arrivals(nodes, STEADY_S)
        for _ in range(kills):
            for name in POSE_NODES:
                os.kill(nodes.supervisor.children[name].pid, signal.SIGKILL)
                killed_s = time.monotonic()
                found[name].append(longest_gap([killed_s, *_arrivals(nodes, PAUSE_S)], AT_ONCE_S))
                progress.advance(bar)
    return found


def _arrivals(nodes: Running, span_s: float) -> list[float]:
    """Return the arrival times of ``pose/world``, monotonic seconds, for ``span_s`` and until one has arrived since."""
    until, arrived = time.monotonic() + span_s, []
    for topic, _ in nodes.messages:
        if topic == POSE_WORLD:
            arrived.append(time.monotonic())
            if arrived[-1] > until:
                return arrived
    raise RuntimeError(f"expected poses to go on, got none; the nodes are {nodes.supervisor.children}")


def longest_gap(times: Sequence[float], until_s: float) -> float:
    """Return the longest time between two consecutive moments, the first of which is among the first ``until_s``."""
    moments = np.array(times)
    return round(float(np.diff(moments)[moments[:-1] <= moments[0] + until_s].max()), 3)


def run(bench: Bench) -> Result:
    number = 2 if bench.quick else KILLS
    starts = bench.progress.track(range(number), description="starts")
    with tempfile.TemporaryDirectory() as never_compiled:
        found = {FIRST: [_start({"NUMBA_CACHE_DIR": never_compiled}, FIRST_S)]}
    found[ALL] = [_start() for _ in starts]
    found |= restarts(number, bench.progress)
    with busy():
        found |= {name + BUSY: gaps for name, gaps in restarts(number, bench.progress).items()}
    return Result([_table(found)], {"seconds without pose/world": found})


def _table(found: dict[str, list[float]]) -> Table:
    return Table(
        "restart", "All nodes are started, or one is killed: seconds without pose/world",
        ["node", "p50", "p95", "longest", "times"],
        [[name, *(f"{q:.2f}" for q in np.percentile(gaps, (50, 95, 100))), str(len(gaps))]
         for name, gaps in found.items()],
        "From `steadypose run` to the first message; and SIGKILL to one node after the other, at camera rate: the "
        "longest time between two messages that arrive. Busy: as many other processes as processors.",
    )  # fmt: skip
