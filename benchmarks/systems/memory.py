"""Endurance: memory and speed of every node while hours of a stream are replayed as fast as possible."""

from __future__ import annotations

import sys
import tempfile
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
from steadypose.benchmarks.running import running
from steadypose.msgs.types import Diagnostics
from steadypose.nodes.graph.topology import POSE_NODES

DEPENDS_ON = WORLD


@dataclass(frozen=True)
class Args:
    """Memory of the nodes over an hour of stream, on this machine."""

    recording: Path = ROOT / "sim_data" / "walk_turn"
    """what is played, again and again"""
    hours: float = 1.0
    """of stream"""
    quick: bool = False
    """0.05 h, to see that it works; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


def memory(recording: Path, hours: float, progress: Progress) -> dict[str, Any]:
    """Resident memory of each node while a stream is replayed, again and again, as fast as the nodes take it."""
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in (*POSE_NODES, "recorder")}
    paces: dict[str, list[tuple[float, float]]] = {name: [] for name in samples}
    first_ns: int | None = None
    bar = progress.add_task(f"memory over {hours:g} h of stream", total=hours)
    with (
        tempfile.TemporaryDirectory(prefix="steadypose-") as folder,
        running(recording, lossless=True, rate=0, loop=True, record=Path(folder, "soak")) as (messages, _, _),
    ):
        for _, message in messages:
            if not isinstance(message, Diagnostics) or message.stamp_ns == 0:
                continue
            first_ns = message.stamp_ns if first_ns is None else first_ns
            age = (message.stamp_ns - first_ns) / 3.6e12
            samples[message.node].append((age, float(message.values["memory_mb"])))
            if "compute_ms.p50" in message.values:
                paces[message.node].append((age, float(message.values["compute_ms.p50"])))
            progress.update(bar, completed=age)
            if all(s and s[-1][0] >= hours for s in samples.values()):
                break
    nodes = {name: growth(s, hours) | pace(paces[name], hours) for name, s in samples.items()}
    return {"hours": hours, "nodes": nodes}


def growth(samples: list[tuple[float, float]], hours: float) -> dict[str, float]:
    """What (age in hours, megabytes) samples say: first, last, most, and MB an hour after the first fifth."""
    ages, sizes = np.array(samples).T
    settled = ages >= 0.2 * hours
    slope = np.polyfit(ages[settled], sizes[settled], 1)[0]
    figures = {"first_mb": sizes[0], "last_mb": sizes[-1], "most_mb": sizes.max(), "slope_mb_per_hour": slope}
    return {name: round(float(value), 2) for name, value in figures.items()} | {"samples": len(samples)}


def pace(samples: list[tuple[float, float]], hours: float) -> dict[str, float]:
    """What (age in hours, milliseconds of a frame) samples say: the median in the second and in the last fifth."""
    if not samples:
        return {}
    ages, spent = np.array(samples).T
    fifths = {"early_ms": (ages >= 0.2 * hours) & (ages < 0.4 * hours), "late_ms": ages >= 0.8 * hours}
    return {name: round(float(np.median(spent[fifth])), 3) for name, fifth in fifths.items() if fifth.any()}


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.out or not args.quick:
        require_committed(args.out or RESULTS)
    console = Console()
    with Progress(console=console) as progress:
        result = memory(args.recording, 0.05 if args.quick else args.hours, progress)
    table = _table(result)
    show(table, console)
    if args.out or not args.quick:
        console.print(
            f"wrote {save('memory', sys.argv[1:], [table], {'memory': result}, DEPENDS_ON, args.out or RESULTS)}"
        )


def _table(result: dict[str, Any]) -> Table:
    return Table(
        name="memory",
        title=f"{result['hours']:g} h of stream replayed fast: resident memory, MB, and ms of a frame early and late",
        columns=["node", "first", "last", "most", "MB an hour", "early ms", "late ms"],
        rows=[
            [
                name,
                *(f"{n[k]:.0f}" for k in ("first_mb", "last_mb", "most_mb")),
                f"{n['slope_mb_per_hour']:+.2f}",
                *(f"{n[k]:.2f}" if k in n else "" for k in ("early_ms", "late_ms")),
            ]
            for name, n in result["nodes"].items()
        ],
        note="MB an hour: the slope of a line through all but the first fifth.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
