from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from tests.helpers.smpl_model import TREE, model_arrays

from steadypose.benchmarks.motion import MotionClips, simulated_clips
from steadypose.benchmarks.studies.humor_fits import fitted, pictures, seen_joints
from steadypose.msgs.types import JointState
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.kinematics import heading, rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J, limbs
from steadypose.prior.camera.key_points import KeyPointRecording
from steadypose.prior.fit import picture, windows
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.observations import KeyPoints, Pinhole, SeenJoints, SurfacePoints
from steadypose.prior.fit.picture import arrays_of_fit, fit_key_points, lift, starts_of_key_points, track_of_key_points
from steadypose.prior.fit.smpl import BETAS, POSES, SmplShape, smpl_motion
from steadypose.prior.fit.solve import STIFFNESS, FitSettings, Start, preconditioner
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.fit.windows import FittedTrack, Track, fit_track, window_bounds
from steadypose.prior.mocap.clip import MotionError

NOISE = 0.03
BRIEF = FitSettings(root_steps=10, pose_steps=20, motion_steps=30)


@pytest.fixture(scope="module")
def model() -> HumorNet:
    return load_network(HumorNet, HumorConfig.from_dict, "default", "humor")


@pytest.fixture(scope="module")
def clips() -> MotionClips:
    return simulated_clips(45, 6, seed=3).farthest(1)


@pytest.fixture(scope="module")
def truth(clips: MotionClips) -> np.ndarray:
    return clips.positions[:, 0]


def error(said: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(said - truth, axis=-1).mean())


def test_a_simulated_motion_is_found_under_noise(model: HumorNet, truth: np.ndarray) -> None:
    seen = truth + NOISE * np.random.default_rng(0).standard_normal(truth.shape)
    smooth = gaussian_filter1d(seen, 3.0, axis=0, mode="nearest")
    found = fitted(model, [Start.of_joints(smooth, ground_known=True)], seen_joints(seen), 3, BRIEF)
    assert error(found.joints, truth) < 0.5 * error(seen, truth)
    assert error(found.joints, truth) < 0.9 * error(smooth, truth)
    assert found.load is not None
    assert found.load.shape == (len(truth), 8)
    lengths = np.linalg.norm(found.joints[:, 4] - found.joints[:, 1], axis=-1)
    np.testing.assert_allclose(lengths, lengths[0], atol=1e-4)


def test_legs_that_are_hidden_for_a_while_go_on(model: HumorNet, truth: np.ndarray) -> None:
    leg = limbs(("knee", "ankle", "foot"))[0]
    seen, start = truth.copy(), truth.copy()
    seen[15:30, leg] = np.nan
    start[15:30, leg] = start[14, leg]  # as a sensor that holds what it lost
    # BRIEF ends before the leg has moved far, and how far differs between processors.
    found = fitted(model, [Start.of_joints(start, ground_known=True)], seen_joints(seen), 3, FitSettings())
    assert error(found.joints[15:30, leg], truth[15:30, leg]) < 0.5 * error(start[15:30, leg], truth[15:30, leg])


def test_key_points_and_depth_find_the_motion_again(model: HumorNet, clips: MotionClips) -> None:
    taken = pictures(clips, 0, np.random.default_rng(0))
    flat, deep = (fitted(model, track.starts, track.observed, 2, BRIEF) for track in (taken.flat, taken.deep))
    assert error(flat.joints, taken.truth) < 0.3
    assert error(deep.joints, taken.truth) < min(0.1, error(flat.joints, taken.truth))


