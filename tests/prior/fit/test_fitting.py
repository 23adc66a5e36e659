from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from steadypose.benchmarks.motion import MotionClips, simulated_clips
from steadypose.benchmarks.studies.humor_fits import fitted, pictures, seen_joints
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.fit import windows
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.solve import STIFFNESS, FitSettings, Start, preconditioner
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.fit.windows import Track, fit_track, window_bounds

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


def test_a_long_track_is_one_motion_and_done_windows_are_not_done_again(
    model: HumorNet, truth: np.ndarray, tmp_path: Path, monkeypatch
) -> None:
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
