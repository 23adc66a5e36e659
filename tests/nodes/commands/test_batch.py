"""`steadypose clean DIR OUT`: all of a folder, many at once, and what is left of it after a stop."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import record, walk
from rich.console import Console

from steadypose.nodes.commands import batch
from steadypose.nodes.commands.batch import Job, _Worker, find_recordings, is_folder_of_recordings, on_cores, plan, work
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.settings import LaunchError

pytestmark = pytest.mark.slow

FRAMES = 15


@pytest.fixture
def options(weights: dict[str, str]) -> tuple[str, ...]:
    return tuple(f"{key.removeprefix('prior.')}={value}" for key, value in weights.items())


@pytest.fixture
def settings(weights: dict[str, str]) -> dict[str, Any]:
    return {
        "prior": {"refine": {"weights": weights["prior.refine.weights"]}},
        "trajectory": {"weights": weights["trajectory.weights"]},
    }


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """All work in this process; the jobs that were done."""
    done: list[Job] = []

    def work_here(jobs, settings, cores) -> Iterator[tuple[Job, dict[str, Any]]]:
        for job in jobs:
            done.append(job)
            yield job, work(job, settings)

    monkeypatch.setattr(batch, "on_cores", work_here)
    return done


def write_npz(path: Path, frames: int = FRAMES) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    positions = np.array([frame.bodies[0].positions for frame in walk(frames)])
    np.savez(path, positions=positions, skeleton="smpl22", fps=30.0)
    return path


def a_folder(path: Path) -> Path:
    """A file, one deeper down, one that is broken, and a recording."""
    write_npz(path / "a.npz")
    write_npz(path / "day" / "b.npz")
    (path / "broken.npz").write_bytes(b"no zip")
    record(path / "day" / "c", walk(FRAMES))
    return path


def lines(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_processes_clean_a_folder(tmp_path: Path, options: tuple[str, ...], settings: dict[str, Any]) -> None:
    source, out = a_folder(tmp_path / "in"), tmp_path / "out"
    assert clean(source, out, settings=options, jobs=2) == 1, "one is broken"
    assert names(out) == {"manifest.jsonl", "a.npz", "day/b.npz", "day/c/c_0.mcap", "day/c/metadata.yaml"}
    told = {line["input"]: line for line in lines(out)}
    assert {name: line["state"] for name, line in told.items()} == {
        "a.npz": "done", "broken.npz": "failed", "day/b.npz": "done", "day/c": "done",
    }  # fmt: skip
    assert "cannot be read as .npz" in told["broken.npz"]["error"]
    assert (told["a.npz"]["frames"], told["a.npz"]["poses"]) == (FRAMES, FRAMES)
    clean_recording(source / "a.npz", tmp_path / "alone.npz", settings)
    with np.load(out / "a.npz") as many, np.load(tmp_path / "alone.npz") as alone:
        for name in alone.files:
            np.testing.assert_array_equal(many[name], alone[name])


def test_what_is_done_is_not_done_again(
    tmp_path: Path, options: tuple[str, ...], here: list[Job], monkeypatch: pytest.MonkeyPatch
) -> None:
    source, out = a_folder(tmp_path / "in"), tmp_path / "out"
    assert clean(source, out, settings=options) == 1
    assert len(here) == 4
    here.clear()
    write_npz(source / "broken.npz")  # mended
    write_npz(source / "day" / "b.npz", frames=FRAMES + 5)  # changed
    (out / "a.npz").unlink()  # lost
    assert clean(source, out, settings=options) == 0
    assert [job.source.name for job in here] == ["a.npz", "broken.npz", "b.npz"]
    here.clear()
    assert clean(source, out, settings=options) == 0
    assert not here
    assert clean(source, out, settings=(*options, "person.enabled=false")) == 0
    assert len(here) == 4, "other settings, other results"
    here.clear()
    monkeypatch.setattr(batch, "_models", lambda: "of another release")
    assert clean(source, out, settings=(*options, "person.enabled=false")) == 0
    assert len(here) == 4, "other models, other results"


def test_the_last_line_cut_short_does_not_spoil_the_next(tmp_path: Path, options, here: list[Job]) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    write_npz(source / "a.npz")
    out.mkdir()
    (out / "manifest.jsonl").write_text('{"input": "a.npz", "sta')
    assert clean(source, out, settings=options) == 0
    here.clear()
    assert clean(source, out, settings=options) == 0
    assert not here


class Deadly:
    """Ends the process that unpickles it, as a fault in a library would."""

    def __reduce__(self):
        return os._exit, (3,)


def test_a_process_that_dies_takes_one_recording_with_it(tmp_path: Path) -> None:
    (tmp_path / "broken.npz").write_bytes(b"no zip")
    broken = Job(tmp_path / "broken.npz", tmp_path / "out.npz")
    deadly = Job(Deadly(), tmp_path / "out")  # type: ignore[arg-type]
    results = [result["error"] for _, result in on_cores([deadly, broken, deadly, broken], {}, 1)]
    assert ["status 3" in error for error in results] == [True, False, True, False]
    assert all("cannot be read as .npz" in error for error in results[1::2])


def test_a_process_that_died_between_two_recordings_takes_one_with_it(tmp_path: Path) -> None:
    worker = object.__new__(_Worker)
    worker.connection, theirs = multiprocessing.Pipe()
    worker.process = Mock(wait=lambda: -9)
    theirs.close()
    worker.send(Job(tmp_path / "a.npz", tmp_path / "b.npz"))
    assert worker.receive() == {"state": "failed", "error": "the process that cleaned it ended with status -9"}


def test_an_output_is_whole_or_not_there(tmp_path: Path, settings, monkeypatch: pytest.MonkeyPatch) -> None:
    source = record(tmp_path / "in", walk(FRAMES))
    clean_recording(source, tmp_path / "out", settings)
    before = names(tmp_path)

    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("steadypose.nodes.commands.output.RecordingWriter.write", fail)
    with pytest.raises(OSError, match="no space"):
        clean_recording(source, tmp_path / "out", settings, replace=True)
    with pytest.raises(LaunchError, match="or --force to replace it"):
        clean_recording(source, tmp_path / "out", settings)
    assert names(tmp_path) == before


def test_nothing_is_replaced_that_was_not_made_here(tmp_path: Path, options, here: list[Job]) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    record(source / "a", walk(FRAMES))
    write_npz(source / "b.npz")
    (out / "a").mkdir(parents=True)
    (out / "a" / "thesis.txt").write_text("years of work")
    (out / "b.npz").write_text("mine")
    (out / "manifest.jsonl").write_text('{"name": "a manifest", "of": "somebody else"}\n')
    before = {path: path.read_text() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(LaunchError, match="is not of an earlier call"):
        clean(source, out, settings=options)
    # nor with a manifest of ours that knows nothing of it
    (out / "manifest.jsonl").write_text("")
    before[out / "manifest.jsonl"] = ""
    assert clean(source, out, settings=options) == 1
    assert [line["error"].partition(":")[2] for line in lines(out)] == [
        " expected a new path, or --force to replace it"
    ] * 2
    assert (out / "a" / "thesis.txt").read_text() == "years of work"
    assert (out / "b.npz").read_text() == "mine"
    for path in (out / "a", out / "b.npz"):
        with pytest.raises(LaunchError, match="--force"):
            clean(source / path.name, path, settings=options)
    with pytest.raises(LaunchError, match=r"is no recording, and is not replaced: .* holds thesis.txt"):
        clean(source / "a", out / "a", settings=options, force=True)
    assert (out / "a" / "thesis.txt").read_text() == "years of work"
    (out / ".c.part").mkdir()
    (out / ".c.part" / "also mine").touch()
    with pytest.raises(LaunchError, match="is in the way, and was not made here"):
        clean(source / "a", out / "c", settings=options)
    assert (out / ".c.part" / "also mine").exists()
    assert clean(source / "b.npz", out / "b.npz", settings=options, force=True) == 0
    with np.load(out / "b.npz") as cleaned:
        assert len(cleaned["positions"]) == FRAMES


def test_recordings_are_told_from_folders_of_them(tmp_path: Path) -> None:
    one = record(tmp_path / "one", walk(2))
    killed = record(tmp_path / "killed", walk(2))
    (killed / "metadata.yaml").unlink()
    for name in ("x", "y"):
        (tmp_path / "loose").mkdir(exist_ok=True)
        (tmp_path / "loose" / f"{name}.mcap").write_bytes((killed / "killed_0.mcap").read_bytes())
    write_npz(tmp_path / ".hidden" / "a.npz", frames=2)
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "table.csv").touch()
    assert [is_folder_of_recordings(path) for path in (one, killed, tmp_path / "loose", tmp_path)] == [
        False, False, True, True,
    ]  # fmt: skip
    found = find_recordings(tmp_path)
    assert [str(path.relative_to(tmp_path)) for path in found] == [
        "killed", "loose/x.mcap", "loose/y.mcap", "one", "table.csv",
    ]  # fmt: skip
    outputs = [str(job.out) for job in plan(tmp_path, Path("o"))]
    assert outputs == ["o/killed", "o/loose/x", "o/loose/y", "o/one", "o/table.npz"]


@pytest.mark.parametrize(
    ("out", "more", "expected"),
    [
        ("in/out", {}, "apart from"),
        ("used", {}, "manifest.jsonl of an earlier call"),
        ("out", {"jobs": 0}, "expected 1 or more, got 0"),
        ("out", {"jobs": 2, "ray": True}, "Ray decides"),
        ("out", {"settings": ("refine.enabeld=false",)}, "did you mean 'refine.enabled'"),
    ],
)
def test_what_cannot_be_done_is_said(tmp_path: Path, out: str, more: dict[str, Any], expected: str) -> None:
    source = write_npz(tmp_path / "in" / "a.npz").parent
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "letter.txt").write_text("mine")
    with pytest.raises(LaunchError, match=expected):
        clean(source, tmp_path / out, **more)
    assert not (tmp_path / "out").exists()


def test_folders_that_hold_nothing_or_two_of_a_name(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match="expected recordings"):
        clean(tmp_path, tmp_path.parent / "out")
    record(tmp_path / "walk", walk(2))
    (tmp_path / "walk.mcap").write_bytes((tmp_path / "walk" / "walk_0.mcap").read_bytes())
    (tmp_path / "other.mcap").write_bytes(b"")
    with pytest.raises(LaunchError, match="would both become"):
        clean(tmp_path, tmp_path.parent / "out")


def test_jobs_are_for_folders(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match="--jobs: expected a folder"):
        clean(write_npz(tmp_path / "a.npz"), tmp_path / "b.npz", jobs=2)


def test_a_ray_cluster_gives_the_same(
    tmp_path: Path, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "120")  # on a busy machine it takes longer than the usual 30
    source, out = a_folder(tmp_path / "in"), tmp_path / "out"
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        assert batch.clean_folder(source, out, settings, None, True, Console(stderr=True)) == 1
    finally:
        ray.shutdown()
    assert sorted(line["state"] for line in lines(out) if line["state"] != "started") == [
        "done",
        "done",
        "done",
        "failed",
    ]
    clean_recording(source / "a.npz", tmp_path / "alone.npz", settings)
    with np.load(out / "a.npz") as many, np.load(tmp_path / "alone.npz") as alone:
        np.testing.assert_array_equal(many["world_positions"], alone["world_positions"])


def test_without_ray_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(LaunchError, match=r"the extra .ray."):
        list(batch.on_ray([], {}))
