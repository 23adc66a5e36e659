"""The output of commands: files, never over their input, and whole or not at all; and text of others on a terminal.

One recording is cleaned here, for `clean` and for each process of a folder's.
"""

import errno
import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from steadypose.msgs.recording import RecordingError, RecordingWriter
from steadypose.msgs.recording_writer import recorded_parts
from steadypose.msgs.types import Message
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.arrays import write_csv, write_events
from steadypose.nodes.sinks.recorder import LogTimes
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.layouts import add_layouts

In = Annotated[Path, tyro.conf.arg(name="in", metavar="IN")]
Out = Annotated[Path, tyro.conf.arg(metavar="OUT")]
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
ARRAY_FILES = (".npz", ".csv")  # endings of outputs that are one file of arrays
UNTRUSTED = "the output cannot be trusted, because of the problems above"
NO_POSE = "the output has no pose, because of the problems above"
OTHER_FORMATS = {
    *(".npy", ".json", ".jsonl", ".txt", ".tsv", ".xlsx", ".pkl", ".pt", ".h5", ".hdf5", ".mat", ".parquet", ".bag"),
    *(".bvh", ".fbx", ".glb", ".gltf", ".vrma", ".c3d", ".trc", ".mp4", ".gif", ".png"),
}
"""endings that are never meant as a recording's name, which is that of a folder"""


def print_faults(terminal: Console, refused: Mapping[str, int], problems: Iterable[str]) -> None:
    """Print in one line what was not used as given, by cause, and then each problem."""
    if refused:
        counts = ", ".join(f"{cause.replace('_', ' ')} ({count})" for cause, count in refused.items())
        terminal.print(f"  not used as given: {counts}")
    for problem in problems:
        terminal.print(f"  {problem}", style="yellow")


def check_output(source: Path, *outputs: Path) -> None:
    """Raises LaunchError if an output is the input, or its folder does not exist."""
    for out in outputs:
        if source.resolve() == out.resolve():
            raise LaunchError(f"{out}: expected another path than the input's; nothing is written in place")
        check_folder(out)


def check_folder(out: Path) -> None:
    """Raises LaunchError if the folder of an output does not exist."""
    if not out.resolve().parent.is_dir():
        raise LaunchError(f"{out}: expected its folder {out.resolve().parent} to exist; make it first")


def check_format(out: Path) -> None:
    """Raises LaunchError if an output of poses has the ending of a format that is neither a recording's nor arrays'."""
    if out.suffix in OTHER_FORMATS:
        raise LaunchError(
            f"{out}: expected .npz or .csv for arrays, or a name without ending for a recording, got {out.suffix}; "
            "`steadypose export` makes .bvh, .glb, .vrma and .trc"
        )


def check_file(source: Path, out: Path, endings: tuple[str, ...], *, replace: bool) -> None:
    """Raises LaunchError if a file has none of these endings, or is there already; or as `check_output`."""
    check_output(source, out)
    if out.suffix not in endings:
        raise LaunchError(f"{out}: expected a name ending in {', '.join(endings)}, got {out.suffix or 'none'}")
    check_replaceable(out, replace=replace, is_file=True)


def check_poses_file(source: Path, out: Path, *others: Path, replace: bool) -> None:
    """Raises LaunchError if poses cannot be written to ``out``, or a file to one of the others."""
    check_format(out)
    check_output(source, out, *others)
    check_replaceable(out, replace=replace, is_file=out.suffix in ARRAY_FILES)


def check_replaceable(out: Path, *, replace: bool, is_file: bool) -> None:
    """Raises LaunchError if what is there is not to be replaced, or is nothing that these commands make."""
    if not os.path.lexists(out):
        return
    if not replace:
        raise LaunchError(f"{out} exists: expected a new path, or --force to replace it")
    if is_file and not out.is_file():
        raise LaunchError(f"{out} is no file: expected an {out.suffix} to replace")
    if not is_file:
        try:
            recorded_parts(out)
        except (RecordingError, OSError) as error:
            raise LaunchError(f"{out} is no recording, and is not replaced: {error}") from error


