import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, random_pose

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS, J
from steadypose.prior.models.posture import LEAST_SIGMA, LENGTH_SIGMA, LivePosture, RootCovariance, on_bones

BODIES = 60


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return fk(random_pose(np.random.default_rng(0), BODIES, 0.15))


@pytest.fixture(scope="module")
def posture() -> LivePosture:
    return LivePosture.load("default")


OFFSETS = np.broadcast_to(REST_OFFSETS, (BODIES, 22, 3))


def test_joints_that_are_known_stay(posture: LivePosture, joints: np.ndarray) -> None:
    expected = posture(joints, np.zeros((BODIES, 22)), OFFSETS)
    np.testing.assert_allclose(expected.positions, joints, atol=1e-6)


def test_a_joint_of_which_nothing_is_said_follows_the_others(posture: LivePosture, joints: np.ndarray) -> None:
    sigma, off = np.full((BODIES, 22), 0.002), joints.copy()
    sigma[:, J["spine3"]] = np.nan
    off[:, J["spine3"]] += 0.3
    expected = posture(off, sigma, OFFSETS).positions
    assert np.median(np.linalg.norm(expected - joints, axis=-1)[:, J["spine3"]]) < 0.05


def test_bones_keep_the_persons_lengths(posture: LivePosture, joints: np.ndarray) -> None:
    noisy = joints + np.random.default_rng(4).normal(0.0, 0.03, joints.shape)
    expected = posture(noisy, np.full((BODIES, 22), 0.03), OFFSETS).positions
    off = np.linalg.norm(expected[:, 1:] - expected[:, PARENT[1:]], axis=-1) - np.linalg.norm(OFFSETS[:, 1:], axis=-1)
    assert np.sqrt(np.square(off).mean()) < 0.5 * LENGTH_SIGMA


def test_lengths_of_bones_bring_joints_nearer_and_the_covariance_says_by_how_much(joints: np.ndarray) -> None:
    rng, sigma = np.random.default_rng(3), 0.03
    noisy = joints + rng.normal(0.0, sigma, joints.shape)
    lengths = np.linalg.norm(OFFSETS[:, 1:], axis=-1) + rng.normal(0.0, LENGTH_SIGMA, (BODIES, 21))
    covariance = np.broadcast_to(sigma**2 * np.eye(66), (BODIES, 66, 66))
    mean, left = on_bones(noisy, covariance, lengths)
    error = np.square(mean - joints).sum()
    assert error < 0.8 * np.square(noisy - joints).sum()
    assert 0.9 < error / np.trace(left, axis1=1, axis2=2).sum() < 1.1
    np.testing.assert_allclose(left, left.swapaxes(-1, -2), atol=1e-12)


def test_the_answer_turns_with_the_body_however_it_lies(posture: LivePosture, joints: np.ndarray) -> None:
    turn = Rotation.from_rotvec([1.2, -0.7, 2.0]).as_matrix()
    sigma = np.full((BODIES, 22), 0.02)
    upright, lying = posture(joints, sigma, OFFSETS), posture(joints @ turn.T + 5.0, sigma, OFFSETS)
    np.testing.assert_allclose(lying.positions, upright.positions @ turn.T + 5.0, atol=1e-9)


def test_the_root_is_better_known_than_from_the_joints_alone(posture: LivePosture, joints: np.ndarray) -> None:
    noisy = joints + np.random.default_rng(1).normal(0.0, 0.02, joints.shape)
    true, alone = (solve_rotations(p, OFFSETS)[:, 0] for p in (joints, noisy))
    whole = solve_rotations(posture(noisy, np.full((BODIES, 22), 0.02), OFFSETS).positions, OFFSETS)[:, 0]

    def off(found: np.ndarray) -> float:
        return float(np.median(Rotation.from_matrix(found.swapaxes(-1, -2) @ true).magnitude()))

    assert off(whole) < 0.85 * off(alone)


def test_the_covariance_is_that_of_the_root_solved(posture: LivePosture, joints: np.ndarray) -> None:
    """Draws from the posterior, put through the solver, spread as stated."""
    rng, sigma = np.random.default_rng(2), np.full((1, 22), 0.004)
    body, bones = joints[:1], OFFSETS[:1]
    expected = posture(body, sigma, bones)
    root = solve_rotations(expected.positions, bones)[:, 0]
    drawn = rng.multivariate_normal(np.zeros(66), expected.covariance[0], 4000).reshape(-1, 22, 3)
    positions = expected.positions + drawn @ expected.frame[0].T
    turns = solve_rotations(positions, np.broadcast_to(REST_OFFSETS, positions.shape))[:, 0]
    spread = np.cov(Rotation.from_matrix(turns @ root[0].T).as_rotvec().T)
    stated = RootCovariance()(body, sigma, root)[0] - LEAST_SIGMA**2 * np.eye(3)
    np.testing.assert_allclose(stated, spread, atol=0.15 * np.trace(spread))
