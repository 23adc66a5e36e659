import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.prior.camera.gravity import GRAVITY, GravityEstimator, level_pose

SECOND_NS = 1_000_000_000


def turned(level: GravityEstimator, vector: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(level.pose.orientation).apply(vector)


@pytest.mark.parametrize("seed", range(5))
def test_up_points_up_and_the_camera_looks_along_y(seed: int) -> None:
    up = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_quat(level_pose(up).orientation)
    np.testing.assert_allclose(rotation.apply(up / np.linalg.norm(up)), [0, 0, 1], atol=1e-9)
    forward = rotation.apply([0.0, 0.0, 1.0])
    assert forward[0] == pytest.approx(0.0, abs=1e-9)
    assert forward[1] > 0


@pytest.mark.parametrize("up", [np.zeros(3), np.full(3, np.nan), np.ones(2)])
def test_what_is_no_direction_is_refused(up: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected a direction"):
        level_pose(up)


def test_noise_does_not_shake_the_world_and_turning_the_camera_turns_it() -> None:
    level, rng = GravityEstimator(), np.random.default_rng(0)
    assert not level.measured
    told = set()
    for n in range(500):
        level.update(GRAVITY * np.array([0, -1, 0]) + rng.normal(0, 0.1, 3), n * SECOND_NS // 100)
        told.add(tuple(level.pose.orientation))
    assert level.measured
    assert len(told) <= 3
    np.testing.assert_allclose(turned(level, np.array([0, -1, 0])), [0, 0, 1], atol=0.03)
    up = np.array([0.0, -np.cos(0.3), np.sin(0.3)])
    for n in range(500, 1100):
        level.update(GRAVITY * up + rng.normal(0, 0.1, 3), n * SECOND_NS // 100)
    np.testing.assert_allclose(turned(level, up), [0, 0, 1], atol=0.03)


def test_a_camera_that_is_shaken_keeps_its_level() -> None:
    level = GravityEstimator()
    level.update(np.array([0.0, -GRAVITY, 0.0]), 0)
    before = level.pose
    for n in range(1, 100):
        level.update(np.array([12.0, -GRAVITY, 5.0]), n * SECOND_NS // 100)
        level.update(np.full(3, np.nan), n * SECOND_NS // 100)
    assert level.pose is before
