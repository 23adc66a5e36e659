from pathlib import Path

import numpy as np
import pytest
from conftest import walked, write_npz
from tests.helpers.smpl_model import model_arrays

import steadypose
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import PoseClean
from steadypose.nodes.cli import main
from steadypose.nodes.sources.key_points import check_up, read_key_points
from steadypose.nodes.sources.npz import NpzError
from steadypose.prior.fit import solve
from steadypose.prior.fit.solve import FitSettings
from steadypose.prior.mocap.files import read_motion

FRAMES = 24
POSITIONS = walked(FRAMES)


@pytest.fixture(autouse=True)
def brief(monkeypatch) -> None:
    """Few steps: what comes of many is measured elsewhere."""
    monkeypatch.setattr(solve, "FitSettings", lambda: FitSettings(root_steps=0, pose_steps=10, motion_steps=10))


@pytest.fixture
def seen(tmp_path: Path) -> Path:
    return write_npz(tmp_path / "in.npz", POSITIONS)


@pytest.fixture
def pictured(tmp_path: Path) -> Path:
    """The same by a level camera, 4 m away."""
    path = tmp_path / "keys.npz"
    np.savez(path, **key_points())
    return path


def in_camera() -> np.ndarray:
    body = POSITIONS.astype(float)
    return np.stack([-body[..., 1], 1.3 - body[..., 2], 4.0 + body[..., 0] - body[:, :1, 0].mean()], axis=-1)


def key_points(**more: object) -> dict:
    optical = in_camera()
    pixels = optical[..., :2] / optical[..., 2:] * 900.0 + [640.0, 360.0]
    pixels[3, 4] = np.nan
    given = {"keypoints": pixels, "skeleton": "smpl22", "fps": 30.0, "focal": 900.0, "centre": [640.0, 360.0]}
    return given | {"camera_height": 1.3} | more


def test_arrays_in_and_out(seen: Path, tmp_path: Path, capsys) -> None:
    assert main(["fit", str(seen), str(tmp_path / "out.npz")]) == 0
    with np.load(tmp_path / "out.npz") as out:
        assert out["positions"].shape == (FRAMES, 22, 3)
        for name in ("positions", "rotations", "world_positions", "root_velocity", "contacts"):
            assert np.isfinite(out[name]).all(), name
        lengths = np.linalg.norm(out["positions"][:, 4] - out["positions"][:, 1], axis=-1)
        off = np.linalg.norm(out["positions"] - POSITIONS, axis=-1)
    np.testing.assert_allclose(lengths, lengths[0], atol=1e-3)
    assert off.mean() < 0.05
    with np.load(tmp_path / "out.npz.misfit.npz") as misfit:
        assert misfit["0/misfit"].shape[1] == 22
        assert misfit["0/offsets"].shape[1:] == (22, 3)
    assert (tmp_path / "out.npz.fit.png").stat().st_size > 1000
    assert not (tmp_path / ".out.npz.fit").exists()
    assert f"{FRAMES} frames, fitted in" in capsys.readouterr().err


def test_a_recording_has_all_topics(seen: Path, tmp_path: Path) -> None:
    assert main(["fit", str(seen), str(tmp_path / "out")]) == 0
    with RecordingReader(tmp_path / "out") as recording:
        messages = list(recording)
    assert {POSE_RAW, POSE_CLEAN, POSE_WORLD} <= {topic for topic, _, _ in messages}
    bodies = [body for _, _, message in messages if isinstance(message, PoseClean) for body in message.bodies]
    assert len(bodies) >= FRAMES - 1
    for body in bodies:
        np.testing.assert_array_equal(body.bone_lengths, bodies[0].bone_lengths)


def test_key_points_become_a_motion_in_the_cameras_frame(pictured: Path, tmp_path: Path) -> None:
    assert main(["fit", str(pictured), str(tmp_path / "out.npz")]) == 0
    with np.load(tmp_path / "out.npz") as out, np.load(pictured) as given:
        assert out["positions"].shape == (FRAMES, 22, 3)
        assert out["positions"][:, 0, 2].mean() == pytest.approx(4.0, abs=1.0)
        projected = out["positions"][..., :2] / out["positions"][..., 2:] * 900.0 + [640.0, 360.0]
        assert np.nanmedian(np.linalg.norm(projected - given["keypoints"], axis=-1)) < 40.0
        normal = out["ground_plane"][:3]
        assert normal[2] > 0.95
        way = np.gradient(out["world_positions"][:, 0], 1 / 30, axis=0)
        np.testing.assert_allclose(out["root_velocity"], way, atol=1e-3)


def test_points_of_the_surface_say_where_somebody_is_and_those_of_nobody_are_as_none(tmp_path: Path) -> None:
    truth, rng, nothing = in_camera(), np.random.default_rng(0), np.array([np.nan, np.inf, 0.0, 1e30])
    skin = np.repeat(truth, 4, axis=1) + 0.03 * rng.standard_normal((FRAMES, 88, 3)) - [0.0, 0.0, 0.06]
    for points, off in ((skin.astype(np.float32), 0.1), (np.tile(nothing[:, None], (FRAMES, 1, 3)), np.inf)):
        np.savez(tmp_path / "keys.npz", **key_points(points=points))
        assert main(["fit", str(tmp_path / "keys.npz"), str(tmp_path / f"out{off}.npz")]) == 0
        with np.load(tmp_path / f"out{off}.npz") as out:
            assert np.isfinite(out["positions"]).all()
            assert np.linalg.norm(out["positions"] - truth, axis=-1).mean() < off


