from pathlib import Path

import numpy as np
import pytest
import torch
from tests.helpers.prepared import write_motion

from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.models.contacts import LiveContacts
from steadypose.training.data.dataset import MotionSet
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes import contacts as training

FRAMES = 30


@pytest.fixture
def prepared(tmp_path: Path) -> Path:
    """People who stand on the left foot and wave the right one."""
    time, clips = np.arange(60) / 30, []
    for clip in range(4):
        pose = np.repeat((REST_POSITIONS - [0, 0, REST_POSITIONS[J["left_foot"], 2] - 0.015])[None], 60, axis=0)
        pose[:, [J["right_ankle"], J["right_foot"]], 0] += 0.3 * np.sin(2 * np.pi * time + clip)[:, None]
        pose[:, [J["right_ankle"], J["right_foot"]], 2] += 0.15
        clips.append(pose)
    return write_motion(tmp_path / "prepared.npz", clips, ["train"] * 2 + ["val"] * 2)


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CLIPS", {"train": 8, "val": 4})
    monkeypatch.setattr(training, "FRAMES", FRAMES)
    monkeypatch.setattr(training, "BATCH", 4)


def test_it_trains_and_writes_what_loads(prepared: Path, tmp_path: Path) -> None:
    path = training.train_contacts(TrainingOptions(prepared, tmp_path / "runs", iterations=4))
    live = LiveContacts.load(str(path))
    said = live(np.zeros((2, training.FEATURES), np.float32), np.zeros((2, live.hidden), np.float32))
    assert said.load.shape == said.rest.shape == (2, 8)
    again = training.train_contacts(TrainingOptions(prepared, tmp_path / "runs", iterations=4))  # done: nothing is left
    assert again.read_bytes() == path.read_bytes()


def test_clips_are_what_the_smoother_leaves(prepared: Path) -> None:
    pool = training.smoothed_clips(MotionSet.load(prepared, "default", "train"), 8, seed=0)
    assert pool.positions.shape == (8, FRAMES, 22, 3)
    answered = np.isfinite(pool.sigma[..., 0])
    assert (answered.sum(axis=1) >= FRAMES - max(training.DELAYS)).all()
    assert (answered == np.isfinite(pool.positions).all(axis=(2, 3))).all()
    standing = pool.rest[..., 2:6].any(axis=1)
    np.testing.assert_array_equal(np.sort(standing, axis=1), [[False, False, True, True]] * 8)


def test_what_is_not_told_does_not_count(prepared: Path) -> None:
    pool = training.smoothed_clips(MotionSet.load(prepared, "default", "train"), 8, seed=0)
    features, load, rest, counts = training.draw(pool, np.arange(8), np.random.default_rng(0))
    assert features.shape == (8, FRAMES - 1, training.FEATURES)
    assert torch.isfinite(features).all()
    assert load.shape == rest.shape == counts.shape == (8, FRAMES - 1, 8)
    assert (rest <= load).all()
    late = ~np.isfinite(pool.sigma[:, 1:, 0])
    assert (counts.numpy()[late] == 0).all()
