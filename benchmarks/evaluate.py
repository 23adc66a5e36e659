"""Runs protocols and files what they find: JSON, tables for the README, pictures."""

from __future__ import annotations

import importlib
import time
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.protocols import PROTOCOLS
from steadypose.benchmarks.results import RESULTS, save, show
from steadypose.nodes.graph.threads import one_thread


def evaluate(protocol: str, *, quick: bool, mocap: Path | None, data: Path, out: Path | None) -> None:
    """Run one protocol, or all that can be run here; see ``steadypose evaluate --help``."""
    if protocol == "kinect_vicon" and mocap is None:
        raise FileNotFoundError("kinect_vicon: expected --mocap DIR, the folder that holds ui_prmd.npz")
    one_thread()
    console = Console()
    with Progress(console=console, transient=True) as progress:
        bench = Bench(quick=quick, mocap=mocap, data=data, progress=progress)
        for name in PROTOCOLS if protocol == "all" else (protocol,):
            if name == "kinect_vicon" and mocap is None:
                console.print("kinect_vicon: left out, it needs --mocap", highlight=False)
                continue
            started = time.perf_counter()
            result: Result = importlib.import_module(f"steadypose.benchmarks.protocols.{name}").run(bench)
            seconds = time.perf_counter() - started
            for task in progress.task_ids:
                progress.remove_task(task)
            for table in result.tables:
                show(table, console)
            console.print(f"{name}: {seconds:.0f} s", highlight=False)
            if out is not None or not quick:
                console.print(f"wrote {_file(name, bench, result, seconds, out or RESULTS)}", highlight=False)


def _file(name: str, bench: Bench, result: Result, seconds: float, directory: Path) -> Path:
    options = [name, *(["--quick"] if bench.quick else [])]
    if name == "kinect_vicon":
        options += ["--mocap", "mocap"]
    content = {"quick": bench.quick, "seeds": bench.seeds, "seconds": round(seconds, 1), **result.data}
    path = save(name, options, result.tables, content, directory, program=("steadypose", "evaluate"))
    for stem, figure in result.figures.items():
        figure.savefig(directory / f"{stem}.png", dpi=110)
    return path
