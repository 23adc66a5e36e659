import json
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tests.training.data.test_motion_datasets import idle_bvh, pack, unpack

from steadypose.nodes.commands.prepare import find_sources, prepare
from steadypose.nodes.settings import LaunchError
from steadypose.prior.body.capsules import TOE_HEIGHT
from steadypose.prior.body.kinematics import forward_kinematics
from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.mocap.clip import Clip, MotionError
from steadypose.prior.timing.rate import FPS
from steadypose.training.data import prepare as preparing
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.datasets import SPLITS
from steadypose.training.data.prepare import Prepared, find_faults, prepare_clip, stays_on_floor, write_prepared
from steadypose.training.data.readers import Dropped

Array = NDArray[np.float64]


def standing(frames: int, height: float = 0.0) -> Array:
    """The rest pose, its toes ``height`` above the floor's toe height."""
    body = REST_POSITIONS.copy()
    body[:, 2] += height + TOE_HEIGHT - body[J["left_foot"], 2]
    return np.tile(body, (frames, 1, 1))


def a_clip(positions: Array, fps: float = FPS) -> Clip:
    return Clip("clip", "source", "licence", "subject", "action", fps, CANONICAL, positions)


def test_downsampling_keeps_slow_motion_in_time_and_takes_out_what_would_alias() -> None:
    time = np.arange(480) / 120
    slow = 0.3 * np.sin(2 * np.pi * 2 * time)
    # At 30 Hz, 28 Hz would come out as 2 Hz.
    fast = 0.1 * np.sin(2 * np.pi * 28 * time)
    out = preparing.resample(np.stack([slow, fast], axis=-1)[:, None, :].repeat(2, axis=-1)[..., :3], 120.0)
    assert len(out) == 120
    inner = slice(15, -15)
    np.testing.assert_allclose(out[inner, 0, 0], 0.3 * np.sin(2 * np.pi * 2 * np.arange(120) / 30)[inner], atol=2e-3)
    assert np.abs(out[inner, 0, 2]).max() < 0.004


@given(fps=st.sampled_from([24.0, 25.0, 50.0, 59.94, 60.0, 100.0, 120.0]), frames=st.integers(40, 200))
def test_resampling_is_by_time(fps: float, frames: int) -> None:
    time = np.arange(frames) / fps
    out = preparing.resample((time[:, None, None] * [1.0, -2.0, 0.5])[:, :, :], fps)
    at = np.arange(len(out)) / FPS
    assert time[-1] - 1 / FPS < at[-1] <= time[-1] + 1e-6
    np.testing.assert_allclose(out[:, 0], at[:, None] * [1.0, -2.0, 0.5], atol=2e-3)


@given(start=st.integers(0, 30), length=st.integers(1, 12))
def test_only_short_gaps_between_observations_are_filled(start: int, length: int) -> None:
    line = np.arange(31)[:, None, None] * np.array([0.1, 0.2, -0.1]) + np.zeros((1, 2, 1))
    holed = line.copy()
    holed[start : start + length, 1] = np.nan
    filled = preparing.fill_gaps(holed, FPS)
    inside = start > 0 and start + length < 31 and length <= 6  # 0.2 s
    assert np.isfinite(filled[:, 1]).all() == inside
    np.testing.assert_array_equal(filled[:, 0], line[:, 0])
    if inside:
        np.testing.assert_allclose(filled, line, atol=1e-12)


@pytest.mark.parametrize("height", [-1.2, 0.0, 0.4])
def test_the_floor_is_where_toes_rest_or_under_the_lower_toe(height: float) -> None:
    body = standing(90, height)
    # One foot lifted for a while, and one bad frame below the floor.
    body[30:60, J["left_foot"], 2] += 0.3
    body[70, J["right_foot"], 2] -= 0.2
    assert preparing.floor_height(body) == pytest.approx(height, abs=0.002)
    flying = standing(60, height)
    flying[:, :, 0] += 3.0 * np.arange(60)[:, None] / FPS
    flying[::2, :, 2] += 0.1
    flying[:, J["left_foot"], 2] += 0.3
    assert preparing.floor_height(flying) == pytest.approx(height, abs=0.002)


def test_standing_on_something_is_not_staying_on_the_floor() -> None:
    body = standing(90)
    assert stays_on_floor(body)
    body[60:, :, 2] += 0.4
    assert not stays_on_floor(body)
    body = standing(90)
    body[:, J["left_foot"], 2] += 0.4  # on one leg
    assert stays_on_floor(body)


