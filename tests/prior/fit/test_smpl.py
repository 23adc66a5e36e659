"""SMPL's motion of a fit, with a model of SMPL's form that is made here: a real one is licensed."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.smpl_model import TREE, model_arrays

from steadypose.benchmarks.motion import simulated_clips
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.fit.smpl import BETAS, POSES, SmplShape, smpl_motion
from steadypose.prior.mocap.clip import MotionError


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
