"""``steadypose prepare``: motion capture to training data, with nothing refused silently."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from steadypose.nodes.graph.launch import read_toml
from steadypose.prior.mocap.clip import Clip, MotionError, documented
from steadypose.prior.mocap.files import SUFFIXES, describe
from steadypose.training.data.datasets import DATA_SETS, SPLITS, DataSet
from steadypose.training.data.prepare import FPS, Prepared, at_speed, prepare_clip, write_prepared
from steadypose.training.data.readers import UNREADABLE, Dropped, read_own


class PrepareError(ValueError):
    """There is nothing to prepare; the message says what was looked for."""


def prepare(
    mocap: Path,
    out: Path = Path("data"),
    speeds: tuple[float, ...] = (1.0,),
    rig: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> None:
    """Convert motion capture to training data: 22 joints at 30 Hz, z up, on a floor, with contacts and splits.

    Writes prepared.npz, and prepare-report.json, which lists every recording that was left out, with the reason.
    Validation and test sets hold out whole people. Each data set has a licence class, in the last column: models
    trained on 'default' may go into products, 'research' is for non-commercial models only, and 'measure' is
    never trained on.

    Data sets are recognised by the name of the archive (.tar.xz, .npz) or folder:
      cmu_amc, cmu_bvh, cmu_expmap   CMU Graphics Lab, free for all uses            default
      cmu_more                       the same, some fifteen more people             default
      cmu_dance                      the same: salsa; martial arts and dance test   default
      reactidle                      ReActIdle, MIT                                 default
      ui_prmd                        UI-PRMD, the Vicon's joints, public domain     default
      bandai_1, bandai_2             Bandai-Namco, CC BY-NC                         research
      amass                          AMASS' .npz, non-commercial                    research
      dancedb                        five dancers, research only                    measure
      lafan1                         four actors, CC BY-NC-ND                       measure
      own, or any other name         your own; folders 'val', 'test' hold out       default

    Your own files may be .bvh of any rig, .trc, .c3d (extra 'mocap'), AMASS .npz, or .npy arrays with --rig. Joints,
    units and the up axis are recognised. Use one folder per person.

    Try:
      steadypose prepare mocap/                        everything, a few minutes
      steadypose prepare mocap/cmu_amc.tar.xz --out /tmp/cmu
      steadypose prepare my-takes/ --rig studio.toml   files that are not recognised
      steadypose prepare mocap/ --speeds 1 --speeds 2  add motion at twice the speed

    Args:
        mocap: a data set, or a folder of them.
        out: folder to write to.
        speeds: add training recordings of at least 50 frames per second at this speed. Repeatable.
        rig: TOML file that describes files which are not recognised: metres (length of their unit), up, fps, skeleton
            (of arrays), and [canonical], their names of the joints of smpl22.
    """
    console = Console()
    sources = find_sources(mocap)
    if rig is not None:
        read = partial(read_own, description=describe(read_toml(rig)))
        sources = [(path, replace(s, read=read) if s.name == "own" else s) for path, s in sources]
    result = _Result()
    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as progress:
        tasks = [progress.add_task(path.name, start=False, total=1.0, count="") for path, _ in sources]
        for task, (path, data_set) in zip(tasks, sources, strict=True):
            progress.start_task(task)
            _read(path, data_set, result, progress, task, speeds)
    if not result.prepared:
        raise PrepareError(f"nothing usable in {mocap}; dropped: {len(result.dropped)}")
    out.mkdir(parents=True, exist_ok=True)
    write_prepared(result.prepared, out / "prepared.npz")
    report = out / "prepare-report.json"
    report.write_text(json.dumps(result.report(), indent=1) + "\n")
    console.print(result.hours_table())
    console.print(result.dropped_table())
    console.print(f"wrote {out / 'prepared.npz'} and {report}")


def find_sources(mocap: Path) -> list[tuple[Path, DataSet]]:
    """Which files hold which known data set, in the order of preparation.

    Raises:
        PrepareError: nothing there, or nothing known.
    """
    if not mocap.exists():
        raise PrepareError(f"expected a folder or archive of motion capture, '{mocap}' does not exist")
    candidates = [mocap] if mocap.is_file() else [*sorted(mocap.iterdir()), mocap]
    found = [(path, s) for s in DATA_SETS for path in candidates if s.matches(path)]
    if not found and any(path.suffix in SUFFIXES for path in ([mocap] if mocap.is_file() else mocap.rglob("*"))):
        found = [(mocap, s) for s in DATA_SETS if s.name == "own"]
    if not found:
        known = ", ".join(s.files.removesuffix(r"\b.*") for s in DATA_SETS)
        raise PrepareError(f"expected files named {known} in '{mocap}', found none")
    return found


@dataclass
class _Result:
    prepared: list[Prepared] = field(default_factory=list)
    dropped: list[Dropped] = field(default_factory=list)

    def causes(self) -> Counter[tuple[str, str]]:
        """How many recordings of a source were dropped for a kind of cause (its words without names and numbers)."""
        return Counter((d.source, d.kind) for d in self.dropped)

    def hours(self) -> dict[tuple[str, str, str], dict[str, tuple[int, float]]]:
        """(source, licence, set) -> split -> recordings and hours."""
        table: dict[tuple[str, str, str], dict[str, tuple[int, float]]] = defaultdict(dict)
        for p in self.prepared:
            row = table[p.clip.source, p.clip.licence, p.weights]
            count, hours = row.get(p.split, (0, 0.0))
            row[p.split] = (count + 1, hours + len(p.clip.positions) / FPS / 3600)
        return table

    def report(self) -> dict[str, object]:
        return {
            "hours": [
                {
                    "source": source,
                    "licence": licence,
                    "set": weights,
                    **{s: {"clips": n, "hours": round(h, 3)} for s, (n, h) in sorted(splits.items())},
                }
                for (source, licence, weights), splits in self.hours().items()
            ],
            "dropped": [asdict(d) for d in self.dropped],
            "not_flat": [p.clip.name for p in self.prepared if not p.flat],
        }

    def hours_table(self) -> Table:
        table = Table(title="Prepared: recordings and hours at 30 Hz", box=None, pad_edge=False)
        for name in ("source", "weights"):
            table.add_column(name)
        for split in SPLITS:
            table.add_column(split, justify="right")
            table.add_column("hours", justify="right")
        sums: dict[str, list[float]] = defaultdict(lambda: [0.0] * 2 * len(SPLITS))
        for (source, _, weights), splits in self.hours().items():
            row = [value for split in SPLITS for value in splits.get(split, (0, 0.0))]
            table.add_row(source, weights, *_cells(row))
            sums[weights] = [a + b for a, b in zip(sums[weights], row, strict=True)]
        table.add_section()
        for weights, row in sums.items():
            table.add_row("total", weights, *_cells(row))
        return table

    def dropped_table(self) -> Table:
        table = Table(title=f"Dropped: {len(self.dropped)}, each with its cause in prepare-report.json", box=None)
        for name in ("source", "cause"):
            table.add_column(name)
        table.add_column("recordings", justify="right")
        for (source, kind), count in self.causes().items():
            table.add_row(source, kind, str(count))
        return table


def _cells(row: list[float]) -> list[str]:
    return [f"{value:.{2 * (place % 2)}f}" for place, value in enumerate(row)]


def _read(
    path: Path, data_set: DataSet, result: _Result, progress: Progress, task: TaskID, speeds: Sequence[float]
) -> None:
    kept = dropped = 0
    reading = True
    seconds = 0.0

    def advance(fraction: float) -> None:
        count = f"{kept} recordings, {seconds / 60:.1f} min, {dropped} dropped"
        fraction = min(fraction, 0.99) if reading else 1.0
        progress.update(task, completed=fraction, count=count)

    for clip in _clips(path, data_set, advance):
        for part in [clip] if isinstance(clip, Dropped) else _prepared(clip, data_set, speeds):
            if isinstance(part, Dropped):
                result.dropped.append(part)
                dropped += 1
            else:
                result.prepared.append(part)
                kept += 1
                seconds += part.clip.seconds
    reading = False
    advance(1.0)


def _clips(path: Path, data_set: DataSet, advance: Callable[[float], None]) -> Iterator[Clip | Dropped]:
    """The recordings of a data set; where its archive cannot be read further, that is the last."""
    try:
        yield from data_set.read(path, advance)
    except MotionError as error:
        yield Dropped(path.name, data_set.name, UNREADABLE, str(error))


def _prepared(clip: Clip, data_set: DataSet, speeds: Sequence[float]) -> list[Prepared | Dropped]:
    try:
        return documented(lambda: list(_played(clip, data_set, speeds)))()
    except MotionError as error:
        return [Dropped(clip.name, clip.source, UNREADABLE, str(error))]


def _played(clip: Clip, data_set: DataSet, speeds: Sequence[float]) -> Iterator[Prepared | Dropped]:
    """What a recording gives: held out, itself; in training, once at each speed."""
    split = data_set.split(clip)
    for speed in speeds if split == "train" else (1.0,):
        if (played := at_speed(clip, speed)) is not None:
            yield from prepare_clip(played, data_set.weights, split, speed)
