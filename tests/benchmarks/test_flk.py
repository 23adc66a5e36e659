import numpy as np
import torch
from torch import Tensor, nn

from steadypose.benchmarks.baselines.flk import LEAST_FRAMES, Bones, filtered, train
from steadypose.benchmarks.motion import simulated_clips
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.timing.rate import FPS

STAMPS = np.arange(40) / FPS


class Onwards(nn.Module):
    """Knows the motion: every joint moves on as it did."""

    def forward(self, poses: Tensor, moved: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        return poses + moved, state


def straight(speed_m_s: float) -> np.ndarray:
    """(T, 1, 22, 3) metres, a body carried along x."""
    return (REST_POSITIONS + STAMPS[:, None, None] * np.array([speed_m_s, 0.0, 0.0]))[:, None]


def test_who_is_slow_is_taken_as_measured():
    seen = straight(0.1) + np.random.default_rng(0).normal(0.0, 1e-4, (40, 1, 22, 3))
    found = filtered(Onwards(), seen, STAMPS, 0, alpha=1e-3, theta=0.5, kept=1.0)
    np.testing.assert_array_equal(found, seen)


def test_hidden_joint_moves_on_by_the_model():
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
