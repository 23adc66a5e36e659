import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import rankdata

from steadypose.prior.sim.noise import (
    KINECT_NOISE,
    SWAP_GROUPS,
    NoiseModel,
    confidence_of,
    draw_errors,
    ray_axes,
    swapped,
    travelled,
)
from steadypose.prior.sim.scripts import SCRIPTS

MODEL = NoiseModel.load()
NO_JUMPS = replace(MODEL, jump_rate=np.zeros(22))


def evenly(seconds: float, fps: float, speed: float = 0.0, batch: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Travel (batch, T, 22) and dt (T,) of joints that all move at one speed."""
    frames = round(seconds * fps)
    return np.full((batch, frames, 22), speed / fps), np.full(frames, 1 / fps)


def test_a_still_joint_keeps_its_bias_and_a_moving_one_loses_it() -> None:
    still, moving = (
        draw_errors(*evenly(6.0, 30.0, speed, batch=64), np.random.default_rng(0), NO_JUMPS).steady
        for speed in (0.0, 0.5)
    )
    np.testing.assert_allclose(still[:, -1], still[:, 30], atol=0.002)
    changed = np.median(np.abs(moving[:, -1] - moving[:, 30]))
    assert changed > 0.005


@pytest.mark.parametrize("fps", [15.0, 60.0])
def test_noise_is_a_matter_of_seconds_not_of_frames(fps: float) -> None:
    def spread(rate: float) -> tuple[float, float]:
        drawn = draw_errors(*evenly(4.0, rate, 0.3, batch=100), np.random.default_rng(0), MODEL)
        return float(np.median(np.abs(drawn.quick))), float(np.median(np.abs(drawn.steady)))

    assert spread(fps) == pytest.approx(spread(30.0), rel=0.15)


def test_fast_joints_are_noisier() -> None:
    slow, fast = (
        np.median(np.abs(draw_errors(*evenly(2.0, 30.0, v, batch=100), np.random.default_rng(0), NO_JUMPS).quick))
        for v in (0.02, 0.8)
    )
    assert fast > 3 * slow


def test_jumps_come_as_often_as_said_and_end() -> None:
    quiet = replace(
        MODEL, fast=np.zeros((22, 3)), offset=np.zeros((22, 3)), bias=np.zeros((22, 3)), session_spread=0.0,
        jump_rate=np.full(22, 0.2),
    )  # fmt: skip
    drawn = draw_errors(*evenly(60.0, 30.0, batch=4), np.random.default_rng(0), quiet).quick
    displaced = np.linalg.norm(drawn, axis=-1)
    begins = ((displaced[:, 1:] > 0) & (displaced[:, :-1] != displaced[:, 1:])).sum() / (4 * 22 * 60.0)
    assert begins == pytest.approx(0.2, rel=0.1)
    assert displaced[displaced > 0].min() >= quiet.jump_minimum * (1 - 1e-9)
    mean = quiet.jump_short_share * quiet.jump_short + (1 - quiet.jump_short_share) * quiet.jump_long
    assert (displaced > 0).mean() == pytest.approx(0.2 * mean, rel=0.25)


def test_noise_has_heavy_tails_and_memory_and_confidence_is_informative() -> None:
    motion = SCRIPTS["reach"](np.random.default_rng(0))[0].positions[::4]
    sessions = np.repeat(travelled(motion)[None], 24, axis=0)
    drawn = draw_errors(sessions, np.full(len(motion), 1 / 30), np.random.default_rng(3), MODEL)
    error = drawn.steady + drawn.quick
    size = np.linalg.norm(error, axis=-1)
    assert 0.015 < np.median(size) < 0.06
    assert 2.5 < np.percentile(size, 95) / np.median(size) < 7.0, "1.6 for a Gaussian"
    centred = error - error.mean(axis=1, keepdims=True)
    assert (centred[:, 1:] * centred[:, :-1]).sum() / (centred**2).sum() > 0.5
    confidence = confidence_of(drawn.scale, np.random.default_rng(0))
    assert -0.85 < float(np.corrcoef(rankdata(confidence), rankdata(size))[0, 1]) < -0.25
    small, large = (confidence_of(np.full(1000, s), np.random.default_rng(0)).mean() for s in (0.01, 0.3))
    assert small > 0.8
    assert large < 0.2


def test_swaps_last_a_moment() -> None:
    when = swapped(np.full(900, 1 / 30), (), np.random.default_rng(1), rate_factor=20.0)
    assert when.keys() == SWAP_GROUPS.keys()
    assert all(0 < active.mean() < 0.3 for active in when.values())


def test_ray_axes_are_right_handed() -> None:
    rays = np.random.default_rng(0).normal(size=(50, 3))
    axes = ray_axes(rays)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, -1, -2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(ray_axes(np.array([1.0, 0.0, 0.0])), [[1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


def test_a_file_of_another_making_is_refused(tmp_path: Path) -> None:
    content = json.loads(KINECT_NOISE.read_text())
    del content["parameters"]["fast"]
    path = tmp_path / "noise.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="expected parameters"):
        NoiseModel.load(path)
