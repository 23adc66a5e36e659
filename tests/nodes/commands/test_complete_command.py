from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import write_npz
from tests.helpers.bodies import waving

import steadypose
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JointState, PoseClean
from steadypose.nodes.commands.complete import complete
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit import optimise


def test_key_frames_become_motion_and_stay_what_they_are(tmp_path: Path, capsys) -> None:
    positions = waving(91)
    keys = np.arange(0, 91, 15)
    stamps = 10**9 + np.round(keys * 1e9 / 30).astype(np.int64)
    source = write_npz(tmp_path / "keys.npz", positions[keys], stamp_ns=stamps)
    assert complete(source, tmp_path / "out.npz", picture=tmp_path / "out.png") == 0
    out = np.load(tmp_path / "out.npz")
    assert out["positions"].shape == (91, 22, 3)
    assert np.abs(out["positions"][keys] - positions[keys]).max() < 1e-6
    assert (out["state"][keys] == JointState.SEEN).all()
    assert (np.delete(out["state"], keys, axis=0) == JointState.IMPUTED).all()
    for name in ("positions", "rotations", "sigma", "world_positions", "contacts"):
        assert np.isfinite(out[name]).all(), name
    assert np.linalg.norm(out["positions"] - positions, axis=-1).mean() < 0.03
    assert (tmp_path / "out.png").stat().st_size > 10_000
    assert "8% of their joints were given" in capsys.readouterr().err


def test_no_confidence_is_as_good_as_no_joint_and_a_recording_comes_of_it(tmp_path: Path) -> None:
    positions = waving(40)
    confidence = np.ones((40, 22))
    confidence[:, J["right_wrist"]] = 0.0
    complete(write_npz(tmp_path / "in.npz", positions, confidence=confidence), tmp_path / "a")
    hidden = positions.copy()
    hidden[:, J["right_wrist"]] = np.nan
    complete(write_npz(tmp_path / "nan.npz", hidden), tmp_path / "b.npz")
    with RecordingReader(tmp_path / "a") as recording:
        assert {POSE_RAW, POSE_CLEAN, POSE_WORLD} <= set(recording.topics)
        cleaned = [m for _, _, m in recording.messages([POSE_CLEAN]) if isinstance(m, PoseClean) and m.bodies]
    found = np.array([message.bodies[0].positions for message in cleaned])
    assert np.array_equal(found, np.load(tmp_path / "b.npz")["positions"])
    assert [message.bodies[0].state[J["right_wrist"]] for message in cleaned] == [JointState.IMPUTED] * 40
    assert np.isnan(cleaned[0].bodies[0].raw_positions[J["right_wrist"]]).all()


def test_another_axis_may_point_up(tmp_path: Path) -> None:
    positions = waving(30)
    positions[10:20] = np.nan
    complete(write_npz(tmp_path / "z.npz", positions), tmp_path / "z_out.npz")
    turned = np.stack([positions[..., 0], -positions[..., 2], positions[..., 1]], axis=-1)
    complete(write_npz(tmp_path / "y.npz", turned, up="-y"), tmp_path / "y_out.npz")
    z, y = (np.load(tmp_path / f"{name}_out.npz") for name in ("z", "y"))
    expected = np.stack([z["positions"][..., 0], -z["positions"][..., 2], z["positions"][..., 1]], axis=-1)
    assert np.allclose(y["positions"], expected, atol=1e-4)
    assert np.allclose(y["rotations"][:, 1:], z["rotations"][:, 1:], atol=1e-3)


def test_several_people_and_one_who_was_away(tmp_path: Path) -> None:
    positions = np.stack([waving(60), waving(60) + [2.0, 0.0, 0.0]], axis=1)
    positions[20:30, 0] = np.nan
    complete(write_npz(tmp_path / "two.npz", positions), tmp_path / "out.npz")
    out = np.load(tmp_path / "out.npz")
    assert out["positions"].shape == (60, 2, 22, 3)
    assert np.isfinite(out["positions"]).all()
    long = np.full((400, 22, 3), np.nan)
    long[:40], long[-40:] = waving(40), waving(40)
    complete(write_npz(tmp_path / "away.npz", long), tmp_path / "away_out.npz")
    assert len(np.load(tmp_path / "away_out.npz")["stamp_ns"]) == 80, "nobody knows what happened in ten seconds"