def test_with_the_users_model_there_is_a_motion_of_it(seen: Path, tmp_path: Path, capsys) -> None:
    np.savez(tmp_path / "model.npz", **model_arrays())
    assert main(["fit", str(seen), str(tmp_path / "out.npz"), "--smpl", str(tmp_path / "model.npz")]) == 0
    assert "mean distance of SMPL's joints" in capsys.readouterr().err
    fps, read = read_motion("smpl.npz", (tmp_path / "out.npz.smpl.0.npz").read_bytes())
    with np.load(tmp_path / "out.npz") as out:
        positions = out["world_positions"]
    assert fps == 30.0
    assert len(read) >= FRAMES - 1
    moved = positions[-1, 0] - positions[0, 0]
    np.testing.assert_allclose(read[-1, 0] - read[0, 0], moved, atol=0.05)
    (tmp_path / "model.npz").write_bytes(b"no model")
    assert main(["fit", str(seen), str(tmp_path / "new.npz"), "--smpl", str(tmp_path / "model.npz")]) == 2
    assert "expected an .npz archive" in capsys.readouterr().err


@pytest.mark.parametrize(("source", "out", "says"), [
    ("nowhere.npz", "out.npz", "does not exist"),
    ("in.npz", "keys.npz", "--force"),
    ("empty.npz", "out.npz", "got nobody"),
    ("keys.npz", "out", "expected an .npz"),
])  # fmt: skip
def test_what_cannot_be_done_is_said(source: str, out: str, says: str, seen, pictured, tmp_path, capsys) -> None:
    write_npz(tmp_path / "empty.npz", np.full((FRAMES, 22, 3), np.nan))
    assert main(["fit", str(tmp_path / source), str(tmp_path / out)]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(("more", "says"), [
    ({"focal": -900.0}, r"focal: expected pixels above 0, one number or two.*got array\(-900"),
    ({"centre": [1.0]}, "centre"),
    ({"skeleton": "nobody"}, "skeleton"),
    ({"keypoints": np.zeros((4, 3, 2))}, "keypoints"),
    ({"confidence": np.zeros((2, 2))}, "confidence"),
    ({"up": "x"}, "up"),
    ({"focal": ["long"]}, "focal: expected numbers"),
    ({"focal": [1.0, 2.0, 3.0]}, "focal"),
    ({"camera_height": [1.0, 2.0]}, "camera_height"),
    ({"camera_height": -1.0}, "more than 0"),
    ({"camera_height": np.nan}, "more than 0"),
    ({"keypoints": np.full((FRAMES, 22, 2), np.nan)}, "expected somebody"),
    ({"keypoints": np.full((FRAMES, 22, 2), [-0.2, 1.4])}, "expected pixels.*got -0.2 to 1.4.*multiply x by"),
    ({"fps": 0.0}, "fps"),
    ({"fps": 1e-9}, "fps"),
    ({"stamp_ns": np.zeros(FRAMES, dtype=np.int64)}, "stamps that grow"),
    ({"stamp_ns": np.arange(FRAMES) * 10**15}, "at most in all"),
    ({"points": np.zeros((3, 5, 3))}, "points"),
])  # fmt: skip
def test_what_is_wrong_with_key_points_is_said(more: dict, says: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.npz"
    np.savez(path, **key_points(**more))
    with pytest.raises(NpzError, match=says):
        read_key_points(path)


def upside_down(share: float = 1.0) -> np.ndarray:
    keys = key_points()["keypoints"]
    rows = slice(round(share * FRAMES))
    keys[rows] = [0.0, 720.0] + [1.0, -1.0] * keys[rows]
    return keys


@pytest.mark.parametrize(("given", "warned"), [
    (key_points(), False),
    (key_points(up="y"), True),
    (key_points(up="z"), False),  # a camera that looks straight up or down
    (key_points(keypoints=upside_down()), True),
    (key_points(keypoints=upside_down(), up="y"), False),
    (key_points(keypoints=upside_down(0.9)), False),  # who stands on their hands for a while
])  # fmt: skip
def test_an_image_upside_down_is_warned_of(given: dict, warned: bool, tmp_path: Path) -> None:
    np.savez(tmp_path / "keys.npz", **given)
    problems = check_up(read_key_points(tmp_path / "keys.npz"))
    assert [text.split(":")[0] for text in problems] == ["up_axis"] * warned


def test_wrong_axes_are_said(seen: Path, pictured: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("steadypose.nodes.commands.fit.check_up", lambda recording: ["up_axis: in the image"])
    write_npz(tmp_path / "lying.npz", POSITIONS[..., [1, 2, 0]])
    for source, warning in (("lying.npz", "up_axis: bodies lie"), ("keys.npz", "up_axis: in the image")):
        assert main(["fit", str(tmp_path / source), str(tmp_path / f"out-{source}")]) == 0
        assert warning in capsys.readouterr().err
    with pytest.warns(steadypose.InputWarning, match="up_axis"):
        assert "up_axis" in steadypose.fit(POSITIONS[..., [1, 2, 0]], fps=30).problems[0]


def test_key_points_are_put_on_the_grid(tmp_path: Path) -> None:
    path = tmp_path / "slow.npz"
    given = key_points(fps=15.0)
    np.savez(path, **given)
    found = read_key_points(path)
    assert len(found.stamps_ns) == 2 * FRAMES - 1
    np.testing.assert_allclose(found.pixels[::2][5], given["keypoints"][5], atol=0.1)
    np.testing.assert_allclose(found.pixels[1], (given["keypoints"][0] + given["keypoints"][1]) / 2, atol=0.1)
    assert found.confidence[6, 4] == 0.0
