import numpy as np
import torch

from steadypose.benchmarks.baselines.kinect_regression import (
    _OTHER_SIDE,
    Smoothed,
    _mirrored,
    ridge,
    temporal_convolution,
)
from steadypose.benchmarks.metrics import position_error
from steadypose.benchmarks.studies.kinect_clips import OTHER_SIDE, SCORED
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22

SIZES = np.random.default_rng(0).normal(0, 0.3, (len(SCORED), 3))
WAYS = np.random.default_rng(2).normal(0, 0.2, (3, 66))
BIAS = np.random.default_rng(1).normal(0, 0.03, (66, 3 * len(SCORED)))


def lesson(seed: int, frames: int = 50) -> tuple[Smoothed, np.ndarray]:
    """A clip of a sensor whose error hangs on the pose, the same on both sides, and its truth (T, 13, 3)."""
    rng = np.random.default_rng(seed)
    inputs = np.sin(np.linspace(0, 4, frames)[:, None] + rng.uniform(0, 6, 3)) @ WAYS
    poses = torch.from_numpy(inputs)
    error = poses @ torch.from_numpy(BIAS)
    error = (error + _mirrored(_mirrored(poses, _OTHER_SIDE) @ torch.from_numpy(BIAS), OTHER_SIDE)).numpy()
    answer = np.tile(SIZES, (frames, 1, 1))
    return Smoothed(inputs, answer, np.tile(np.eye(3), (frames, 1, 1))), answer + error.reshape(answer.shape)


def gap(answer: np.ndarray, truth: np.ndarray) -> float:
    rotation, translation = rigid_alignment(truth, SIZES + np.zeros_like(truth))
    return float(position_error(answer, truth @ rotation.T + translation).mean())


def test_a_mirror_exchanges_sides_and_twice_is_nothing() -> None:
    assert [KINECT22.joints[k] for k in _OTHER_SIDE][:8] == [*KINECT22.joints[:6], "RCollar", "RUpperArm"]
    assert [SCORED[k] for k in OTHER_SIDE][:3] == ["head", "right_shoulder", "left_shoulder"]
    poses = torch.randn(4, 5, 66)
    once = _mirrored(poses, _OTHER_SIDE)
    left, right = KINECT22.joints.index("LHand"), KINECT22.joints.index("RHand")
    torch.testing.assert_close(
        once[..., 3 * left : 3 * left + 3], poses[..., 3 * right : 3 * right + 3] * torch.tensor([1.0, -1.0, 1.0])
    )
    torch.testing.assert_close(_mirrored(once, _OTHER_SIDE), poses)


def test_both_regressions_learn_an_error_that_hangs_on_the_pose() -> None:
    clips, truths = zip(*(lesson(seed) for seed in range(12)), strict=True)
    asked, truth = lesson(99)
    before = gap(asked.answer, truth)
    assert gap(ridge(clips, truths, penalty=0.01)(asked), truth) < 0.5 * before
    learned = temporal_convolution(clips, truths, OTHER_SIDE, ahead=4, steps=120, seed=0)
    assert gap(learned(asked), truth) < 0.7 * before