def test_faults_are_found_where_they_are_and_named() -> None:
    body = standing(60)
    bad, words = find_faults(body)
    assert not bad.any()
    assert words == ""
    stretched = body.copy()
    stretched[10:13, J["left_wrist"], 1] += 0.15 * np.array([1, 1.08, 1])
    bad, words = find_faults(stretched)
    assert "bone to left_wrist is 16 cm off its length at 0.4 s" in words
    assert set(range(10, 13)) <= set(np.flatnonzero(bad)) <= set(range(8, 15))
    thrown = body.copy()
    thrown[30:] += [2.0, 0, 0]
    bad, words = find_faults(thrown)
    assert "accelerates by 1800 m/s²" in words
    np.testing.assert_array_equal(np.flatnonzero(bad), [28, 29, 30, 31])


def cut_in_two(positions: Array) -> tuple[Dropped, Prepared, Prepared]:
    """What comes of a recording of 5 s that is cut once: why, and both parts."""
    cut, first, second = prepare_clip(a_clip(positions), "default", "val")
    assert isinstance(cut, Dropped)
    assert isinstance(first, Prepared)
    assert isinstance(second, Prepared)
    return cut, first, second


def test_a_recording_is_cut_where_a_body_does_what_none_can() -> None:
    positions = standing(150)
    positions[60, J["head"], 0] += 0.5
    positions[80:, J["head"], 0] += 1e-4  # no fault
    cut, *parts = cut_in_two(positions)
    assert cut.kind == "cut: impossible motion"
    assert [(p.clip.name, len(p.clip.positions)) for p in parts] == [("clip@0.0s", 58), ("clip@2.1s", 87)]
    assert [find_faults(p.clip.positions)[1] for p in parts] == ["", ""]


def test_a_recording_with_a_long_gap_is_cut_there_and_says_so() -> None:
    positions = standing(150, height=0.7)
    positions[60:75, J["left_wrist"]] = np.nan
    positions[100:103, J["head"]] = np.nan
    cut, *parts = cut_in_two(positions)
    assert cut.kind.startswith("cut")
    assert cut.cause == "0.50 s of 5.00 s lack left_wrist"
    assert [(p.clip.name, len(p.clip.positions)) for p in parts] == [("clip@0.0s", 60), ("clip@2.5s", 75)]
    assert parts[1].split == "val"
    # Standing: on the floor, feet in contact, rotations that lead back to the positions.
    first = parts[0]
    assert first.clip.positions[:, J["left_foot"], 2] == pytest.approx(TOE_HEIGHT, abs=1e-6)
    np.testing.assert_array_equal(first.contacts, np.tile(np.isin(range(8), range(2, 6)), (60, 1)))
    matrices = Rotation.from_quat(first.rotations.reshape(-1, 4)).as_matrix().reshape(-1, 22, 3, 3)
    rebuilt, _ = forward_kinematics(matrices, first.offsets, first.clip.positions[:, 0])
    np.testing.assert_allclose(rebuilt, first.clip.positions, atol=1e-6)


@pytest.mark.parametrize("frames", [0, 1, 29])
def test_what_is_too_short_is_dropped_in_words(frames: int) -> None:
    [dropped] = prepare_clip(a_clip(standing(frames)), "default", "train")
    assert isinstance(dropped, Dropped)
    assert dropped.kind == "shorter than 1 s"


def test_the_command_prepares_what_it_finds_and_lists_what_it_leaves_out(tmp_path: Path, capsys) -> None:
    mocap = tmp_path / "mocap"
    mocap.mkdir()
    takes = {"001": idle_bvh(72), "014": idle_bvh(72), "002": idle_bvh(12), "003": idle_bvh(72)[:-200]}
    pack(mocap / "reactidle.tar.xz", {f"acted/{take}_acted.bvh": text for take, text in takes.items()})
    own = {"me/wave.bvh": idle_bvh(240, 120), "val/you/wave.bvh": idle_bvh(48), "test/them/wave.bvh": idle_bvh(48)}
    unpack(mocap / "own", own)
    (mocap / "holiday.jpg").write_bytes(b"")
    prepare(mocap, tmp_path / "data", (1.0, 1.6))

    with np.load(tmp_path / "data" / "prepared.npz") as z:
        assert list(zip(z["name"].tolist(), z["split"].tolist(), strict=True)) == [
            ("001_acted", "train"), ("014_acted", "val"), ("me/wave.bvh", "train"), ("me/wave.bvh x1.6", "train"),
            ("test/them/wave.bvh", "test"), ("val/you/wave.bvh", "val"),
        ]  # fmt: skip
        assert set(z["licence"].tolist()) == {"MIT", "own"}
        np.testing.assert_allclose(np.diff(z["clip_start"]), [89, 89, 60, 38, 59, 59])
        assert z["speed"].tolist() == [1.0, 1.0, 1.0, 1.6, 1.0, 1.0]
    report = json.loads((tmp_path / "data" / "prepare-report.json").read_text())
    assert {(d["name"], d["kind"]) for d in report["dropped"]} == {
        ("002_acted", "shorter than 1 s"),
        ("acted/003_acted.bvh", "cannot be read"),
    }
    assert "expected 72 frames" in next(d["cause"] for d in report["dropped"] if d["name"].endswith("003_acted.bvh"))
    printed = capsys.readouterr().out
    assert "ReActIdle" in printed
    assert "Dropped: 2" in printed