def test_who_stands_on_the_pelvis_is_given_a_way(tmp_path: Path, capsys) -> None:
    positions = waving(60)
    complete(write_npz(tmp_path / "in.npz", positions - positions[:, :1]), tmp_path / "out.npz")
    assert "the path is predicted from the motion" in capsys.readouterr().err
    out = np.load(tmp_path / "out.npz")
    assert np.ptp(out["positions"][:, 0], axis=0).max() < 1e-6
    assert np.ptp(out["world_positions"][:, 0, :2], axis=0).max() > 1e-3


def test_alternatives_differ_where_nothing_was_given(tmp_path: Path, capsys) -> None:
    positions = waving(60)
    positions[5:, [J["left_elbow"], J["left_wrist"]]] = np.nan
    source = write_npz(tmp_path / "in.npz", positions)
    complete(source, tmp_path / "out.npz", samples=12)
    both = (np.load(tmp_path / f"out{name}.npz")["rotations"] for name in ("", ".1"))
    np.testing.assert_array_equal(*(turned[:5] for turned in both))
    assert f"wrote an alternative: {tmp_path / 'out.12.npz'}" in capsys.readouterr().err
    expected = np.load(tmp_path / "out.npz")
    drawn = [np.load(tmp_path / f"out.{seed}.npz")["positions"] for seed in range(1, 13)]
    known = np.isfinite(positions)
    for other in drawn:
        np.testing.assert_array_equal(other[known], expected["positions"][known])
        forearm = np.linalg.norm(other[:, J["left_wrist"]] - other[:, J["left_elbow"]], axis=-1)
        assert np.ptp(forearm) < 0.01
    off = np.linalg.norm(np.array(drawn) - expected["positions"], axis=-1)[:, 25:, J["left_wrist"]]
    assert 0.6 < np.sqrt((off**2).mean() / 3) / expected["sigma"][25:, J["left_wrist"]].mean() < 1.2
    again = steadypose.complete(positions, fps=30.0, seed=3)
    np.testing.assert_allclose(again.positions, drawn[2], atol=1e-6)


def test_hm_vae_may_be_searched_and_meets_what_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimise, "LATENT_STEPS", 2)
    monkeypatch.setattr(optimise, "DECODER_STEPS", 1)
    positions = waving(30)
    positions[10:20] = np.nan
    source = write_npz(tmp_path / "in.npz", positions)
    complete(source, tmp_path / "out.npz")
    complete(source, tmp_path / "searched.npz", optimise=True)
    found, searched = (np.load(tmp_path / f"{name}.npz")["positions"] for name in ("out", "searched"))
    known = np.isfinite(positions)
    np.testing.assert_allclose(searched[known], found[known], atol=1e-5)
    assert 1e-4 < np.abs(searched - found)[10:20].max() < 0.2


@pytest.mark.parametrize(("out", "more", "match"), [
    ("in.npz", {}, "nothing is written in place"),
    ("no/out.npz", {}, "make it first"),
    ("out.npz", {"picture": Path("a.txt")}, r"ending in \.png"),
    ("out.npz", {"source": Path("mm.npz")}, "expected metres"),
    ("out.npz", {"source": Path("none.npz")}, "expected a body with joints"),
    ("mine.npz", {}, "--force"),
])  # fmt: skip
def test_what_cannot_be_is_said(out: str, more: dict[str, Any], match: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_npz(Path("in.npz"), waving(20))
    write_npz(Path("mm.npz"), waving(20) * 1000)
    write_npz(Path("none.npz"), np.full((5, 22, 3), np.nan))
    Path("mine.npz").write_text("mine")
    asked: dict[str, Any] = {"source": Path("in.npz"), "out": Path(out)} | more
    with pytest.raises((ValueError, FileNotFoundError), match=match):
        complete(**asked)
    assert Path("mine.npz").read_text() == "mine"
    if match == "--force":
        complete(**asked, force=True)
        assert np.load("mine.npz")["positions"].shape == (20, 22, 3)
