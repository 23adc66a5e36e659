"""Runs protocols and files what they find: JSON, tables for the README, pictures."""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, log_reading, save, show
from steadypose.benchmarks.studies import PROTOCOLS, SENSORS
from steadypose.nodes.graph.threads import one_thread


def evaluate(protocol: str, *, split: str, quick: bool, mocap: Path | None, data: Path, out: Path | None) -> None:
    """Run one protocol, or all that can be run here; see ``steadypose evaluate --help``."""
    if protocol in SENSORS and (mocap is None or not (mocap / SENSORS[protocol]).is_file()):
        raise FileNotFoundError(f"{protocol}: expected --mocap DIR, the folder that holds {SENSORS[protocol]}")
    if out is None and split == "test" and not quick:
        out = RESULTS
    if out is not None:
        require_committed(out)
    one_thread()
    console = Console()
    with Progress(console=console, transient=True) as progress:
        bench = Bench(quick=quick, mocap=mocap, data=data, progress=progress, split=split)
        for name in PROTOCOLS if protocol == "all" else (protocol,):
            if name in SENSORS and (mocap is None or not (mocap / SENSORS[name]).is_file()):
                console.print(f"{name}: left out, it needs {SENSORS[name]} (--mocap)", highlight=False)
                continue
            if split == "test" and name not in SENSORS and data.is_file():
                log_reading(name)
            started = time.perf_counter()
            module = importlib.import_module(f"steadypose.benchmarks.studies.{name}")
            result: Result = module.run(bench)
            seconds = time.perf_counter() - started
            for task in progress.task_ids:
                progress.remove_task(task)
            for table in result.tables:
                show(table, console)
            console.print(f"{name}: {seconds:.0f} s", highlight=False)
            if out is not None:
                console.print(f"wrote {_file(name, bench, result, module.DEPENDS_ON, seconds, out)}", highlight=False)
    if out is None:
        console.print("written nowhere: --out DIR, or --split test without --quick, writes", highlight=False)


def _file(name: str, bench: Bench, result: Result, depends_on: Sequence[str], seconds: float, directory: Path) -> Path:
    options = [name, "--split", bench.split, *(["--quick"] if bench.quick else [])]
    if name in SENSORS:
        options += ["--mocap", "mocap"]
    content = {
        "quick": bench.quick, "split": bench.split, "seeds": bench.seeds, "seconds": round(seconds, 1), **result.data
    }  # fmt: skip
    path = save(name, options, result.tables, content, depends_on, directory, ("steadypose", "evaluate"))
    for stem, figure in result.figures.items():
        figure.savefig(directory / f"{stem}.png", dpi=110)
    return path