def test_preparing_twice_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On another day, from folders that list their files in another order: results name the data by digest."""
    listed = Path.rglob
    files = {f"{who}/{take}.bvh": idle_bvh(48 + number) for number, (who, take) in enumerate(product("abc", "xy"))}
    files["a/short.bvh"] = idle_bvh(12)
    for day, step in enumerate((1, -1)):
        unpack(tmp_path / f"mocap {day}" / "own", files)
        monkeypatch.setattr(Path, "rglob", lambda path, pattern, step=step: sorted(listed(path, pattern))[::step])
        monkeypatch.setattr(time, "time", lambda day=day: 1.6e9 + 86400.0 * day)
        prepare(tmp_path / f"mocap {day}", tmp_path / f"data {day}")
    for name in ("prepared.npz", "prepare-report.json"):
        assert (tmp_path / "data 0" / name).read_bytes() == (tmp_path / "data 1" / name).read_bytes(), name


def test_nothing_to_prepare_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match="does not exist"):
        find_sources(tmp_path / "nowhere")
    (tmp_path / "walk.fbx").write_bytes(b"")
    with pytest.raises(LaunchError, match=r"\.bvh.* or files named cmu_amc.*ui_prmd"):
        find_sources(tmp_path)
    unpack(tmp_path / "own", {"1.bvh": "no"})
    with pytest.raises(LaunchError, match=r"nothing usable .* left out: 1\. 1\.bvh: expected HIERARCHY"):
        prepare(tmp_path, tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_motion_without_people_held_out_says_where_to_put_them(tmp_path: Path) -> None:
    (part,) = prepare_clip(a_clip(standing(40)), "default", "train")
    assert isinstance(part, Prepared)
    write_prepared([part], tmp_path / "prepared.npz")
    with pytest.raises(MotionError, match=r"no clip of split 'val'.*into a folder 'val', and prepare again"):
        MotionSet.load(tmp_path / "prepared.npz", "default", "val")


def test_what_only_measures_trains_no_weights_whatever_the_file_says(tmp_path: Path) -> None:
    parts = [p for n in (40, 50, 60, 70) for p in prepare_clip(a_clip(standing(n)), "default", "train")]
    trains, validates, tests, researches = (p for p in parts if isinstance(p, Prepared))
    path = tmp_path / "prepared.npz"
    measured = [replace(part, weights="measure", split=split) for part, split in ((validates, "val"), (tests, "test"))]
    write_prepared([trains, *measured, replace(researches, weights="research")], path)
    frames = {w: [len(MotionSet.load(path, w, s).positions) for s in SPLITS] for w in ("default", "research")}
    assert frames == {"default": [40, 50, 60], "research": [110, 50, 60]}
    # Nor can they be asked for, prepared so, or read from a file that somebody has changed.
    with pytest.raises(MotionError, match="weights: expected one of default, research"):
        MotionSet.load(path, "measure", "train")
    with pytest.raises(MotionError, match="measures"):
        replace(validates, weights="measure")
    with np.load(path) as file:
        arrays = dict(file)
    arrays["split"] = np.full(4, "train")
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    assert len(MotionSet.load(path, "research", "train").positions) == 110


def test_people_are_the_same_in_all_files_of_a_source(tmp_path: Path) -> None:
    clips = [replace(a_clip(standing(40)), source=source, subject="02") for source in ("CMU (AMC)", "CMU (BVH)", "X")]
    path = tmp_path / "prepared.npz"
    write_prepared([p for c in clips for p in prepare_clip(c, "default", "val") if isinstance(p, Prepared)], path)
    assert MotionSet.load(path, "default", "val").person.tolist() == ["CMU 02", "CMU 02", "X 02"]
