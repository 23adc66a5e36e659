"""``steadypose prepare``: motion capture to training data, with nothing refused silently."""

import json
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from steadypose.nodes.commands.output import File
from steadypose.nodes.graph.launch import read_toml
from steadypose.nodes.settings import LaunchError
from steadypose.prior.mocap.clip import Clip, MotionError, documented
from steadypose.prior.mocap.files import SUFFIXES, describe
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.datasets import DATA_SETS, SPLITS, DataSet
from steadypose.training.data.prepare import Prepared, at_speed, prepare_clip, write_prepared
from steadypose.training.data.readers import UNREADABLE, Dropped, read_own


def prepare(
    mocap: Annotated[Path, tyro.conf.arg(metavar="IN")],
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("data"),
    speeds: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X")] = (1.0,),
    rig: File = None,
) -> None:
    """Convert motion capture to training data: 22 joints at 30 Hz, z up, on a floor, with contacts and splits.

    Writes prepared.npz, and prepare-report.json, which lists every recording that was left out, with the reason.
    Validation and test sets hold out whole people. Each data set has a licence class, in the last column: models
    trained on 'default' may go into products, 'research' is for non-commercial models only, and 'measure' is
    never trained on.

    Data sets are recognised by the name of the archive (.tar.xz, .npz) or folder:
      cmu_amc, _bvh, _expmap  CMU Graphics Lab, free for all uses         default
      cmu_more                the same, some fifteen more people          default
      cmu_dance               the same: salsa; test: martial arts, dance  default
      reactidle               ReActIdle, MIT                              default
      ui_prmd                 UI-PRMD, the Vicon's joints, public domain  default
      bandai_1, bandai_2      Bandai-Namco, CC BY-NC                      research
      amass                   AMASS' .npz, non-commercial                 research
      dancedb                 five dancers, research only                 measure
      lafan1                  four actors, CC BY-NC-ND                    measure
      own, or any other name  your own; folders 'val', 'test' hold out    default

    Your own files may be .bvh of any rig, .trc, .c3d (extra 'mocap'), AMASS .npz, or .npy arrays with --rig. Joints,
    units and the up axis are recognised. Use one folder per person.

    Try:
      steadypose prepare mocap/                        everything, a few minutes
      steadypose prepare mocap/cmu_amc.tar.xz --out /tmp/cmu
      steadypose prepare my-takes/ --rig studio.toml   files that are not recognised
      steadypose prepare mocap/ --speeds 2             add motion at twice the speed

    Args:
        mocap: a data set, or a folder of them.
        out: folder to write to.
        speeds: add training recordings of at least 50 frames per second at this speed. Repeatable.
        rig: TOML file that describes files which are not recognised: metres (length of their unit), up, fps, skeleton
            (of .npy), and [canonical], which names their joint for each of smpl22 (docs/sources.md).
    """
    if not all(0 < speed < math.inf for speed in speeds):
        raise LaunchError(f"--speeds: expected numbers above 0, got {', '.join(f'{speed:g}' for speed in speeds)}")
    speeds = tuple(dict.fromkeys(speeds))  # those given are added to 1, which may be given too
    console = Console(markup=False)
    sources = find_sources(mocap)
    if rig is not None:
        read = partial(read_own, description=describe(read_toml(rig)))
        sources = [(path, replace(s, read=read) if s.name == "own" else s) for path, s in sources]
    folder = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):  # now, not after minutes
        raise LaunchError(f"--out: cannot write to {out}: expected {folder} to be a folder that can be written to")
    found: list[Prepared | Dropped] = []
    with Progress(console=console) as progress:
        for path, data_set in sources:
            found += _read(path, data_set, speeds, progress)
    prepared = [part for part in found if isinstance(part, Prepared)]
    dropped = [part for part in found if isinstance(part, Dropped)]
    if not prepared:
        why = "; ".join(f"{d.name}: {d.cause.removeprefix(f'{d.name}: ')}" for d in dropped[:5])
        raise LaunchError(f"nothing usable in {mocap}, recordings left out: {len(dropped)}. {why}")
    out.mkdir(parents=True, exist_ok=True)
    write_prepared(prepared, out / "prepared.npz")
    report = out / "prepare-report.json"
    report.write_text(json.dumps(_report(prepared, dropped), indent=1) + "\n")
    console.print(_hours_table(prepared))
    # how many recordings of a source were dropped for a kind of cause: its words without names and numbers
    causes = Table("source", "cause", title=f"Dropped: {len(dropped)}, each with its cause in {report.name}", box=None)
    causes.add_column("recordings", justify="right")
    for (source, kind), count in Counter((d.source, d.kind) for d in dropped).items():
        causes.add_row(source, kind, str(count))
    console.print(causes)
    console.print(f"wrote {out / 'prepared.npz'} and {report}")