def test_a_long_track_is_one_motion_and_windows_are_done_once(model: HumorNet, truth, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(windows, "FRAMES", 20)
    monkeypatch.setattr(windows, "OVERLAP", 5)
    seen = truth[:35] + 0.01 * np.random.default_rng(0).standard_normal(truth[:35].shape)
    track = Track([Start.of_joints(seen, ground_known=True)], seen_joints(seen))
    calls: list[int] = []
    whole = windows.fit_window

    def counted(*arguments, **options):
        calls.append(1)
        return whole(*arguments, **options)

    monkeypatch.setattr(windows, "fit_window", counted)
    brief = FitSettings(root_steps=0, pose_steps=10, motion_steps=10)
    first = fit_track(model, track, brief, tmp_path)
    assert len(calls) == len(window_bounds(35)) == len(list(tmp_path.glob("*.npz")))
    again = fit_track(model, track, brief, tmp_path)
    assert len(calls) == len(window_bounds(35))
    np.testing.assert_array_equal(first.joints, again.joints)
    assert first.joints.shape == (35, 22, 3)
    steps = np.linalg.norm(np.diff(first.joints, axis=0), axis=-1)
    true = np.linalg.norm(np.diff(truth[:35], axis=0), axis=-1)
    assert steps.max() < 3 * true.max(), "windows meet without a jump"
    sorted(tmp_path.glob("*.npz"))[-1].unlink()
    fit_track(model, track, brief, tmp_path)
    assert len(calls) == len(window_bounds(35)) + 1


def test_poses_move_as_what_is_smooth_does() -> None:
    root = preconditioner(20)
    second = torch.eye(20, dtype=torch.float64).diff(n=2, dim=0)
    held = torch.eye(20, dtype=torch.float64) + STIFFNESS * second.mT @ second
    torch.testing.assert_close(root @ held @ root, torch.eye(20, dtype=torch.float64))
    line = torch.arange(20, dtype=torch.float64)
    torch.testing.assert_close(root @ line, line)  # what does not accelerate is not held


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("smplh") / "female" / "model.npz"
    file.parent.mkdir()
    np.savez(file, **model_arrays())
    return file


def placed(arrays: dict[str, Any], poses: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """(T, 24, 3) joints by the equations of the paper, one after the other."""
    rest = arrays["J_regressor"] @ (arrays["v_template"] + arrays["shapedirs"] @ betas[: arrays["shapedirs"].shape[-1]])
    out = np.zeros((len(poses), len(TREE), 3))
    for t, pose in enumerate(poses):
        turned: list[np.ndarray] = []
        for joint, parent in enumerate(TREE):
            local = Rotation.from_rotvec(pose[3 * joint : 3 * joint + 3]).as_matrix()
            turned.append(local if parent < 0 else turned[parent] @ local)
            step = rest[joint] - (rest[parent] if parent >= 0 else 0.0)
            out[t, joint] = step + trans[t] if parent < 0 else out[t, parent] + turned[parent] @ step
    return out


def lengths_of(joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(joints - joints[:, np.array(PARENTS)], axis=-1).mean(axis=0)


def test_a_motion_of_the_model_is_found_again(path: Path) -> None:
    arrays, rng = model_arrays(), np.random.default_rng(1)
    betas = np.array([1.5, *rng.normal(0.0, 1.0, 9)])
    poses = np.cumsum(rng.normal(0.0, 0.03, (20, 72)), axis=0)
    poses[:, :3] = Rotation.from_matrix(np.eye(3)[[2, 0, 1]]).as_rotvec()  # upright in a world that is z up
    trans = np.linspace([0.0, 0.0, 1.0], [1.0, 0.5, 1.0], 20)
    truth = placed(arrays, poses, betas, trans)[:, :22]
    found = smpl_motion(SmplShape.read(path), truth, lengths_of(truth))
    assert np.linalg.norm(found.joints - truth, axis=-1).mean() < 0.003
    size = lengths_of(placed(arrays, poses[:1], found.betas, trans)[:, :22])
    np.testing.assert_allclose(size[1:], lengths_of(truth)[1:], atol=0.01)


def test_another_skeleton_is_met_as_far_as_the_model_can(path: Path) -> None:
    arrays = model_arrays()
    joints = simulated_clips(30, 2, seed=5).positions[:, 0]
    found = smpl_motion(SmplShape.read(path), joints, lengths_of(joints))
    said = placed(arrays, found.poses, found.betas, found.trans)[:, :22]
    np.testing.assert_allclose(said, found.joints, atol=1e-5)  # what the file says is where the model stands
    assert np.linalg.norm(said - joints, axis=-1).mean() < 0.015
    assert found.gender == "female"
    assert np.abs(found.betas).max() < 4.0
    assert (found.betas.shape, found.poses.shape) == ((BETAS,), (30, POSES))
    assert not found.poses[:, 66:].any()
    steps = Rotation.from_rotvec(found.poses[1:, :66].reshape(-1, 3)).inv() * Rotation.from_rotvec(
        found.poses[:-1, :66].reshape(-1, 3)
    )
    assert np.degrees(steps.magnitude()).max() < 45, "no joint flips from frame to frame"


@pytest.mark.parametrize(("change", "says"), [
    ({"J_regressor": None}, "J_regressor"),
    ({"J_regressor": np.zeros((10, 96))}, "22 or more"),
    ({"J_regressor": np.array([{}], dtype=object)}, "numbers"),
    ({"shapedirs": np.zeros((5, 3, 10))}, "expected"),
    ({"kintree_table": np.zeros((2, 24), dtype=np.int64)}, "kintree_table"),
])  # fmt: skip
def test_another_file_is_refused_in_words(change: dict[str, Any], says: str, tmp_path: Path) -> None:
    arrays = {name: value for name, value in (model_arrays() | change).items() if value is not None}
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(MotionError, match=says):
        SmplShape.read(tmp_path / "model.npz")


FRAMES, HEIGHT = 40, 1.3
OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
TOES = [J["left_foot"], J["right_foot"]]


def camera() -> Pinhole:
    return Pinhole(
        torch.tensor([900.0, 900.0]), torch.tensor([640.0, 360.0]), torch.from_numpy(OPTICAL).float(), torch.zeros(3)
    )


def person(yaw: float, size: float = 1.0) -> np.ndarray:
    """(T, 22, 3) somebody who stands in the rest pose, 4 m away, with both feet on the floor."""
    offsets = REST_OFFSETS * size
    rotations = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    rotations[:, 0] = yaw_matrix(np.full(FRAMES, yaw))
    joints = place_joints(rotations, offsets)
    floor = joints[0, TOES, 2].min() - 0.015
    return joints + np.array([0.1, 4.0, -HEIGHT - floor])


def pixels(joints: np.ndarray) -> np.ndarray:
    return camera().project(torch.from_numpy(joints).float()).double().numpy()


def joints_of(start: Start) -> np.ndarray:
    placed = place_joints(start.rotations.double().numpy(), start.offsets.double().numpy())
    return placed + start.root.double().numpy()[:, None]


def off(start: Start, truth: np.ndarray) -> float:
    """Metres, but for the arms, which start downwards."""
    error = np.linalg.norm(joints_of(start) - truth, axis=-1)
    return float(
        np.delete(error, [J[f"{s}_{p}"] for s in ("left", "right") for p in ("elbow", "wrist")], axis=1).mean()
    )


@pytest.mark.parametrize("yaw", [-1.2, -0.4, 0.3, 1.3, 2.4])
def test_toes_say_which_side_is_the_far_one(yaw: float) -> None:
    truth = person(yaw)
    told = pixels(truth)
    (start,) = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert off(start, truth) < 0.25
    assert np.cos(heading(start.rotations[:, 0].double().numpy()) - yaw).min() > np.cos(0.4)
    told[:, TOES] = np.nan
    starts = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert len(starts) == 2
    assert min(off(start, truth) for start in starts) < 0.25


@pytest.mark.parametrize("yaw", [-np.pi / 2, np.pi / 2])
def test_who_is_wider_than_bones_allow_is_turned_to_the_camera_or_away_from_it(yaw: float) -> None:
    told = pixels(person(yaw))
    wide = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "shoulder")]
    told[:, wide, 0] += 0.4 * (told[:, wide, 0] - told[:, wide, 0].mean(axis=1, keepdims=True))
    for start in starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT):
        assert np.cos(heading(start.rotations[:, 0].double().numpy()) - yaw).min() > np.cos(0.2)


