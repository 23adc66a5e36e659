"""Runs protocols and files what they find: JSON, tables for the README, pictures."""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path

import torch
from rich.console import Console
from rich.progress import Progress

from benchmarks.bench import Bench, Result
from benchmarks.protocols import PROTOCOLS
from benchmarks.results import RESULTS, save, show


def evaluate(protocol: str, *, quick: bool, mocap: Path | None, data: Path, out: Path | None) -> None:
    """Run one protocol, or all that can be run here; see ``steadypose evaluate --help``."""
    if protocol == "kinect_vicon" and mocap is None:
        raise FileNotFoundError("kinect_vicon: expected --mocap DIR, the folder that holds ui_prmd.npz")
    torch.set_num_threads(1)
    console = Console()
    for name in PROTOCOLS if protocol == "all" else (protocol,):
        if name == "kinect_vicon" and mocap is None:
            console.print("kinect_vicon: left out, it needs --mocap", highlight=False)
            continue
        started = time.perf_counter()
        with Progress(console=console, transient=True) as progress:
            result: Result = importlib.import_module(f"benchmarks.protocols.{name}").run(
                Bench(quick=quick, mocap=mocap, data=data, progress=progress)
            )
        seconds = time.perf_counter() - started
        for table in result.tables:
            show(table, console)
        console.print(f"{name}: {seconds:.0f} s", highlight=False)
        directory = out or (None if quick else RESULTS)
        if directory is not None:
            arguments = [*sys.argv[sys.argv.index(protocol) :]] if protocol in sys.argv else [name]
            content = {"quick": quick, "seconds": round(seconds, 1), **result.data}
            path = save(name, arguments, result.tables, content, directory, program=("steadypose", "evaluate"))
            for stem, figure in result.figures.items():
                figure.savefig(directory / f"{stem}.png", dpi=110)
            console.print(f"wrote {path}", highlight=False)
