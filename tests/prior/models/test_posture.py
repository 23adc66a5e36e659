from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from tests.helpers.bodies import fk, random_pose

from steadypose.prior.body.kinematics import to_rotation_vectors
from steadypose.prior.body.skeleton import HIPS, JOINTS, PARENT, REST_OFFSETS, REST_POSITIONS, SHOULDERS, J
from steadypose.prior.models import pelvis
from steadypose.prior.models import posture as stage
from steadypose.prior.models.pelvis import RootCovariance, rigid_pelvis
from steadypose.prior.models.posture import LENGTH_SIGMA, LivePosture, on_bones

BODIES = 60
POSED = [*HIPS, *SHOULDERS]


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    return fk(random_pose(np.random.default_rng(0), BODIES, 0.15))


@pytest.fixture(scope="module")
def posture() -> LivePosture:
    return LivePosture.load("default")


OFFSETS = np.broadcast_to(REST_OFFSETS, (BODIES, 22, 3))
LENGTHS = np.linalg.norm(OFFSETS, axis=-1)


def test_joints_that_are_known_stay(posture: LivePosture, joints: np.ndarray) -> None:
    expected = posture(joints, np.zeros((BODIES, 22)), LENGTHS)
    np.testing.assert_allclose(expected.positions, joints, atol=1e-6)


def test_a_joint_of_which_nothing_is_said_follows_the_others(posture: LivePosture, joints: np.ndarray) -> None:
    sigma, off = np.full((BODIES, 22), 0.002), joints.copy()
    sigma[:, J["spine3"]] = np.nan
    off[:, J["spine3"]] += 0.3
    expected = posture(off, sigma, LENGTHS).positions
    assert np.median(np.linalg.norm(expected - joints, axis=-1)[:, J["spine3"]]) < 0.05


@pytest.mark.parametrize(
    "hidden", [(), ("left_wrist", "right_foot"), ("spine1", "spine2", "left_collar", "right_collar")]
)
def test_the_misfit_is_minus_the_log_likelihood_up_to_a_constant(posture: LivePosture, hidden: tuple[str, ...]) -> None:
    body = REST_POSITIONS + np.random.default_rng(6).normal(0.0, 0.03, (4, 22, 3))
    body[1:, POSED] = body[:1, POSED]  # the frame and the size of all are those of the first
    known = np.array(
        [not {name, name.replace("left", "right"), name.replace("right", "left")} & {*hidden} for name in JOINTS]
    )
    middle = body[0, [*HIPS, *SHOULDERS]].mean(axis=0)
    both = known[1:] & known[PARENT[1:]]
    size = np.median(np.linalg.norm(body[0, 1:] - body[0, PARENT[1:]], axis=-1)[both] / LENGTHS[0, 1:][both])
    local = (body - middle) @ stage.trunk_frame(body[:1])[0] / size
    rows = np.repeat(known, 3)
    covariance: Any = posture.covariance[np.ix_(rows, rows)] + 0.03**2 * np.eye(rows.sum())
    likely = multivariate_normal.logpdf(local.reshape(4, -1)[:, rows], posture.mean[rows], covariance)
    body[:, [J[name] for name in hidden]] = np.nan
    misfit = posture.misfit(body, 0.03)
    np.testing.assert_allclose(misfit - misfit[0], likely[0] - likely, atol=1e-6)


def test_joints_that_coincide_have_a_misfit(posture: LivePosture) -> None:
    assert np.isfinite(posture.misfit(np.ones((2, 22, 3)), 0.03)).all()


def test_bones_keep_the_persons_lengths(posture: LivePosture, joints: np.ndarray) -> None:
    noisy = joints + np.random.default_rng(4).normal(0.0, 0.03, joints.shape)
    expected = posture(noisy, np.full((BODIES, 22), 0.03), LENGTHS).positions
    off = np.linalg.norm(expected[:, 1:] - expected[:, PARENT[1:]], axis=-1) - LENGTHS[:, 1:]
    assert np.sqrt(np.square(off).mean()) < 0.5 * LENGTH_SIGMA