@pytest.mark.parametrize("size", [0.7, 1.0, 1.1])
def test_a_known_floor_says_how_large_somebody_is(size: float) -> None:
    truth = person(0.2, size)
    known, guessed = (
        starts_of_key_points(pixels(truth), camera(), REST_OFFSETS, -HEIGHT, floor_known=known)[0]
        for known in (True, False)
    )
    height = np.abs(known.offsets.numpy()[:, 2]).sum() / np.abs(REST_OFFSETS[:, 2]).sum()
    assert height == pytest.approx(size, rel=0.1)
    assert known.root[:, 1].mean() == pytest.approx(4.0, abs=0.25)
    np.testing.assert_allclose(guessed.offsets.numpy(), REST_OFFSETS, atol=1e-6)


@pytest.mark.parametrize("floor", [-0.4, -4.0, 0.5])
def test_a_floor_on_which_nobody_can_stand_is_not_believed(floor: float) -> None:
    told = pixels(person(0.2))
    (start,) = starts_of_key_points(told, camera(), REST_OFFSETS, floor, floor_known=True)
    np.testing.assert_allclose(start.offsets.numpy(), REST_OFFSETS, atol=1e-6)


def test_without_feet_bones_say_how_far_somebody_is() -> None:
    truth = person(0.2)
    told = pixels(truth)
    told[:, [J[f"{side}_{part}"] for side in ("left", "right") for part in ("ankle", "foot")]] = np.nan
    starts = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert min(off(start, truth) for start in starts) < 0.4


