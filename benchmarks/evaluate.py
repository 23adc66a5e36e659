"""``steadypose evaluate``: runs studies with their baselines and writes their results."""

from __future__ import annotations

import importlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from steadypose.benchmarks.studies import NO_SPLIT, PREPARED, SENSORS, STUDIES
from steadypose.benchmarks.systems import SYSTEMS

if TYPE_CHECKING:
    from steadypose.benchmarks.bench import Bench
    from steadypose.benchmarks.results import Result

    Name = str
else:
    Name = tyro.extras.literal_type_from_choices(["all", *STUDIES, *SYSTEMS])


def evaluate(
    study: Annotated[Name, tyro.conf.Positional],
    split: Literal["val", "test"] = "val",
    quick: bool = False,
    mocap: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    data: Path = Path("data/prepared.npz"),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> int:
    """Measure steadypose against its tuned baselines. Choose on the split 'val' and report 'test'.

    Figures, tables and plots of 'test', and of studies without a split, are written to benchmarks/results, if the code
    is committed. Others are written to the folder of --out, if any. Every reading of 'test' is logged in
    benchmarks/results/test-readings.csv.

    Try:
      steadypose evaluate fidelity --quick

    Args:
        study: what to measure, or 'all' studies except those of the whole system (latency, scale, restart, soak,
            events, retarget).
        split: split of the prepared motion to score. Kinect, MediaPipe and force plates have none.
        quick: use a few clips and points, to check that everything works.
        mocap: folder with ui_prmd.npz, mediapipe_pose.npz and contacts_grf.npz, for the studies of these sensors;
            without it, 'all' leaves them out.
        data: prepared motion, written by 'steadypose prepare'; without it, simulated people are used instead.
        out: folder to write to.
    """
    if (needed := _missing(study, mocap, data)) is not None:
        raise FileNotFoundError(f"{study}: expected {needed}")
    # torch is imported after the arguments are checked
    from rich.console import Console
    from rich.progress import Progress

    from steadypose.benchmarks.bench import Bench
    from steadypose.benchmarks.provenance import RESULTS, require_committed
    from steadypose.benchmarks.results import log_reading, show
    from steadypose.nodes.graph.threads import one_thread

    if out is None and not quick and (split == "test" or study in (*SYSTEMS, *NO_SPLIT)):
        out = RESULTS
    if out is not None:
        require_committed(out)
    one_thread()
    console, wrong = Console(), list[str]()
    if not data.is_file() and study not in (*NO_SPLIT, *SYSTEMS):
        console.print(f"{data} does not exist: the people are simulated", highlight=False, markup=False, soft_wrap=True)
    with Progress(console=console, transient=True) as progress:
        bench = Bench(quick=quick, mocap=mocap, data=data, progress=progress, split=split)
        for name in STUDIES if study == "all" else (study,):
            if (needed := _missing(name, mocap, data)) is not None:
                console.print(f"{name}: left out, it needs {needed}", highlight=False)
                continue
            if split == "test" and name not in (*NO_SPLIT, *SYSTEMS) and data.is_file():
                log_reading(name)
            started = time.perf_counter()
            room = "systems" if name in SYSTEMS else "studies"
            module = importlib.import_module(f"steadypose.benchmarks.{room}.{name}")
            result: Result = module.run(bench)
            seconds = time.perf_counter() - started
            for task in progress.task_ids:
                progress.remove_task(task)
            for table in result.tables:
                show(table, console)
            console.print(f"{name}: {seconds:.0f} s", highlight=False)
            if out is not None:
                console.print(f"wrote {_file(name, room, bench, result, module, seconds, out)}", highlight=False)
            wrong += result.wrong
    if out is None:
        console.print("nothing was saved: pass --out DIR, or --split test without --quick", highlight=False)
    for line in wrong:
        console.print(line, markup=False)
    return int(bool(wrong))


def _missing(study: str, mocap: Path | None, data: Path) -> str | None:
    if study in PREPARED and not data.is_file():
        return "--data FILE, prepared motion"
    file = SENSORS.get(study)
    return f"--mocap DIR, the folder that holds {file}" if file and not (mocap and (mocap / file).is_file()) else None


def _file(name: str, room: str, bench: Bench, result: Result, module: Any, seconds: float, directory: Path) -> Path:
    from steadypose.benchmarks.results import PICTURES, RESULTS, save

    options = [name, *(["--split", bench.split] if room == "studies" else []), *(["--quick"] if bench.quick else [])]
    if name in SENSORS:
        options += ["--mocap", "mocap"]
    content = {
        "quick": bench.quick, "split": bench.split, "seeds": bench.seeds, "seconds": round(seconds, 1),
        "pictures": list(result.figures), **result.data,
    }  # fmt: skip
    path = save(name, ["steadypose", "evaluate", *options], result.tables, content, module, directory)
    pictures = PICTURES if directory == RESULTS else directory
    for stem, figure in result.figures.items():
        figure.savefig(pictures / f"{stem}.png", dpi=110)
    return path
