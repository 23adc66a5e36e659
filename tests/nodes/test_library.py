import csv
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.nodes.conftest import walked, write_npz

import steadypose
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.cli import main
from steadypose.nodes.library.arrays import as_array, source_of
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import REST_OFFSETS, J

ROOT = Path(__file__).parents[2]
PROGRAMS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE | re.DOTALL)
FRAMES = 45
WALK = walked(FRAMES)


def test_it_gives_what_the_command_writes(tmp_path: Path) -> None:
    joints = WALK.copy()
    joints[20:30, 21] = np.nan
    write_npz(tmp_path / "in.npz", joints, fps=25.0)
    options = ["--delay", "2", "--set", "events.near=10", "--events", str(tmp_path / "events.csv")]
    assert main(["clean", str(tmp_path / "in.npz"), str(tmp_path / "out.npz"), *options]) == 0
    given = steadypose.clean(joints, fps=25.0, delay=2, settings={"events": {"near": 10.0}})
    with np.load(tmp_path / "out.npz") as written:
        assert set(given) == set(written)
        for name in given:
            np.testing.assert_array_equal(given[name], written[name], err_msg=name)
    rows = list(csv.DictReader((tmp_path / "events.csv").open()))
    assert {"ENTERED", "STANDS", "NEAR"} <= {row["event"] for row in rows}
    assert [row["event"] for row in rows] == [event.kind.name for event in given.events]
    assert [float(row["end"]) for row in rows] == pytest.approx([event.end_ns / 1e9 for event in given.events])
    assert given.bodies[0].events == given.events


def test_several_bodies_and_an_axis_of_bodies_that_stays_whoever_is_there() -> None:
    joints, nobody = np.stack([WALK, WALK + [3.0, 0.0, 0.0]], axis=1), np.full_like(WALK, np.nan)
    joints[:30, 1] = np.nan
    alone, given = steadypose.clean(WALK, fps=30.0), steadypose.clean(joints, fps=30.0)
    assert given["body_id"].tolist() == [0, 1]
    assert (given["positions"].shape, given["joint_anomaly"].shape) == ((FRAMES, 2, 22, 3), (FRAMES, 2, 22))
    np.testing.assert_array_equal(given["positions"][:, 0], alone["positions"])
    assert np.isnan(given["positions"][:28, 1]).all()
    assert np.abs(given["positions"][-1, 1, :, 0] - joints[-1, 1, :, 0]).max() < 0.1
    joints = np.stack([nobody, WALK, nobody], axis=1)
    given = steadypose.clean(joints, fps=30.0)
    assert given["body_id"].tolist() == [0, 1, 2]
    np.testing.assert_array_equal(given["positions"][:, 1], alone["positions"])
    assert np.isnan(given["positions"][:, [0, 2]]).all()
    assert (given["state"][:, [0, 2]] == steadypose.JointState.UNKNOWN).all()
    assert steadypose.clean(WALK[:, None], fps=30.0)["positions"].shape == (FRAMES, 1, 22, 3)
    assert steadypose.complete(joints, fps=30.0)["positions"].shape == (FRAMES, 3, 22, 3)


def test_frames_to_complete_may_come_in_any_order_and_lying_bodies_are_warned_of() -> None:
    stamps = np.arange(FRAMES) * 33_333_333
    seen = WALK.copy()
    seen[20:30, 20] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = steadypose.complete(seen, stamp_ns=stamps)
    turned = steadypose.complete(seen[::-1], stamp_ns=stamps[::-1])
    np.testing.assert_array_equal(turned["positions"], done["positions"])
    with pytest.warns(steadypose.InputWarning, match="up_axis"):
        assert steadypose.complete(seen[..., [1, 2, 0]], stamp_ns=stamps).problems


@pytest.mark.parametrize("function", [steadypose.clean, steadypose.complete])
def test_the_frame_before_somebody_enters_has_nothing_of_them(function: Any) -> None:
    """Nor has the frame after they left, of a completion, which has no delay."""
    both = np.stack([WALK, WALK + [2.0, 0.0, 0.0]], axis=1)
    both[:5, 1] = both[20:, 0] = np.nan
    poses = function(both, fps=30)
    assert not poses.state[:5, 1].any()
    assert np.isnan(poses.positions[:5, 1]).all()
    assert poses.state[5:, 1].all()
    assert poses.state[:20, 0].all()
    assert function is steadypose.clean or not poses.state[20:, 0].any()


