from pathlib import Path

import numpy as np
import pytest
import torch
from tests.helpers.prepared import write_motion

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS
from steadypose.prior.fit.tensors import load_tensors
from steadypose.prior.models.root_velocity import TrajectoryConfig
from steadypose.training.data.dataset import MotionSet
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes import root_velocity as training
from steadypose.training.recipes.root_velocity import TrajectoryNet


@pytest.fixture
def prepared(tmp_path: Path) -> Path:
    """Bodies that glide in straight lines, their legs swinging at a rate that goes with their speed."""
    rng = np.random.default_rng(0)
    clips, count = [], 150
    for _ in range(6):
        t, speed = np.arange(count) / 30, rng.uniform(0.0, 1.5)
        pose = np.repeat((REST_POSITIONS + [0, 0, 0.9])[None], count, axis=0)
        swing = 0.4 * speed * np.sin(2 * np.pi * t)
        pose[:, [4, 7, 10], 0] += swing[:, None]
        pose[:, [5, 8, 11], 0] -= swing[:, None]
        pose[..., 0] += speed * t[:, None]
        clips.append(pose @ yaw_matrix(rng.uniform(-3, 3)).T)
    split, flat = ["train"] * 4 + ["val"] * 2, [True, True, True, False, True, True]
    return write_motion(tmp_path / "prepared.npz", clips, split, flat)


def test_where_somebody_climbs_contacts_are_not_learned(prepared: Path):
    everything, flat = (MotionSet.load(prepared, "default", "train", flat=flat) for flat in (False, True))
    assert (len(everything.clip_start) - 1, len(flat.clip_start) - 1) == (4, 3)


def test_windows_show_the_body_facing_forward(prepared: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "WINDOW", 40)
    monkeypatch.setattr(training, "_SPAN", 84)
    motion = MotionSet.load(prepared, "default", "train")
    sampled = training._sample(motion, *training._chances(motion), 32, np.random.default_rng(0))
    windows = training._windows(sampled, np.random.default_rng(1), noise_sd=0.0)
    velocity = (windows.velocity[:, :, None] @ windows.turn)[:, :, 0]
    forward, sideways = velocity[..., 0], velocity[..., 1]
    assert (forward.mean(dim=1) > 2 * sideways.mean(dim=1).abs()).all()
    places = windows.features.unflatten(2, (22, 6))
    assert (places[:, :, 16, 1] > places[:, :, 17, 1]).all()
    assert (windows.velocity.diff(dim=1).abs() < 1e-3).all()


def test_mirroring_exchanges_left_and_right():
    positions, yaw, contacts = torch.randn(2, 7, 22, 3), torch.randn(2, 5), (torch.rand(2, 5, 8) > 0.5).float()
    mirrored = training._mirror_half(training._Motion(positions, yaw, contacts))
    torch.testing.assert_close(mirrored.positions[0, :, 7], positions[0, :, 8] * torch.tensor([1.0, -1.0, 1.0]))
    torch.testing.assert_close(mirrored.yaw[0], -yaw[0])
    torch.testing.assert_close(mirrored.contacts[0, :, 2], contacts[0, :, 3])
    torch.testing.assert_close(mirrored.positions[1], positions[1])


def test_corruption_keeps_the_root_at_the_origin():
    noisy = training._corrupt(torch.zeros(8, 20, 22, 3), np.random.default_rng(0))
    assert (noisy[:, :, 0] == 0).all()
    assert 0.005 < noisy[:, :, 1:].std() < 0.05


@torch.no_grad()
def test_calibration_finds_the_size_of_the_errors(prepared: Path, monkeypatch: pytest.MonkeyPatch):
    """Errors of independent frames, twice as large as stated, last a frame; lasting ones longer."""
    motion, frames = MotionSet.load(prepared, "default", "val"), training.WARM_UP + 60
    shape = (256, frames, 3)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    turn = torch.eye(3).expand(256, frames, 3, 3)
    for error, lasts in ((2.0 * noise, 1 / 30), (2.0 * noise[:, :1].expand(shape), 1.0)):
        predicted = training.RootMotion(error, torch.zeros(shape), torch.zeros(256, frames, 8))
        truth = training._Windows(torch.empty(0), turn, torch.zeros(shape), torch.empty(0))
        monkeypatch.setattr(training, "_validate", lambda *_, p=predicted, t=truth, **__: (p, t))
        config = training.calibrate(TrajectoryNet(TrajectoryConfig(hidden=3)), motion)
        assert config.sigma_scale == pytest.approx((2.0, 2.0), rel=0.1)
        assert config.correlation_s == pytest.approx((lasts, lasts), rel=0.25)


def test_it_trains_and_writes_what_loads(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "BATCH", 4)
    monkeypatch.setattr(training, "WINDOW", 40)
    monkeypatch.setattr(training, "_SPAN", 84)
    path = training.train_trajectory(TrainingOptions(prepared, tmp_path, iterations=2))
    state, config = load_tensors(str(path), "trajectory")
    TrajectoryNet(TrajectoryConfig.from_dict(config)).load_state_dict(state)
    assert path.with_suffix(".md").read_text().startswith("# trajectory-default")
    assert path.with_suffix(".png").stat().st_size > 0