def test_key_points_are_as_deep_as_the_surface_about_them() -> None:
    truth = person(0.2)
    rng = np.random.default_rng(0)
    points = np.repeat(truth, 4, axis=1) + 0.01 * rng.standard_normal((FRAMES, 88, 3)) - [0.0, 0.05, 0.0]
    points[:, ::3] = np.nan
    points[0] = np.nan
    told = pixels(truth)
    told[5, 4] = np.nan
    found = lift(told, camera(), points)
    assert np.isnan(found[0]).all()
    assert np.isnan(found[5, 4]).all()
    error = np.linalg.norm(found - truth, axis=-1)
    assert np.isfinite(error[1:]).mean() > 0.95
    assert np.nanpercentile(error, 90) < 0.1


def test_points_behind_the_camera_or_beside_the_body_say_nothing() -> None:
    truth = person(0.2)
    behind, beside = -truth[:, :3], truth[:, :3] + [1.5, 0.0, 0.0]
    for points in (np.concatenate([behind, beside], axis=1), np.empty((FRAMES, 0, 3))):
        assert np.isnan(lift(pixels(truth), camera(), points)).all()


def recording(joints: np.ndarray, points: np.ndarray | None = None, height: float | None = HEIGHT) -> KeyPointRecording:
    """Of joints and points (T, N, 3) metres, world, as `camera` has them."""
    return KeyPointRecording(
        np.arange(FRAMES), pixels(joints), np.full((FRAMES, 22), 0.5), camera().focal.numpy(), camera().centre.numpy(),
        OPTICAL, height, None if points is None else points @ OPTICAL,
    )  # fmt: skip


def test_depth_is_observed_too_and_half_of_the_frames_cleaned_are_a_start() -> None:
    joints = person(0.2) + 0.01 * np.arange(FRAMES, dtype=np.float64)[:, None, None]
    points = np.repeat(joints, 4, axis=1) - np.array([0.0, 0.05, 0.0])

    def track(known: list[int]) -> picture.Track:
        cleaned = np.full_like(joints, np.nan)
        cleaned[known] = joints[known]
        return track_of_key_points(recording(joints, points), lambda lifted: cleaned)

    known = [*range(10, 20), *range(25, 35)]
    (start,) = (found := track(known)).starts
    nearest = [10] * 10 + [*range(10, 20)] + [19] * 3 + [25] * 2 + [*range(25, 35)] + [34] * 5
    np.testing.assert_allclose(start.root.numpy(), joints[nearest, 0], atol=1e-5)
    np.testing.assert_allclose(joints_of(start), joints[nearest], atol=0.01)
    assert start.ground == -HEIGHT
    flat = track_of_key_points(recording(joints), lambda lifted: joints)
    for fewer in (flat, track(known[1:])):
        torch.testing.assert_close(
            fewer.starts[0].root,
            starts_of_key_points(pixels(joints), camera(), REST_OFFSETS, -HEIGHT, floor_known=True)[0].root,
        )
    keys, surface, deep = found.observed
    assert isinstance(keys, KeyPoints)
    assert keys.sigma == 9.0, "a hundredth of the focal length"
    assert isinstance(surface, SurfacePoints)
    assert isinstance(deep, SeenJoints)
    np.testing.assert_allclose(surface.points.numpy(), points, atol=1e-5)
    np.testing.assert_allclose(deep.positions.numpy(), lift(pixels(joints), camera(), points), atol=1e-4)
    assert (deep.sigma == 0.08).all()
    assert [type(one) for one in flat.observed] == [KeyPoints]