def test_a_mask_of_what_was_seen_is_a_confidence() -> None:
    seen = np.ones(WALK.shape[:2], bool)
    seen[:, 15] = False
    by_mask = steadypose.clean(WALK, fps=30, confidence=seen)
    by_number = steadypose.clean(WALK, fps=30, confidence=seen.astype(float))
    np.testing.assert_array_equal(by_mask.state, by_number.state)
    assert (by_mask.state[:, 15] == steadypose.JointState.IMPUTED).all()
    cleaner = steadypose.Filter(delay=0)
    live = [cleaner(frame, t / 30, confidence=mask) for t, (frame, mask) in enumerate(zip(WALK, seen, strict=True))]
    assert live[-1] is not None
    assert live[-1].state[15] == steadypose.JointState.IMPUTED


@pytest.mark.parametrize("wrong_s", [0, 500])
def test_a_single_wrong_stamp_is_dropped_without_a_warning_that_the_stream_starts_anew(wrong_s: int) -> None:
    stamps = np.round(100e9 + np.arange(FRAMES) * 1e9 / 30).astype(np.int64)
    stamps[20] = wrong_s * 10**9
    poses = steadypose.clean(WALK, stamp_ns=stamps)
    assert (poses.refused, poses.problems) == ({"stamp_outlier": 1}, ())


def test_what_is_masked_is_missing() -> None:
    masked = np.ma.masked_array(WALK, np.zeros(WALK.shape, bool))
    masked[1, J["left_wrist"]] = np.ma.masked
    raws = [message for _, message in source_of(masked, fps=30) if isinstance(message, PoseRaw)]
    assert np.unique(np.argwhere(np.isnan(raws[1].bodies[0].positions))[:, 0]).tolist() == [J["left_wrist"]]
    assert as_array("confidence", np.ma.masked_array([True, True], [False, True])).tolist() == pytest.approx(
        [1.0, np.nan], nan_ok=True
    )
    assert as_array("stamp_ns", np.ma.masked_array([1, 2])).dtype.kind == "i"