@contextmanager
def unfinished(out: Path) -> Iterator[Path]:
    """Where to write what becomes ``out`` after the block: beside it, under the same name, which a recording's file has
    too.

    Raises LaunchError if the folder cannot be written to, the disk is full, or another call is writing ``out``.
    """
    folder = out.with_name(f".{out.name}.part")
    mark = folder / ".steadypose"
    if mark.exists():
        with mark.open() as held:
            _lock(held, out)
        shutil.rmtree(folder)  # of a call that was killed
    try:
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise LaunchError(f"{folder} is in the way, and was not made here: expected it not to exist") from error
    except OSError as error:
        raise LaunchError(f"{out}: expected a folder that can be written to, got one that cannot: {error}") from error
    try:
        with mark.open("w") as held:
            _lock(held, out)
            yield folder / out.name
            (folder / out.name).replace(out)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise LaunchError(f"{out}: {os.strerror(error.errno)}; make room, or write it elsewhere") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _lock(held: IO[str], out: Path) -> None:
    """Lock the mark of a folder for this process, until the file is closed."""
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise LaunchError(f"{out}: another steadypose is writing it: wait for it, or write elsewhere") from error
    except OSError:
        pass  # a file system without locks


def write_output(
    out: Path, arrays: Callable[[], Mapping[str, NDArray[Any]]], messages: Callable[[], Iterable[tuple[str, Message]]]
) -> None:
    """Write arrays or messages, as the name's ending says; the output is there whole, or not at all.

    Messages are logged as by the recorder. A recording that is there is replaced.
    """
    with unfinished(out) as part:
        if out.suffix == ".csv":
            write_csv(part, arrays())
        elif out.suffix == ".npz":
            np.savez(part, **arrays())  # type: ignore[arg-type]
        else:
            log_times = LogTimes()
            with RecordingWriter(part) as writer:
                for topic, message in messages():
                    writer.write(topic, message, log_times.next(topic, message.stamp_ns))
            if out.exists():
                shutil.rmtree(out)


def console() -> Console:
    """Of standard error, for lines as they are, however long."""
    return Console(stderr=True, highlight=False, markup=False, soft_wrap=True)


def plural(count: int, one: str, more: str = "") -> str:
    """A number of things; ``more`` is their plural if it does not end in s."""
    return f"{count} {one if count == 1 else more or one + 's'}"


@dataclass(frozen=True)
class Cleaned:
    """Summary of the cleaning of one recording."""

    frames: int  # of the input
    duration_s: float  # of the input; steps of its stamps back do not count
    spent_s: float  # computing time
    poses: int  # number of poses in the output; 0 if no body was recognised, which is then a problem
    refused: dict[str, int]  # what was refused or dropped, by cause
    problems: list[str]  # what is wrong with the input, each as it was first found
    trusted: bool  # whether the output can be trusted in spite of them
    unread: dict[str, int]  # what of it the input holds and could not be read, because it is damaged


def clean_recording(
    source: Path,
    out: Path,
    settings: Mapping[str, Mapping[str, Any]],
    *,
    events: Path | None = None,
    replace: bool = False,
    began: Callable[[int], None] = lambda frames: None,
    advanced: Callable[[], None] = lambda: None,
) -> Cleaned:
    """Clean a recording or file of poses to a recording, .npz or .csv, and the .csv ``events``; whole, or not at all.

    Args:
        settings: ``[prior]``, ``[trajectory]`` and, if it has them, ``[skeletons]`` and ``[events]`` of a launch file;
            and ``rig``, for what a file of motion lacks.
        replace: whether what is at ``out`` may be replaced, if it is a recording or an .npz.
        began: called with the number of frames.
        advanced: called after each.

    Raises LaunchError, RecordingError or NpzError if the input cannot be used, or the output not be made.
    """
    from steadypose.nodes.driving import OfflineRun  # 95 MB of numba: not for commands that only print

    check_replaceable(out, replace=replace, is_file=out.suffix in ARRAY_FILES)
    add_layouts(settings.get("skeletons", {}))
    frames = open_recording(source, settings.get("rig", {}))
    run = OfflineRun(frames, settings, events=events is not None, advanced=advanced)
    began(len(frames))
    started = time.perf_counter()
    write_output(out, run.arrays, lambda: run)
    if events:
        with unfinished(events) as part:
            write_events(part, run.timeline.events())
    return Cleaned(
        frames=len(run.stamps_ns),
        duration_s=float(min(np.ptp(run.stamps_ns), np.diff(run.stamps_ns).clip(0).sum())) / 1e9,
        spent_s=time.perf_counter() - started,
        poses=run.poses,
        refused=dict(run.refused),
        problems=run.diagnosis.texts,
        trusted=run.diagnosis.trusted,
        unread={cause: n for cause, n in frames.refused.items() if n},
    )
