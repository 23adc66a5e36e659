"""A folder of recordings, cleaned many at once: on the cores at hand, or on a Ray cluster.

A manifest in the output folder has a line for each recording that is to be cleaned, and one when it is. A recording
that is done is not cleaned again, unless it, the settings or the models have changed. So a run that was stopped is
resumed, and one with new recordings does these.
"""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import traceback
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection, Pipe, wait
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from steadypose.nodes.cli import message_of
from steadypose.nodes.commands.output import NO_POSE, UNTRUSTED, clean_recording
from steadypose.nodes.driving import Settings
from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.process import own_command, own_environment
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.npz import SUFFIXES

MANIFEST = "manifest.jsonl"
_LINE = '{"input": '  # how each line of it begins
FILES = (".npz", ".csv", *SUFFIXES)  # endings of files of poses that are cleaned into an .npz each
CLEAN = "clean"


@dataclass(frozen=True)
class Job:
    """A recording to clean, and where to."""

    source: Path
    out: Path
    replace: bool = False  # whether an earlier call made what is at ``out``


def is_folder_of_recordings(path: Path) -> bool:
    """Whether this is a folder for recordings rather than one recording, which is a folder too."""
    return path.is_dir() and not _is_recording(path)


def _is_recording(folder: Path) -> bool:
    # the metadata is missing where the recorder was killed
    files = list(folder.glob("*.mcap"))
    parts = all(re.fullmatch(rf"{re.escape(folder.name)}_\d+", file.stem) for file in files)
    return (folder / "metadata.yaml").exists() or (bool(files) and (len(files) == 1 or parts) and not _files(folder))


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.is_file() and path.suffix in FILES]


def find_recordings(folder: Path) -> list[Path]:
    """The recordings and files of poses in a folder at any depth, hidden ones apart, in alphabetical order."""
    found = [*_files(folder), *folder.glob("*.mcap")]
    for inner in folder.iterdir():
        if inner.is_dir() and not inner.is_symlink() and not inner.name.startswith("."):
            found += [inner] if _is_recording(inner) else find_recordings(inner)
    return sorted(path for path in found if not path.name.startswith("."))


def plan(folder: Path, out: Path) -> list[Job]:
    """A job for each recording: recordings stay recordings, files of poses become .npz, names and folders stay.

    Raises LaunchError if there are none, or two of them would come to the same output.
    """
    jobs: dict[Path, Job] = {}
    for source in find_recordings(folder):
        target = out / source.relative_to(folder)
        if source.suffix in FILES:
            target = target.with_suffix(".npz")
        elif source.is_file():
            target = target.with_suffix("")
        if target in jobs:
            raise LaunchError(f"{jobs[target].source} and {source} would both become {target}: rename one of them")
        jobs[target] = Job(source, target)
    if not jobs:
        raise LaunchError(f"{folder}: expected rosbag2 directories, .mcap, {', '.join(FILES)}; got none")
    return list(jobs.values())