def test_frames_of_confidence_zero_are_not_missed_and_arrays_by_name_may_be_lists_and_numbers() -> None:
    sure = np.ones(WALK.shape[:2])
    sure[: 4 * FRAMES // 5] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(steadypose.clean(WALK, fps=30.0, confidence=sure)["positions"][-1]).all()
    given = steadypose.clean({"positions": WALK.tolist(), "fps": 30.0, "skeleton": "smpl22", "up": "z"})
    np.testing.assert_array_equal(given["positions"], steadypose.clean(WALK, fps=30.0)["positions"])


def test_what_is_missing_is_named() -> None:
    with pytest.raises(AttributeError, match=r"has no attribute 'cleanse' \(did you mean 'clean'"):
        steadypose.cleanse  # noqa: B018  # type: ignore[attr-defined]
    poses = steadypose.Poses({"positions": np.zeros((2, 22, 3))})
    with pytest.raises(AttributeError, match=r"has no attribute 'postions' \(did you mean 'positions'"):
        poses.postions  # noqa: B018  # type: ignore[attr-defined]
    with pytest.raises(KeyError, match=r"no array 'postions' \(did you mean 'positions'"):
        poses["postions"]
    with pytest.raises(AttributeError, match=r"expected poses of steadypose\.clean"):
        poses.events  # noqa: B018
    for call, name, near in (
        (steadypose.clean, "fsp", "fps"),
        (steadypose.complete, "weight", "weights"),
        (steadypose.fit, "point", "points"),
        (steadypose.plot, "ouput", "output"),
        (steadypose.Filter, "skeletn", "skeleton"),
    ):
        arguments: Any = () if call is steadypose.Filter else (WALK,)
        with pytest.raises(TypeError, match=rf"{call.__name__}\(\) has no argument '{name}' \(did you mean '{near}'"):
            call(*arguments, **{name: 3})


def test_what_holds_arrays_shows_their_shapes() -> None:
    assert repr(steadypose.sample()) == "<Sample positions (619, 22, 3), stamp_ns (619,), truth (619, 22, 3)>"
    body = steadypose.RawBody(3, WALK[0], np.ones(22))
    raw = steadypose.PoseRaw(7, "camera", "mine", "smpl22", steadypose.Pose.from_up("z"), False, [body])
    assert repr(body) == "RawBody(id=3, positions=<(22, 3)>, confidence=<(22,)>)"
    assert repr(raw).endswith(f"bodies=[{body!r}], end_of_stream=False)")
    assert repr(raw.sensor_pose) == "Pose(position=array([0., 0., 0.]), orientation=array([0., 0., 0., 1.]))"


def test_the_first_is_ten_lines() -> None:
    assert len([line for line in PROGRAMS[0].splitlines() if line.strip()]) <= 10


def test_it_is_a_dictionary_still_and_knows_its_arrays_by_name(tmp_path: Path) -> None:
    poses = steadypose.clean(WALK[:25], fps=30.0)
    assert isinstance(poses, dict)
    assert poses.to_dict() == dict(poses)
    assert type(poses.to_dict()) is dict
    np.testing.assert_array_equal(poses.world, poses["world_positions"])
    np.testing.assert_array_equal(poses.positions["head"], poses["positions"][:, 15])
    np.testing.assert_allclose(poses.t, np.arange(25) / 30, atol=1e-9)
    np.savez(tmp_path / "poses.npz", allow_pickle=False, **poses)
    again = steadypose.clean(tmp_path / "poses.npz")
    assert np.linalg.norm(again.world - poses.world, axis=-1).mean() < 0.02
    with pytest.raises(ValueError, match="expected no fps beside a file"):
        steadypose.clean(tmp_path / "poses.npz", fps=30)


def test_as_a_table_and_as_a_dataset() -> None:
    poses = steadypose.clean(np.stack([WALK, WALK + [3.0, 0.0, 0.0]], axis=1)[:12], fps=30.0)
    table = poses.to_pandas()
    assert len(table) == 2 * 12
    second = table[table["body"] == 1]
    np.testing.assert_array_equal(second["left_wrist_x"], poses.world["left_wrist"][:, 1, 0])
    np.testing.assert_array_equal(second["head_state"], poses.state["head"][:, 1])
    data = poses.to_xarray()
    assert data["positions"].dims == ("time", "body", "joint", "axis")
    wrist = data["world_positions"].sel(joint="left_wrist", body=1)
    np.testing.assert_array_equal(wrist, poses.world["left_wrist"][:, 1])
    moment: Any = steadypose.Filter(delay=0)(WALK[0], 0.0)
    assert len(moment.to_pandas()) == 1
    assert moment.to_xarray()["sigma"].dims == ("joint",)


def test_the_sample_has_its_truth() -> None:
    sample = steadypose.sample()
    assert np.isfinite(sample.truth).all()
    assert sample.positions.shape == sample.truth.shape == (len(sample.stamp_ns), 22, 3)
    assert 0.1 < np.isnan(sample.positions).mean() < 0.5
    assert 0.5 < np.nanmedian(sample.positions[:, 0, 2]) < 1.2, "z is up, in metres"
    assert np.nanmedian(np.linalg.norm(sample.positions - sample.truth, axis=-1)) < 0.06
    assert steadypose.sample("crossing").positions.shape[1:] == (2, 22, 3)
    with pytest.raises(ValueError, match=r"no sample 'walk_trun' \(did you mean 'walk_turn'"):
        steadypose.sample("walk_trun")


def test_key_frames_are_completed_and_drawn(tmp_path: Path) -> None:
    keys = np.arange(0, FRAMES, 10)
    poses = steadypose.complete(WALK[keys], stamp_ns=np.round(keys * 1e9 / 30).astype(np.int64))
    np.testing.assert_allclose(poses["positions"][keys], WALK[keys], atol=1e-6)
    assert (poses.state["head"][1:10] == steadypose.JointState.IMPUTED).all()
    assert steadypose.plot(poses, tmp_path / "picture.png").axes
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_fit_is_that_of_the_command(tmp_path: Path) -> None:
    joints = WALK[:40]
    write_npz(tmp_path / "in.npz", joints)
    assert main(["fit", str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]) == 0
    poses = steadypose.fit(joints, fps=30.0)
    with np.load(tmp_path / "out.npz") as written:
        assert set(poses) == set(written)
        np.testing.assert_allclose(poses.positions, written["positions"], atol=1e-4)
    of_bodies = steadypose.fit(np.stack([np.full_like(joints, np.nan), joints], axis=1), fps=30.0)
    assert of_bodies.positions.shape == (40, 2, 22, 3)
    with pytest.raises(ValueError, match="points: expected numbers of one shape"):
        steadypose.fit(joints, fps=30.0, points=[joints[0], joints[1, :5]])


def test_an_arm_stretched_farther_than_most_training_people_do_is_turned_as_its_joints_lie() -> None:
    """It was turned by 28 degrees, because few postures are like it."""
    elbow, shoulder, part = J["right_elbow"], J["right_shoulder"], slice(180, 228)
    poses = steadypose.clean(steadypose.sample("reach").positions[: part.stop + 4], fps=30)
    turned = global_rotations(
        Rotation.from_quat(poses.rotations[part].reshape(-1, 4)).as_matrix().reshape(-1, 22, 3, 3)
    )
    bone = turned[:, shoulder] @ REST_OFFSETS[elbow]
    shown = poses.positions[part, elbow] - poses.positions[part, shoulder]
    cosine = (bone * shown).sum(axis=-1) / np.linalg.norm(bone, axis=-1) / np.linalg.norm(shown, axis=-1)
    assert np.degrees(np.arccos(cosine)).mean() < 18
