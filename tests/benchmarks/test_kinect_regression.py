import numpy as np
import pytest
import torch

from steadypose.benchmarks.baselines import kinect_regression
from steadypose.benchmarks.baselines.kalman import fixed_lag
from steadypose.benchmarks.baselines.kinect_regression import _OTHER_SIDE, Smoothed, _mirrored, ridge
from steadypose.benchmarks.scores import position_error
from steadypose.benchmarks.studies.kinect_methods import OTHER_SIDE, SCORED
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import J
from steadypose.training.data.recordings import trunk_frame

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
    other = poses[..., 3 * right : 3 * right + 3] * torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(once[..., 3 * left : 3 * left + 3], other)
    torch.testing.assert_close(_mirrored(once, _OTHER_SIDE), poses)


def test_both_regressions_learn_an_error_that_hangs_on_the_pose() -> None:
    clips, truths = zip(*(lesson(seed) for seed in range(12)), strict=True)
    asked, truth = lesson(99)
    before = gap(asked.answer, truth)
    assert gap(ridge(clips, truths, penalty=0.01)(asked), truth) < 0.17 * before
    assert gap(ridge(clips, truths, penalty=1e9)(asked), truth) > 0.5 * before
    learned = kinect_regression.temporal_convolution(clips, truths, OTHER_SIDE, ahead=4, steps=60, seed=0)
    assert gap(learned(asked), truth) < 0.27 * before


def test_a_clip_is_smoothed_with_the_part_of_the_delay_that_is_not_looked_ahead() -> None:
    rng, scored = np.random.default_rng(3), [J[name] for name in SCORED]
    clips = [rng.normal(0, 0.4, (22, 3)) + np.cumsum(rng.normal(0, 0.02, (n, 22, 3)), axis=0) for n in (30, 12)]
    for ahead in (0, 3):
        found = kinect_regression.smoothed(clips, scored, delay=4, ahead=ahead, density=2.0)
        for clip, one in zip(clips, found, strict=True):
            late, early = (fixed_lag(clip[:, None], np.arange(len(clip)) / 30, d, 2, 2.0)[:, 0] for d in (4, 4 - ahead))
            bodies = [to_canonical(KINECT22, seen)[0] for seen in (late, early)]
            trunks = [trunk_frame(body) for body in bodies]
            np.testing.assert_allclose(one.answer, bodies[0][:, scored])
            np.testing.assert_allclose(one.trunk, trunks[0])
            hips = (bodies[1][:, J["left_hip"]] + bodies[1][:, J["right_hip"]])[:, None] / 2
            np.testing.assert_allclose(one.inputs, ((early - hips) @ trunks[1]).reshape(len(clip), -1), atol=1e-12)
    assert [kinect_regression.look_ahead(delay) for delay in (0, 2, 4, 8)] == [0, 2, 4, 4]


def test_what_is_missing_leads_from_the_clip_to_the_truth_that_is_moved_to_it() -> None:
    rng = np.random.default_rng(4)
    trunk = np.linalg.qr(rng.normal(size=(20, 3, 3)))[0]
    clip = Smoothed(np.zeros((20, 66)), rng.normal(size=(20, 13, 3)), trunk)
    truth = clip.answer @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + 0.1 * rng.normal(size=(20, 13, 3))
    rotation, translation = rigid_alignment(truth, clip.answer)
    missing = clip.missing(truth)
    np.testing.assert_allclose(clip.corrected(missing), truth @ rotation.T + translation)
    own = (truth @ rotation.T + translation - clip.answer)[7] @ trunk[7]
    np.testing.assert_allclose(missing[7], own.ravel())


@pytest.mark.parametrize("ahead", [0, 4])
def test_a_convolution_reads_twenty_four_frames_that_end_where_it_may_look(ahead: int) -> None:
    clips, truths = zip(*(lesson(seed) for seed in range(3)), strict=True)
    learned = kinect_regression.temporal_convolution(clips, truths, OTHER_SIDE, ahead, steps=2, seed=0)
    clip = lesson(5, 70)[0]
    before = learned(clip)
    clip.inputs[40] += 1.0
    changed = np.flatnonzero(np.abs(learned(clip) - before).max(axis=(1, 2)) > 1e-9)
    assert (changed.min(), changed.max(), len(changed)) == (40 - ahead, 40 + 23 - ahead, 24)
