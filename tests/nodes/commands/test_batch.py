import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import record, walk, walked, write_npz

from steadypose.nodes.commands import batch
from steadypose.nodes.commands.batch import Job, find_recordings, is_folder_of_recordings, on_cores, plan, work
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.settings import LaunchError

pytestmark = pytest.mark.slow

FRAMES = 15
WALK = walked(FRAMES)
DEFAULT: dict[str, Any] = {"prior": {}, "trajectory": {}}


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


def a_folder(path: Path) -> Path:
    """A file, one deeper down, one that is broken, and a recording."""
    (path / "day").mkdir(parents=True)
    write_npz(path / "a.npz", WALK)
    write_npz(path / "day" / "b.npz", WALK)
    (path / "broken.npz").write_bytes(b"no zip")
    record(path / "day" / "c", walk(FRAMES))
    return path


def lines(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("ray", [False, True])
def test_processes_or_a_cluster_clean_a_folder(tmp_path: Path, ray: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if ray:
        pytest.importorskip("ray", reason="the extra 'ray' is not installed")
        monkeypatch.setenv("RAY_raylet_start_wait_time_s", "120")  # on a busy machine it takes longer than the usual 30
    source, out = a_folder(tmp_path / "in"), tmp_path / "out"
    assert clean(source, out, jobs=None if ray else 2, ray=ray) == 1, "one is broken"
    assert names(out) == {"manifest.jsonl", "a.npz", "day/b.npz", "day/c/c_0.mcap", "day/c/metadata.yaml"}
    states = {line["input"]: line for line in lines(out)}
    assert {name: line["state"] for name, line in states.items()} == {
        "a.npz": "done", "broken.npz": "failed", "day/b.npz": "done", "day/c": "done",
    }  # fmt: skip
    assert "cannot be read as .npz" in states["broken.npz"]["error"]
    assert (states["a.npz"]["frames"], states["a.npz"]["poses"]) == (FRAMES, FRAMES)
    clean_recording(source / "a.npz", tmp_path / "alone.npz", DEFAULT)
    with np.load(out / "a.npz") as many, np.load(tmp_path / "alone.npz") as alone:
        for name in alone.files:
            np.testing.assert_array_equal(many[name], alone[name])


def test_what_is_done_is_not_done_again(tmp_path: Path, here: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    source, out = a_folder(tmp_path / "in"), tmp_path / "out"
    assert clean(source, out) == 1
    assert len(here) == 4
    here.clear()
    write_npz(source / "broken.npz", WALK)  # mended
    write_npz(source / "day" / "b.npz", WALK[5:])  # changed
    (out / "a.npz").unlink()  # lost
    assert clean(source, out) == 0
    assert [job.source.name for job in here] == ["a.npz", "broken.npz", "b.npz"]
    here.clear()
    assert clean(source, out) == 0
    assert not here
    assert clean(source, out, settings=("person.enabled=false",)) == 0
    assert len(here) == 4, "other settings, other results"
    here.clear()
    monkeypatch.setattr(batch, "_models", lambda: "of another release")
    assert clean(source, out, settings=("person.enabled=false",)) == 0
    assert len(here) == 4, "other models, other results"


@pytest.mark.parametrize("line", ['{"input": "a.npz", "sta', '{"input": ["a.npz"]}', '{"input": ' + 100_000 * "["])
def test_a_line_cut_short_or_spoilt_does_not_spoil_the_next(tmp_path: Path, here: list[Job], line: str) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    out.mkdir()
    write_npz(source / "a.npz", WALK)
    (out / "manifest.jsonl").write_text(line)
    assert clean(source, out) == 0
    here.clear()
    assert clean(source, out) == 0
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
    assert ["process that cleaned it died" in error for error in results] == [True, False, True, False]
    assert all("cannot be read as .npz" in error for error in results[1::2])


def test_an_output_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = record(tmp_path / "in", walk(FRAMES))
    clean_recording(source, tmp_path / "out", DEFAULT)
    before = names(tmp_path)

    full_disk = Mock(side_effect=OSError("no space left on device"))
    monkeypatch.setattr("steadypose.nodes.commands.output.RecordingWriter.write", full_disk)
    with pytest.raises(OSError, match="no space"):
        clean_recording(source, tmp_path / "out", DEFAULT, replace=True)
    with pytest.raises(LaunchError, match="or --force to replace it"):
        clean_recording(source, tmp_path / "out", DEFAULT)
    assert names(tmp_path) == before


def test_nothing_is_replaced_that_was_not_made_here(tmp_path: Path, here: list[Job]) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    record(source / "a", walk(FRAMES))
    write_npz(source / "b.npz", WALK)
    (out / "a").mkdir(parents=True)
    (out / "a" / "thesis.txt").write_text("years of work")
    (out / "b.npz").write_text("mine")
    (out / "manifest.jsonl").write_text('{"name": "a manifest", "of": "somebody else"}\n')
    before = {path: path.read_text() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(LaunchError, match="is not of an earlier call"):
        clean(source, out)
    # nor with a manifest of ours that knows nothing of it
    (out / "manifest.jsonl").write_text("")
    before[out / "manifest.jsonl"] = ""
    assert clean(source, out) == 1
    errors = [line["error"].partition(":")[2] for line in lines(out)]
    assert errors == [" expected a new path, or --force to replace it"] * 2
    assert (out / "a" / "thesis.txt").read_text() == "years of work"
    assert (out / "b.npz").read_text() == "mine"
    for path in (out / "a", out / "b.npz"):
        with pytest.raises(LaunchError, match="--force"):
            clean(source / path.name, path)
    with pytest.raises(LaunchError, match=r"is no recording, and is not replaced: .* holds thesis.txt"):
        clean(source / "a", out / "a", force=True)
    assert (out / "a" / "thesis.txt").read_text() == "years of work"
    (out / ".c.part").mkdir()
    (out / ".c.part" / "also mine").touch()
    with pytest.raises(LaunchError, match="is in the way, and was not made here"):
        clean(source / "a", out / "c")
    assert (out / ".c.part" / "also mine").exists()
    assert clean(source / "b.npz", out / "b.npz", force=True) == 0
    with np.load(out / "b.npz") as cleaned:
        assert len(cleaned["positions"]) == FRAMES


def test_recordings_are_told_from_folders_of_them(tmp_path: Path) -> None:
    one = record(tmp_path / "one", walk(2))
    killed = record(tmp_path / "killed", walk(2))
    (killed / "metadata.yaml").unlink()
    for name in ("x", "y"):
        (tmp_path / "loose").mkdir(exist_ok=True)
        (tmp_path / "loose" / f"{name}.mcap").write_bytes((killed / "killed_0.mcap").read_bytes())
    (tmp_path / ".hidden").mkdir()
    write_npz(tmp_path / ".hidden" / "a.npz", WALK)
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "table.csv").touch()
    paths = (one, killed, tmp_path / "loose", tmp_path)
    assert [is_folder_of_recordings(path) for path in paths] == [False, False, True, True]
    found = find_recordings(tmp_path)
    expected = ["killed", "loose/x.mcap", "loose/y.mcap", "one", "table.csv"]
    assert [str(path.relative_to(tmp_path)) for path in found] == expected
    outputs = [str(job.out) for job in plan(tmp_path, Path("o"))]
    assert outputs == ["o/killed", "o/loose/x", "o/loose/y", "o/one", "o/table.npz"]


@pytest.mark.parametrize(("source", "out", "more", "expected"), [
    ("in", "in/out", {}, "apart from"),
    ("in", "used", {}, "manifest.jsonl of an earlier call"),
    ("in", "out", {"jobs": 0}, "expected 1 or more, got 0"),
    ("in", "out", {"jobs": 2, "ray": True}, "Ray decides"),
    ("empty", "out", {}, "expected rosbag2 directories"),
    ("twice", "out", {}, "would both become"),
    ("in/a.npz", "out", {"jobs": 2}, "--jobs: expected a folder"),
])  # fmt: skip
def test_what_cannot_be_done_is_said(tmp_path: Path, source: str, out: str, more: dict[str, Any], expected: str):
    for name in ("in", "used", "empty", "twice"):
        (tmp_path / name).mkdir()
    write_npz(tmp_path / "in" / "a.npz", WALK)
    (tmp_path / "used" / "letter.txt").write_text("mine")
    record(tmp_path / "twice" / "walk", walk(2))
    (tmp_path / "twice" / "walk.mcap").write_bytes((tmp_path / "twice" / "walk" / "walk_0.mcap").read_bytes())
    (tmp_path / "twice" / "other.mcap").write_bytes(b"")
    with pytest.raises(LaunchError, match=expected):
        clean(tmp_path / source, tmp_path / out, **more)
    assert not (tmp_path / "out").exists()