def test_the_deviation_of_the_answer_is_honest(posture: LivePosture, joints: np.ndarray) -> None:
    noisy = joints + np.random.default_rng(5).normal(0.0, 0.02, joints.shape)
    expected = posture(noisy, np.full((BODIES, 22), 0.02), LENGTHS)
    error = np.square(expected.positions - joints).mean(axis=-1)
    assert 0.5 < error.mean() / np.square(expected.sigma).mean() < 1.3


def test_a_wider_gaussian_moves_joints_less(posture: LivePosture, joints: np.ndarray) -> None:
    noisy, sigma = joints + np.random.default_rng(6).normal(0.0, 0.02, joints.shape), np.full((BODIES, 22), 0.02)
    own = np.where(np.arange(BODIES) < BODIES // 2, 1.0, 8.0)
    once, wider, both = (posture(noisy, sigma, LENGTHS, spread).positions for spread in (1.0, 8.0, own))
    assert np.linalg.norm(wider - noisy, axis=-1).mean() < 0.95 * np.linalg.norm(once - noisy, axis=-1).mean()
    np.testing.assert_array_equal(both, np.where((own == 1.0)[:, None, None], once, wider))


def test_a_joint_that_the_gaussian_moves_too_far_moves_less(posture: LivePosture, joints: np.ndarray) -> None:
    seen, sigma, wrist = joints[:1].copy(), np.full((1, 22), 0.01), J["left_wrist"]
    seen[0, wrist] += (0.0, 0.0, 0.5)  # far from where training people have it
    bones = np.linalg.norm(seen - seen[:, PARENT], axis=-1)
    free, limited = (posture(seen, sigma, bones, limit=limit).positions[0] - seen[0] for limit in (np.inf, 1.5))
    assert np.linalg.norm(limited[wrist]) < 0.75 * np.linalg.norm(free[wrist])
    assert limited[wrist] @ free[wrist] > 0.9 * np.linalg.norm(limited[wrist]) * np.linalg.norm(free[wrist])


def test_moves_are_measured_in_their_own_standard_deviations(posture: LivePosture) -> None:
    rng, count, sigma = np.random.default_rng(8), 400, 0.02
    drawn = rng.multivariate_normal(posture.mean, posture.covariance + sigma**2 * np.eye(66), count)
    left, off = np.empty((count, 66, 66)), drawn - posture.mean
    noise, observed = np.full((count, 66), sigma**2), off.copy()
    stage._condition(posture.covariance - stage.UNLIKE**2 * np.eye(66), np.ones(count), noise, off, left)
    moved = (off - observed).reshape(count, 22, 3)
    blocks = np.stack([left[:, k : k + 3, k : k + 3] for k in range(0, 66, 3)], axis=1)
    ratio = np.einsum("bji,bji->bj", moved, np.linalg.solve(sigma**2 * np.eye(3) - blocks, moved[..., None])[..., 0])
    assert 2.7 < ratio.mean() < 3.3, "a chi-squared distribution of three dimensions"
    limited = off.copy()
    stage._limit(1.5, noise, observed, limited, left)
    share = np.linalg.norm((limited - observed).reshape(count, 22, 3), axis=-1) / np.linalg.norm(moved, axis=-1)
    assert (share[ratio < 1.5**2] > 1.0 - 1e-9).all()
    np.testing.assert_allclose(share, np.minimum(1.0, 1.5 / np.sqrt(ratio)), rtol=0.15)


def test_lengths_of_bones_bring_joints_nearer_and_the_covariance_says_by_how_much(joints: np.ndarray) -> None:
    rng, sigma = np.random.default_rng(3), 0.03
    noisy = joints + rng.normal(0.0, sigma, joints.shape)
    lengths = LENGTHS[:, 1:] + rng.normal(0.0, LENGTH_SIGMA, (BODIES, 21))
    covariance = np.broadcast_to(sigma**2 * np.eye(66), (BODIES, 66, 66))
    mean, left = on_bones(noisy, covariance, lengths)
    error = np.square(mean - joints).sum()
    assert error < 0.8 * np.square(noisy - joints).sum()
    assert 0.9 < error / np.trace(left, axis1=1, axis2=2).sum() < 1.1
    np.testing.assert_allclose(left, left.swapaxes(-1, -2), atol=1e-12)


def test_the_answer_turns_with_the_body_however_it_lies(posture: LivePosture, joints: np.ndarray) -> None:
    turn = Rotation.from_rotvec([1.2, -0.7, 2.0]).as_matrix()
    sigma = np.full((BODIES, 22), 0.02)
    upright, lying = posture(joints, sigma, LENGTHS), posture(joints @ turn.T + 5.0, sigma, LENGTHS)
    np.testing.assert_allclose(lying.positions, upright.positions @ turn.T + 5.0, atol=1e-9)


def _root(posture: LivePosture, joints: np.ndarray, sigma: float) -> np.ndarray:
    deviations = np.full((BODIES, 22), sigma)
    root = posture.root(posture(joints, deviations, LENGTHS))
    return pelvis.average_root(root, joints, deviations, OFFSETS)


def _angles(turned: np.ndarray, true: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(turned.swapaxes(-1, -2) @ true).magnitude()


def test_a_perfect_pelvis_is_turned_as_its_own_joints_say_however_the_spine_bends(posture: LivePosture) -> None:
    turns = random_pose(np.random.default_rng(0), BODIES, 0.3)
    assert np.degrees(_angles(_root(posture, fk(turns), 0.0), turns[:, 0])).max() < 0.01


def test_the_root_is_better_known_than_from_its_own_joints(posture: LivePosture, joints: np.ndarray) -> None:
    noisy = joints + np.random.default_rng(1).normal(0.0, 0.02, joints.shape)
    true = rigid_pelvis(joints, OFFSETS)
    alone, whole = rigid_pelvis(noisy, OFFSETS), _root(posture, noisy, 0.02)
    assert np.median(_angles(whole, true)) < 0.75 * np.median(_angles(alone, true))


def test_the_covariance_of_the_root_is_honest(posture: LivePosture, joints: np.ndarray) -> None:
    sigma = 0.015
    noisy = joints + np.random.default_rng(2).normal(0.0, sigma, joints.shape)
    root = _root(posture, noisy, sigma)
    error = to_rotation_vectors(_root(posture, joints, 0.0) @ root.swapaxes(-1, -2))
    covariance = RootCovariance()(noisy, np.full((BODIES, 22), sigma), root)
    white = np.linalg.solve(covariance, error[..., None])[..., 0]
    assert 0.5 < (error * white).sum(axis=-1).mean() / 3.0 < 1.4


def test_a_perfect_root_is_said_to_be_as_sure_as_any(posture: LivePosture, joints: np.ndarray) -> None:
    root = _root(posture, joints, 0.0)
    covariance = RootCovariance()(joints, np.zeros((BODIES, 22)), root)
    expected = np.broadcast_to(pelvis.LEAST_SIGMA**2 * np.eye(3), covariance.shape)
    np.testing.assert_allclose(covariance, expected, atol=1e-6)


def test_a_rigid_pelvis_is_turned_as_its_bones_are() -> None:
    turns = random_pose(np.random.default_rng(0), BODIES, 0.4)
    np.testing.assert_allclose(rigid_pelvis(fk(turns), OFFSETS), turns[:, 0], atol=1e-9)


def test_its_covariance_is_the_spread_of_noisy_pelvises() -> None:
    rng, count = np.random.default_rng(1), 4000
    turns = np.repeat(random_pose(rng, 1, 0.4), count, axis=0)
    sigma = np.full((count, 22), 0.002)
    sigma[:, [0, 3]] = 0.004
    bones = np.broadcast_to(REST_OFFSETS, (count, 22, 3))
    noisy = rigid_pelvis(fk(turns) + rng.normal(0.0, 1.0, (count, 22, 3)) * sigma[..., None], bones)
    spread = np.cov(Rotation.from_matrix(turns[:, 0].swapaxes(-1, -2) @ noisy).as_rotvec().T)
    stated = pelvis.rigid_covariance(sigma[:1], bones[:1])[0]
    np.testing.assert_allclose(stated, spread, atol=0.06 * np.trace(spread))
