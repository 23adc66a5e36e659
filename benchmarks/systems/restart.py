"""How long poses are missing after a node was killed, again and again, as who subscribes to ``pose/world`` sees it."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.provenance import WORLD, require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.benchmarks.running import Running, running
from steadypose.msgs.topics import POSE_WORLD
from steadypose.nodes.graph.supervisor import STEADY_S
from steadypose.nodes.graph.topology import POSE_NODES

DEPENDS_ON = WORLD

PAUSE_S = STEADY_S / len(POSE_NODES) + 1.0
"""Between kills of different nodes: each is up for longer than `STEADY_S`, so that none is started with a pause."""


@dataclass(frozen=True)
class Args:
    """How soon each node is back after SIGKILL, on this machine."""

    recording: Path = ROOT / "sim_data" / "walk_turn"
    """what is played, again and again, at camera rate"""
    kills: int = 20
    """of each node"""
    quick: bool = False
    """two kills, to see that it works; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


def restarts(recording: Path, kills: int, progress: Progress) -> dict[str, list[float]]:
    """Seconds without ``pose/world`` after each kill of each node."""
    found: dict[str, list[float]] = {name: [] for name in POSE_NODES}
    bar = progress.add_task("kills", total=kills * len(POSE_NODES))
    with running(recording, lossless=False, loop=True) as nodes:
        _arrivals(nodes, STEADY_S)
        for _ in range(kills):
            for name in POSE_NODES:
                os.kill(nodes.supervisor.children[name].pid, signal.SIGKILL)
                killed_s = time.monotonic()
                found[name].append(longest_gap([killed_s, *_arrivals(nodes, PAUSE_S)]))
                progress.advance(bar)
    return found


def _arrivals(nodes: Running, span_s: float) -> list[float]:
    """When each ``pose/world`` arrives, monotonic seconds, for ``span_s`` and until one has arrived since."""
    until, arrived = time.monotonic() + span_s, []
    for topic, _ in nodes.messages:
        if topic == POSE_WORLD:
            arrived.append(time.monotonic())
            if arrived[-1] > until:
                return arrived
    raise RuntimeError(f"expected poses to go on, got none; the nodes are {nodes.supervisor.children}")


def longest_gap(times: Sequence[float]) -> float:
    """The longest time between two of these moments in a row."""
    return round(float(np.diff(times).max()), 3)


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.out or not args.quick:
        require_committed(args.out or RESULTS)
    console = Console()
    with Progress(console=console) as progress:
        found = restarts(args.recording, 2 if args.quick else args.kills, progress)
    table = _table(found)
    show(table, console)
    if args.out or not args.quick:
        data: dict[str, Any] = {"seconds without pose/world": found}
        console.print(f"wrote {save('restart', sys.argv[1:], [table], data, DEPENDS_ON, args.out or RESULTS)}")


def _table(found: dict[str, list[float]]) -> Table:
    return Table(
        name="restart",
        title="A node is killed: seconds without pose/world",
        columns=["node", "p50", "p95", "longest", "kills"],
        rows=[
            [name, *(f"{q:.2f}" for q in np.percentile(gaps, (50, 95, 100))), str(len(gaps))]
            for name, gaps in found.items()
        ],
        note="SIGKILL to one node after the other, at camera rate; the longest time between two messages that arrive.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