def find_sources(mocap: Path) -> list[tuple[Path, DataSet]]:
    """The files of each known data set, in the order of preparation. Raises LaunchError if there are none."""
    if not mocap.exists():
        raise LaunchError(f"expected a folder or archive of motion capture, '{mocap}' does not exist")
    candidates = [mocap] if mocap.is_file() else [*sorted(mocap.iterdir()), mocap]
    found = [(path, s) for s in DATA_SETS for path in candidates if s.matches(path)]
    if not found and any(path.suffix in SUFFIXES for path in ([mocap] if mocap.is_file() else mocap.rglob("*"))):
        found = [(mocap, s) for s in DATA_SETS if s.name == "own"]
    if not found:
        known = ", ".join(s.files for s in DATA_SETS)
        raise LaunchError(f"expected {', '.join(SUFFIXES)} or files named {known} in '{mocap}', found none")
    return found


def _hours(prepared: Sequence[Prepared]) -> dict[tuple[str, str, str], dict[str, tuple[int, float]]]:
    """(source, licence, set) -> split -> recordings and hours."""
    table: dict[tuple[str, str, str], dict[str, tuple[int, float]]] = defaultdict(dict)
    for p in prepared:
        row = table[p.clip.source, p.clip.licence, p.weights]
        count, hours = row.get(p.split, (0, 0.0))
        row[p.split] = (count + 1, hours + len(p.clip.positions) / FPS / 3600)
    return table


def _report(prepared: Sequence[Prepared], dropped: Sequence[Dropped]) -> dict[str, object]:
    return {
        "hours": [
            {
                "source": source,
                "licence": licence,
                "set": weights,
                **{s: {"clips": n, "hours": round(h, 3)} for s, (n, h) in sorted(splits.items())},
            }
            for (source, licence, weights), splits in _hours(prepared).items()
        ],
        "dropped": [asdict(d) for d in dropped],
        "not_flat": [p.clip.name for p in prepared if not p.flat],
    }


def _hours_table(prepared: Sequence[Prepared]) -> Table:
    table = Table("source", "weights", title="Prepared: recordings and hours at 30 Hz", box=None, pad_edge=False)
    for split in SPLITS:
        table.add_column(split, justify="right")
        table.add_column("hours", justify="right")
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0] * 2 * len(SPLITS))
    for (source, _, weights), splits in _hours(prepared).items():
        row = [value for split in SPLITS for value in splits.get(split, (0, 0.0))]
        table.add_row(source, weights, *_cells(row))
        sums[weights] = [a + b for a, b in zip(sums[weights], row, strict=True)]
    table.add_section()
    for weights, row in sums.items():
        table.add_row("total", weights, *_cells(row))
    return table


def _cells(row: list[float]) -> list[str]:
    return [f"{value:.{2 * (place % 2)}f}" for place, value in enumerate(row)]


def _read(path: Path, data_set: DataSet, speeds: Sequence[float], progress: Progress) -> list[Prepared | Dropped]:
    task = progress.add_task(path.name, total=1.0)
    found: list[Prepared | Dropped] = []

    def advance(fraction: float) -> None:
        kept = [part.clip.seconds for part in found if isinstance(part, Prepared)]
        so_far = f"{len(kept)} recordings, {sum(kept) / 60:.1f} min, {len(found) - len(kept)} dropped"
        progress.update(task, completed=fraction, description=f"{path.name}: {so_far}")

    try:
        for clip in data_set.read(path, advance):
            found += [clip] if isinstance(clip, Dropped) else _prepared(clip, data_set, speeds)
    except MotionError as error:  # its archive cannot be read further
        found.append(Dropped(path.name, data_set.name, UNREADABLE, str(error)))
    advance(1.0)
    return found


def _prepared(clip: Clip, data_set: DataSet, speeds: Sequence[float]) -> list[Prepared | Dropped]:
    try:
        return documented(lambda: list(_played(clip, data_set, speeds)))()
    except MotionError as error:
        return [Dropped(clip.name, clip.source, UNREADABLE, str(error))]


def _played(clip: Clip, data_set: DataSet, speeds: Sequence[float]) -> Iterator[Prepared | Dropped]:
    """A recording at each speed; one that is held out at its own alone."""
    split = data_set.split(clip)
    for speed in speeds if split == "train" else (1.0,):
        if (played := at_speed(clip, speed)) is not None:
            yield from prepare_clip(played, data_set.weights, split, speed)
