"""Endurance: memory and speed of every node while hours of a stream are replayed as fast as possible.

With ``--occupied 0.25`` it is a kiosk's day: visits, each of somebody new, and nobody in between.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.provenance import WORLD, require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.benchmarks.running import running
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.recording_writer import RecordingWriter
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import Diagnostics, PoseRaw
from steadypose.nodes.graph.topology import POSE_NODES

DEPENDS_ON = WORLD

VISITS = 50
"""by so many people in turn, until their ids are met again"""


@dataclass(frozen=True)
class Args:
    """Memory of the nodes over an hour of stream, on this machine."""

    recording: Path = ROOT / "sim_data" / "walk_turn"
    """what is played, again and again"""
    hours: float = 1.0
    """of stream; Ctrl-C ends it earlier, with what was measured by then"""
    occupied: float = 1.0
    """share of the time in which somebody is seen"""
    quick: bool = False
    """0.05 h, to see that it works; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


def memory(recording: Path, hours: float, occupied: float, progress: Progress) -> dict[str, Any]:
    """Resident memory of each node while a stream is replayed, again and again, as fast as the nodes take it.

    Interrupted, it tells of the hours until then.
    """
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in (*POSE_NODES, "recorder")}
    paces: dict[str, list[tuple[float, float]]] = {name: [] for name in samples}
    first_ns: int | None = None
    bar = progress.add_task(f"memory over {hours:g} h of stream", total=hours)
    with tempfile.TemporaryDirectory(prefix="steadypose-") as folder:
        if occupied < 1:
            recording = visits(recording, occupied, Path(folder, "visits"))
        with (
            running(recording, lossless=True, rate=0, loop=True, record=Path(folder, "soak")) as (messages, *_),
            suppress(KeyboardInterrupt),
        ):
            for _, message in messages:
                if not isinstance(message, Diagnostics) or message.stamp_ns == 0:
                    continue
                first_ns = message.stamp_ns if first_ns is None else first_ns
                age = (message.stamp_ns - first_ns) / 3.6e12
                samples[message.node].append((age, float(message.values["memory_mb"])))
                if "compute_ms.p50" in message.values and message.values.get("bodies") != "0":
                    paces[message.node].append((age, float(message.values["compute_ms.p50"])))
                progress.update(bar, completed=age)
                if all(s and s[-1][0] >= hours for s in samples.values()):
                    break
    hours = min(hours, *(s[-1][0] for s in samples.values()))
    nodes = {name: growth(s, hours) | pace(paces[name], hours) for name, s in samples.items()}
    return {"hours": round(hours, 2), "occupied": occupied, "nodes": nodes}


def visits(recording: Path, occupied: float, directory: Path) -> Path:
    """A recording's stream as `VISITS` people in turn, nobody in between: ``occupied`` of the frames have one."""
    with RecordingReader(recording) as reader:
        seen = [r.message for r in reader.messages([POSE_RAW]) if isinstance(r.message, PoseRaw)]
    period_ns = (seen[-1].stamp_ns - seen[0].stamp_ns) // (len(seen) - 1)
    stamp_ns = seen[0].stamp_ns
    with RecordingWriter(directory) as writer:
        for visit in range(VISITS):
            for index in range(round(len(seen) / occupied)):
                there = index < len(seen)
                bodies = [replace(b, id=b.id + visit) for b in seen[index].bodies] if there else []
                writer.write(POSE_RAW, replace(seen[0], stamp_ns=stamp_ns, bodies=bodies), stamp_ns)
                stamp_ns += period_ns
    return directory


def growth(samples: list[tuple[float, float]], hours: float) -> dict[str, float]:
    """What (age in hours, megabytes) samples say: first, last, most, MB an hour, and percent grown in three fifths."""
    ages, sizes = np.array(samples).T
    settled = ages >= 0.2 * hours
    slope = np.polyfit(ages[settled], sizes[settled], 1)[0]
    early, late = _early_and_late(samples, hours)
    figures = {"first_mb": sizes[0], "last_mb": sizes[-1], "most_mb": sizes.max(), "slope_mb_per_hour": slope}
    figures["grown_percent"] = 100 * (late / early - 1)
    return {name: round(float(value), 2) for name, value in figures.items()} | {"samples": len(samples)}


def pace(samples: list[tuple[float, float]], hours: float) -> dict[str, float]:
    """What (age in hours, milliseconds of a frame) samples say: the median in the second and in the last fifth."""
    if not samples:
        return {}
    early, late = _early_and_late(samples, hours)
    return {"early_ms": round(early, 3), "late_ms": round(late, 3)}


def _early_and_late(samples: list[tuple[float, float]], hours: float) -> tuple[float, float]:
    ages, values = np.array(samples).T

    def median(fifth: NDArray[np.bool_]) -> float:
        return float(np.median(values[fifth])) if fifth.any() else np.nan

    return median((ages >= 0.2 * hours) & (ages < 0.4 * hours)), median(ages >= 0.8 * hours)


def main(args: Args) -> None:
    """Measure, print, write."""
    if args.out or not args.quick:
        require_committed(args.out or RESULTS)
    console = Console()
    with Progress(console=console) as progress:
        result = memory(args.recording, 0.05 if args.quick else args.hours, args.occupied, progress)
    table = _table(result)
    show(table, console)
    if args.out or not args.quick:
        console.print(
            f"wrote {save('memory', sys.argv[1:], [table], {'memory': result}, DEPENDS_ON, args.out or RESULTS)}"
        )


def _table(result: dict[str, Any]) -> Table:
    hours, occupied = result["hours"], result["occupied"]
    stream = f"{hours:g} h of stream" + (f", somebody there {occupied:.0%} of the time," if occupied < 1 else "")
    return Table(
        name="memory",
        title=f"{stream} replayed fast: resident memory, MB, and ms of a frame early and late",
        columns=["node", "first", "last", "most", "MB an hour", "grown, %", "early ms", "late ms"],
        rows=[
            [
                name,
                *(f"{n[k]:.0f}" for k in ("first_mb", "last_mb", "most_mb")),
                f"{n['slope_mb_per_hour']:+.2f}",
                f"{n['grown_percent']:+.1f}",
                *(f"{n[k]:.2f}" if k in n else "" for k in ("early_ms", "late_ms")),
            ]
            for name, n in result["nodes"].items()
        ],
        note="MB an hour: slope of a line through all but the first fifth. Grown: from the second to the last fifth.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
