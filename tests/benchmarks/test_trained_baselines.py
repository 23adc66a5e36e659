import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from steadypose.benchmarks.baselines import recurrent
from steadypose.benchmarks.baselines.flk import LEAST_FRAMES, Bones, filtered, train
from steadypose.benchmarks.corruption import gaussian
from steadypose.benchmarks.motion import simulated_clips
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.timing.rate import FPS


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


STAMPS = np.arange(40) / FPS


class Onwards(nn.Module):
    """Knows the motion: every joint moves on as it did."""

    def forward(self, poses: Tensor, moved: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        return poses + moved, state


def straight(speed_m_s: float) -> np.ndarray:
    """(T, 1, 22, 3) metres, a body carried along x."""
    return (REST_POSITIONS + STAMPS[:, None, None] * np.array([speed_m_s, 0.0, 0.0]))[:, None]


def test_who_is_slow_is_taken_as_measured_and_a_hidden_joint_moves_on_by_the_model() -> None:
    seen = straight(0.1) + np.random.default_rng(0).normal(0.0, 1e-4, (40, 1, 22, 3))
    found = filtered(Onwards(), seen, STAMPS, 0, alpha=1e-3, theta=0.5, kept=1.0)
    np.testing.assert_array_equal(found, seen)
    seen = straight(0.5)
    hidden = seen.copy()
    hidden[20:30, 0, J["left_wrist"]] = np.nan
    found = filtered(Onwards(), hidden, STAMPS, 0, alpha=1e-3, theta=0.5, kept=1.0)
    np.testing.assert_allclose(found, seen, atol=1e-6)


def test_jump_is_distrusted_and_a_low_pass_follows():
    seen = straight(0.0)
    seen[25, 0, J["head"]] += 1.0
    sharp, soft = (filtered(Onwards(), seen, STAMPS, 0, alpha=1.0, theta=0.9, kept=kept) for kept in (1.0, 0.5))
    off = np.linalg.norm((sharp - straight(0.0))[25, 0, J["head"]])
    assert off < 0.1  # by speed, 30 m/s, a ninth of the gain and less
    np.testing.assert_allclose(np.linalg.norm((soft - straight(0.0))[25, 0, J["head"]]), off / 2, rtol=1e-6)


def test_known_bone_keeps_its_length_and_is_known_despite_a_gap():
    bones, pose = Bones(1), REST_POSITIONS[None].copy()
    for frame in range(LEAST_FRAMES + 2):
        lost = pose.copy()
        lost[0, J["left_wrist"]] = np.nan
        bones.take(lost if frame == 3 else pose)
    stretched = pose.copy()
    stretched[0, J["left_wrist"]] += 0.5 * (pose[0, J["left_wrist"]] - pose[0, J["left_elbow"]])
    np.testing.assert_allclose(bones.put_right(stretched), pose, atol=1e-12)
    np.testing.assert_array_equal(Bones(1).put_right(stretched), stretched)


def test_training_learns_to_predict():
    motion = simulated_clips(60, 12, seed=1)
    few, more = train(motion, 1, 0), train(motion, 60, 0)
    poses = torch.from_numpy(motion.positions.swapaxes(0, 1)).float()
    moved = torch.diff(poses, dim=1, prepend=poses[:, :1])
    errors = [(net(poses, moved)[0][:, :-1] - poses[:, 1:]).abs().mean().item() for net in (few, more)]
    assert errors[1] < 0.8 * errors[0]
