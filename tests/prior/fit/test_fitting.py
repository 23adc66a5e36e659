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
from steadypose.prior.body.skeleton import PARENTS, limbs
from steadypose.prior.fit import windows
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.smpl import BETAS, POSES, SmplShape, smpl_motion
from steadypose.prior.fit.solve import STIFFNESS, FitSettings, Start, preconditioner
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.fit.windows import Track, fit_track, window_bounds
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


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"J_regressor": None}, "J_regressor"),
        ({"J_regressor": np.zeros((10, 96))}, "22 or more"),
        ({"J_regressor": np.array([{}], dtype=object)}, "numbers"),
        ({"shapedirs": np.zeros((5, 3, 10))}, "expected"),
        ({"kintree_table": np.zeros((2, 24), dtype=np.int64)}, "kintree_table"),
    ],
)
def test_another_file_is_refused_in_words(change: dict[str, Any], says: str, tmp_path: Path) -> None:
    arrays = {name: value for name, value in (model_arrays() | change).items() if value is not None}
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(MotionError, match=says):
        SmplShape.read(tmp_path / "model.npz")