def clean_folder(folder: Path, out: Path, settings: Settings, jobs: int | None, ray: bool, console: Console) -> int:
    """Clean all recordings of a folder that are not cleaned yet: ``jobs`` at once (None: one a core), or with Ray.

    Returns the exit status: 0 if all are clean, those that were done before included. Raises LaunchError if nothing can
    be done at all.
    """
    folder, out = folder.resolve(), out.resolve()
    if out.is_relative_to(folder) or folder.is_relative_to(out):
        raise LaunchError(f"{out}: expected a folder apart from {folder}, or results would be cleaned too")
    if jobs is not None and (ray or jobs < 1):
        raise LaunchError("--jobs: " + ("Ray decides how many" if ray else f"expected 1 or more, got {jobs}"))
    found = plan(folder, out)
    manifest = Manifest(out, folder, settings)
    done = {job: result for job in found if (result := manifest.result(job))}
    waiting = [replace(job, replace=manifest.made(job.out)) for job in found if job not in done]
    if done:
        console.print(f"{len(done)} of {len(found)} are done already; see {manifest.path}")
    for job in waiting:
        if job.replace or not os.path.lexists(job.out):
            manifest.add(job, {"state": "started"})
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    cleaning = on_ray(waiting, settings) if ray else on_cores(waiting, settings, jobs or cores)
    outcomes = Counter(outcome(job, result)[0] for job, result in done.items())
    with Progress(console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task(folder.name, total=len(found), completed=len(done))
        for job, result in cleaning:
            manifest.add(job, result)
            progress.advance(bar)
            for problem in result.get("problems", ()):
                console.print(f"{job.source}: {problem}", style="yellow")
            became, why = outcome(job, result)
            outcomes[became] += 1
            if why:
                console.print(f"{job.source}: {why}", style="red")
    others = ", ".join(f"{count} {what}" for what, count in outcomes.items() if what != CLEAN)
    console.print(f"{out}: {outcomes[CLEAN]} of {len(found)} recordings are clean{others and f'; {others}'}")
    return 0 if outcomes[CLEAN] == len(found) else 1


def outcome(job: Job, result: Mapping[str, Any]) -> tuple[str, str]:
    """What became of a recording, by its entry in the manifest; and why it is not clean, empty if it is."""
    if result["state"] == "failed":
        return "failed", result["error"].removeprefix(f"{job.source}: ")
    if not result["poses"]:
        return "without anybody in it", NO_POSE
    if result["unread"]:
        return "damaged", "damaged; " + ", ".join(f"{cause}: {n}" for cause, n in result["unread"].items())
    if not result.get("trusted", True):  # earlier versions did not note it
        return "not to be trusted", UNTRUSTED
    return CLEAN, ""


class Manifest:
    """The result of each recording of ``folder``: ``out/manifest.jsonl``, a JSON object a line; the last counts.

    Raises LaunchError if the output folder holds something else.
    """

    def __init__(self, out: Path, folder: Path, settings: Settings) -> None:
        self.path = out / MANIFEST
        self._out, self._folder, self._settings, self._models = out, folder, settings, _models()
        self._known: dict[str, dict[str, Any]] = {}
        if self.path.exists():
            text = self.path.read_text(encoding="utf-8", errors="replace")
            if not all(line[: len(_LINE)] == _LINE[: len(line)] for line in text.splitlines()):
                raise LaunchError(f"{self.path} is not of an earlier call: expected a new folder, or one of this")
            if text and not text.endswith("\n"):  # cut short by whatever stopped the run that wrote it
                with self.path.open("a", encoding="utf-8") as file:
                    file.write("\n")
            for line in text.splitlines():
                with suppress(ValueError, KeyError, TypeError, RecursionError):  # a line cut short, or spoilt
                    entry = json.loads(line)
                    self._known[entry["input"]] = entry
        elif out.exists() and any(out.iterdir()):
            raise LaunchError(f"{out}: expected a new folder, or one with the {MANIFEST} of an earlier call")
        out.mkdir(exist_ok=True)

    def made(self, out: Path) -> bool:
        """Whether an earlier call made what is at this path, or began to."""
        output = str(out.relative_to(self._out))
        return any(e.get("state") in ("started", "done") and e.get("output") == output for e in self._known.values())

    def result(self, job: Job) -> dict[str, Any] | None:
        """The result of this recording, as it is now, with these settings; None if it was not cleaned so."""
        entry = self._known.get(str(job.source.relative_to(self._folder)), {})
        done = entry.get("state") == "done" and job.out.exists() and entry.items() >= self._signature(job).items()
        return entry if done else None

    def add(self, job: Job, result: dict[str, Any]) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(self._signature(job) | result) + "\n")

    def _signature(self, job: Job) -> dict[str, Any]:
        """What a result belongs to: the recording, by size and time of change, the settings, and the models."""
        files = sorted(job.source.rglob("*")) if job.source.is_dir() else [job.source]
        status = [file.stat() for file in files if file.exists()]
        return {
            "input": str(job.source.relative_to(self._folder)),
            "bytes": sum(s.st_size for s in status),
            "changed_ns": max((s.st_mtime_ns for s in status), default=0),
            "settings": json.loads(json.dumps(self._settings)),
            "models": self._models,
            "output": str(job.out.relative_to(self._out)),
        }


