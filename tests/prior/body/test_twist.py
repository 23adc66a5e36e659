import itertools

import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk

from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.rotation_filters import follow_twist, unknown_twist
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS, J

OFFSETS = REST_OFFSETS[None]
EXACT = np.full((1, 22), 1e-5)
SHOULDER, ELBOW = J["left_shoulder"], J["left_elbow"]


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
    follow_twist(turned, OFFSETS, EXACT, unknown_twist(1))
    np.testing.assert_allclose(turned, as_solved, atol=2e-3)


def test_joints_stay_where_they_are() -> None:
    turned, noisy = _arm(0.5, 0.2), np.full((1, 22), 0.03)
    before = place_joints(_local(turned), OFFSETS)
    follow_twist(turned, OFFSETS, noisy, unknown_twist(1))
    np.testing.assert_allclose(place_joints(_local(turned), OFFSETS), before, atol=1e-12)
    np.testing.assert_allclose(turned @ turned.swapaxes(-1, -2), np.tile(np.eye(3), (1, 22, 1, 1)), atol=1e-12)


def test_a_twist_lasts_through_a_straight_arm_without_a_jump() -> None:
    state, found = unknown_twist(1), []
    for bend in (*np.linspace(1.0, 0.0, 10), *np.linspace(0.0, 1.0, 10)):
        turned = _arm(0.5, bend)
        follow_twist(turned, OFFSETS, EXACT, state)
        found.append(turned[0, SHOULDER])
    steps = [Rotation.from_matrix(a.T @ b).magnitude() for a, b in itertools.pairwise(found)]
    assert max(steps) < np.radians(12)
    assert Rotation.from_matrix(found[0].T @ found[-1]).magnitude() < np.radians(1)


def test_of_noise_a_straight_arm_shows_no_twist() -> None:
    rng, state, turns = np.random.default_rng(0), unknown_twist(1), []
    for _ in range(50):
        positions = fk(np.tile(np.eye(3), (1, 22, 1, 1))) + rng.normal(0.0, 0.01, (1, 22, 3))
        turned = global_rotations(solve_rotations(positions, OFFSETS))
        follow_twist(turned, OFFSETS, np.full((1, 22), 0.01), state)
        turns.append(state[0, 2, 0])
    assert np.std(turns) < 0.25