def test_a_camera_whose_height_nobody_states_is_guessed_and_its_floor_may_move(monkeypatch: pytest.MonkeyPatch) -> None:
    joints, given = person(0.2, 1.1), []
    model = HumorNet(HumorConfig(hidden=64, latent=2))
    monkeypatch.setattr(picture, "fit_track", lambda model, track, settings, *_, **__: given.append((track, settings)))
    for height in (None, 1.0):
        fit_key_points(model, recording(joints, height=height), FitSettings(), None, lambda lifted: lifted)
    (guessed, loose), (stated, firm) = given
    assert (guessed.starts[0].ground, loose.ground_height_sigma) == (-1.3, 0.3)
    assert (stated.starts[0].ground, firm.ground_height_sigma) == (-1.0, FitSettings().ground_height_sigma)
    np.testing.assert_allclose(guessed.starts[0].offsets.numpy(), REST_OFFSETS, atol=1e-6)


def test_what_is_written_is_in_the_cameras_frame() -> None:
    told = recording(joints := person(0.7))
    told.pixels[3, 4] = np.nan
    moving = joints + np.arange(FRAMES, dtype=np.float64)[:, None, None] * np.array([0.02, 0.0, 0.01])
    rotations = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    rotations[:, 0] = yaw_matrix(np.full(FRAMES, 0.7))
    load = np.random.default_rng(0).uniform(size=(FRAMES, 8))
    none = np.zeros((1, 3))
    kept = rotations.copy()
    found = arrays_of_fit(
        told, FittedTrack(moving, rotations, REST_OFFSETS[None], none, load, none, none, np.array([True]))
    )
    np.testing.assert_array_equal(rotations, kept)
    placed = place_joints(rotation_matrices(found["rotations"].astype(float)), REST_OFFSETS)
    np.testing.assert_allclose(placed + found["positions"][:, :1], found["positions"], atol=1e-5)
    np.testing.assert_allclose(found["positions"] @ OPTICAL.T, moving, atol=1e-5)
    np.testing.assert_allclose(found["root_velocity"], np.tile([0.6, 0.0, 0.3], (FRAMES, 1)), atol=1e-9)
    np.testing.assert_allclose(found["contacts"], load, atol=1e-6)
    assert np.argwhere(found["state"] == JointState.IMPUTED).tolist() == [[3, 4]]
    assert (found["state"] == JointState.REFINED).sum() == FRAMES * 22 - 1
    assert np.isnan(found["sigma"]).all()
    assert not found["anomaly_flag"].any()


def test_a_camera_that_stands_elsewhere_sees_the_same_there() -> None:
    told, away = pixels(person(0.2, 1.1)), np.array([0.5, -0.3, 0.8])
    moved = Pinhole(camera().focal, camera().centre, camera().rotation, torch.from_numpy(away).float())
    here, there = (
        starts_of_key_points(told, taken, REST_OFFSETS, ground, floor_known=True)[0]
        for taken, ground in ((camera(), -HEIGHT), (moved, away[2] - HEIGHT))
    )
    np.testing.assert_allclose(joints_of(there), joints_of(here) + away, atol=1e-4)
    surface = np.repeat(person(0.2, 1.1), 4, axis=1) - [0.0, 0.05, 0.0]
    lifted = lift(told, moved, surface + away)
    np.testing.assert_allclose(lifted, lift(told, camera(), surface) + away, atol=1e-4)
