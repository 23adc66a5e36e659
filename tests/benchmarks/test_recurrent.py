import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.baselines import recurrent
from steadypose.benchmarks.corruption import gaussian
from steadypose.benchmarks.motion import simulated_clips


def test_it_learns_to_take_noise_off_and_no_answer_knows_more_than_its_delay() -> None:
    motion = simulated_clips(frames=45, most=20, seed=1)
    net = recurrent.train(motion, (0, 4), steps=80, seed=0)
    seen = gaussian(motion.positions[:, :3], 0.08, np.random.default_rng(0))
    newest, late = recurrent.smooth(net, seen)
    wrong = np.linalg.norm(seen - motion.positions[:, :3], axis=-1).mean()
    assert np.linalg.norm(newest - motion.positions[:, :3], axis=-1).mean() < 0.95 * wrong
    other = seen.copy()
    other[30:] += 1.0
    changed_newest, changed_late = recurrent.smooth(net, other)
    np.testing.assert_array_equal(changed_newest[:30], newest[:30])
    np.testing.assert_array_equal(changed_late[:26], late[:26])
    assert not np.array_equal(changed_late[26:30], late[26:30])


def test_a_turned_body_is_answered_alike_wherever_it_stands() -> None:
    torch.manual_seed(0)
    net = recurrent.RecurrentDenoiser((0, 2)).eval()
    seen = simulated_clips(frames=30, most=1, seed=2).positions
    turn, place = Rotation.from_euler("z", 1.1).as_matrix(), np.array([3.0, -2.0, 0.0])
    for plain, moved in zip(recurrent.smooth(net, seen), recurrent.smooth(net, seen @ turn.T + place), strict=True):
        assert moved == pytest.approx(plain @ turn.T + place, abs=2e-4)
