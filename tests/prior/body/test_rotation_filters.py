import itertools

import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk

from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.rotation_filters import UNKNOWN_TURNS, UNKNOWN_TWIST, follow_short_bones, follow_twist
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS, REST_POSITIONS, J

OFFSETS = REST_OFFSETS[None]
EXACT = np.full((1, 22), 1e-5)
SHOULDER, ELBOW = J["left_shoulder"], J["left_elbow"]
HANDS, FEET = ([J[f"{side}_{joint}"] for side in ("left", "right")] for joint in ("wrist", "foot"))
SHORT = [J[name] for name in ("spine2", "neck", "left_collar", "right_collar")]
FRAMES, SIGMA = 900, 0.02


def _arm(twist: float, bend: float) -> np.ndarray:
    """(1, 22, 3, 3) orientations, by the solver, of a body whose left arm is turned about itself and bent."""
    local = np.tile(np.eye(3), (1, 22, 1, 1))
    local[0, SHOULDER] = Rotation.from_euler("y", twist).as_matrix()
    local[0, ELBOW] = Rotation.from_euler("z", -bend).as_matrix()
    return global_rotations(solve_rotations(fk(local), OFFSETS))


def _local(orientations: np.ndarray) -> np.ndarray:
    local = orientations.copy()
    local[:, 1:] = orientations[:, PARENT[1:]].swapaxes(-1, -2) @ orientations[:, 1:]
    return local


def test_a_bent_arm_shows_its_twist_at_once() -> None:
    turned = _arm(0.5, 1.2)
    as_solved = turned.copy()
    follow_twist(turned, OFFSETS, EXACT, UNKNOWN_TWIST[None].copy())
    np.testing.assert_allclose(turned, as_solved, atol=2e-3)


def test_joints_stay_where_they_are_and_hands_and_toes_go_along() -> None:
    vectors, ends = np.random.default_rng(0).normal(0.0, 0.3, (22, 3)), [*HANDS, *FEET]
    local = Rotation.from_rotvec(vectors).as_matrix()[None]
    turned = global_rotations(local)
    follow_twist(turned, OFFSETS, np.full((1, 22), 0.1), UNKNOWN_TWIST[None].copy())
    found = _local(turned)
    assert Rotation.from_matrix(local[0, SHOULDER].T @ found[0, SHOULDER]).magnitude() > 0.01
    np.testing.assert_allclose(place_joints(found, OFFSETS), place_joints(local, OFFSETS), atol=1e-12)
    np.testing.assert_allclose(found[:, ends], local[:, ends], atol=1e-12)
    np.testing.assert_allclose(turned @ turned.swapaxes(-1, -2), np.tile(np.eye(3), (1, 22, 1, 1)), atol=1e-12)


def test_a_twist_lasts_through_a_straight_arm_without_a_jump() -> None:
    state, found = UNKNOWN_TWIST[None].copy(), []
    for bend in (*np.linspace(1.0, 0.0, 10), *np.linspace(0.0, 1.0, 10)):
        turned = _arm(0.5, bend)
        follow_twist(turned, OFFSETS, EXACT, state)
        found.append(turned[0, SHOULDER])
    steps = [Rotation.from_matrix(a.T @ b).magnitude() for a, b in itertools.pairwise(found)]
    assert max(steps) < np.radians(12)
    assert Rotation.from_matrix(found[0].T @ found[-1]).magnitude() < np.radians(1)


def test_of_noise_a_straight_arm_shows_no_twist() -> None:
    rng, state, turns = np.random.default_rng(0), UNKNOWN_TWIST[None].copy(), []
    for _ in range(50):
        positions = REST_POSITIONS + rng.normal(0.0, 0.01, (1, 22, 3))
        turned = global_rotations(solve_rotations(positions, OFFSETS))
        follow_twist(turned, OFFSETS, np.full((1, 22), 0.01), state)
        turns.append(state[0, 2, 0])
    assert np.std(turns) < 0.25


def _followed(turned: np.ndarray, sigma: float) -> np.ndarray:
    """Orientations (T, 22, 3, 3), one after the other."""
    state, answers = UNKNOWN_TURNS[None].copy(), turned.copy()
    for frame in answers:
        follow_short_bones(frame[None], OFFSETS, np.full((1, 22), sigma), state)
    return answers


def _turned(vectors: np.ndarray) -> np.ndarray:
    """(T, 22, 3, 3) of a body of which only short bones are turned, by vectors (T, 4, 3) about those above."""
    turned = np.broadcast_to(Rotation.from_rotvec([0.3, -0.8, 1.9]).as_matrix(), (len(vectors), 22, 3, 3)).copy()
    turned[:, SHORT] = turned[:, SHORT] @ Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 4, 3, 3)
    return turned


def _off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    apart = found[:, SHORT].swapaxes(-1, -2) @ true[:, SHORT]
    return Rotation.from_matrix(apart.reshape(-1, 3, 3)).magnitude().reshape(-1, 4)


def test_a_perfect_bone_stays_and_so_do_all_others() -> None:
    rng = np.random.default_rng(0)
    true = _turned(rng.normal(0.0, 0.3, (60, 4, 3)))
    found = _followed(true, 1e-5)
    assert np.degrees(_off(found, true)).max() < 0.05
    noisy = _followed(true, SIGMA)
    others = np.setdiff1d(np.arange(22), SHORT)
    np.testing.assert_array_equal(noisy[:, others], true[:, others])


def test_noisy_bones_come_nearer_to_how_this_body_holds_them() -> None:
    rng = np.random.default_rng(1)
    usual = rng.normal(0.0, 0.3, (1, 4, 3)) + np.zeros((FRAMES, 1, 1))
    true, noisy = _turned(usual), _turned(usual + rng.normal(0.0, 0.15, usual.shape))
    off, before = (np.median(_off(answer, true)[FRAMES // 2 :], axis=0) for answer in (_followed(noisy, SIGMA), noisy))
    assert (off < 0.85 * before).all()
    assert off[0] < 0.4 * before[0]  # the spine hardly turns


def test_a_bone_that_is_turned_far_is_followed() -> None:
    vectors = np.zeros((FRAMES, 4, 3))
    vectors[-30:, 1, 1] = 1.0
    found = _followed(_turned(vectors), 0.005)
    assert _off(found, _turned(vectors))[-1, 1] < 0.05