def _models() -> str:
    """A digest of the weights that ship, which differs from that of another release."""
    from steadypose.prior.models import weights as checkpoint

    files = sorted(file for file in checkpoint.WEIGHTS.iterdir() if file.suffix in (".safetensors", ".json"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def work(job: Job, settings: Settings) -> dict[str, Any]:
    """Clean one recording; a failure is a result, too."""
    try:
        return {"state": "done"} | asdict(clean_recording(job.source, job.out, settings, replace=job.replace))
    except Exception as error:  # any file may hold what nobody thought of, and the others wait
        return _failed(message_of(error) or "".join(traceback.format_exception_only(error)).strip())


def _failed(error: str) -> dict[str, Any]:
    return {"state": "failed", "error": error}


def on_cores(jobs: Iterable[Job], settings: Settings, cores: int) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Clean recordings in processes of this machine; yields each result as it comes.

    A process that dies, for want of memory or by a fault in a library, takes one recording with it, not the rest.
    Processes of `multiprocessing` would import modules of the working folder.
    """
    waiting = deque(jobs)
    idle: list[_Worker] = []
    busy: dict[Connection, _Worker] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < cores:
                worker = idle.pop() if idle else _Worker(settings)
                worker.send(waiting.popleft())
                busy[worker.connection] = worker
            for connection in wait(list(busy)):
                worker = busy.pop(connection)  # type: ignore[index]  (all that is waited for are connections)
                result = worker.receive()
                if worker.process.poll() is None:
                    idle.append(worker)
                yield worker.job, result
    finally:
        for worker in [*idle, *busy.values()]:
            worker.process.kill()  # whatever it writes is not in its place before it is whole
            worker.process.wait()


class _Worker:
    """A process that cleans one recording after the other."""

    job: Job

    def __init__(self, settings: Settings) -> None:
        self.connection, theirs = Pipe()
        end = theirs.fileno()
        serve = own_command("steadypose.nodes.commands.batch:serve", str(end))
        self.process = subprocess.Popen(serve, pass_fds=[end], stdin=subprocess.DEVNULL, env=own_environment())
        theirs.close()  # so that its end closes with the process
        with suppress(OSError):
            self.connection.send(settings)

    def send(self, job: Job) -> None:
        self.job = job
        with suppress(OSError):  # if the process has died since its last job, `receive` says so
            self.connection.send(job)

    def receive(self) -> dict[str, Any]:
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self.process.wait()  # so that it is not given another job
            return _failed("the process that cleaned it died; if memory was short, give fewer --jobs")


def serve() -> None:
    """Clean what comes through a connection, until it is closed."""
    connection = Connection(int(sys.argv[1]))
    settings = connection.recv()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one, which ends it
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        connection.send(work(job, settings))


def on_ray(jobs: Iterable[Job], settings: Settings) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Clean recordings on a Ray cluster, one a core; yields each result. Raises LaunchError if Ray is not installed."""
    require_extra("ray")
    import ray  # pyright: ignore[reportMissingImports]

    ray.init(ignore_reinit_error=True, log_to_driver=False)
    remote = ray.remote(num_cpus=1, max_retries=0)(work)
    pending = {remote.remote(job, settings): job for job in jobs}
    while pending:
        for reference in ray.wait(list(pending))[0]:
            try:
                result = ray.get(reference)
            except ray.exceptions.RayError as error:
                result = _failed(str(error))
            yield pending.pop(reference), result
