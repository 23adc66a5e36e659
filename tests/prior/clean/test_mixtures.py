import numpy as np
import pytest

from steadypose.msgs.types import JointState
from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.clean.posture import mix

RNG = np.random.default_rng(4)
SPINES, COLLARS = [J["spine1"], J["spine2"]], [J["left_collar"], J["right_collar"]]


def estimate(bodies: int = 2) -> Estimate:
    """Joints anywhere, each known to a centimetre."""
    return Estimate(
        stamp_s=0.0,
        positions=RNG.normal(size=(bodies, 22, 3)),
        rotations=np.tile(np.eye(3), (bodies, 22, 1, 1)),
        offsets=np.zeros((bodies, 22, 3)),
        sigma=np.full((bodies, 22), 0.01),
        state=np.full((bodies, 22), JointState.REFINED, dtype=np.uint8),
    )


def test_joints_that_a_kinect_lacks_are_means_of_its_own_in_the_body_that_lacks_them_alone() -> None:
    given, unseen_s = estimate(), np.zeros((2, 22))
    unseen_s[1, SPINES + COLLARS] = np.inf
    mixed = mix(given, unseen_s)
    p = given.positions[1]
    np.testing.assert_allclose(mixed.positions[1, J["spine2"]], 0.2 * p[J["pelvis"]] + 0.8 * p[J["spine3"]])
    collar = 0.333 * p[J["spine3"]] + 0.278 * p[J["neck"]] + 0.389 * p[J["right_shoulder"]]
    np.testing.assert_allclose(mixed.positions[1, J["right_collar"]], collar)
    assert mixed.sigma[1, COLLARS] == pytest.approx(np.sqrt(0.003**2 + 1e-4 * (0.333**2 + 0.278**2 + 0.389**2)))
    assert mixed.sigma[1, J["spine1"]] == pytest.approx(np.sqrt(0.008**2 + 1e-4 * (0.63**2 + 0.37**2)))
    others = np.delete(np.arange(22), SPINES + COLLARS)
    np.testing.assert_array_equal(mixed.positions[1, others], p[others])
    np.testing.assert_array_equal(mixed.positions[0], given.positions[0])
    np.testing.assert_array_equal(mixed.sigma[0], given.sigma[0])


def test_a_spine_between_joints_that_are_unknown_too_follows_from_rotations() -> None:
    given, unseen_s = estimate(1), np.zeros((1, 22))
    unseen_s[0, [*SPINES, *COLLARS, J["spine3"]]] = np.inf
    mixed = mix(given, unseen_s)
    np.testing.assert_array_equal(mixed.positions[0, SPINES], given.positions[0, SPINES])
    assert (mixed.positions[0, COLLARS] != given.positions[0, COLLARS]).all()


def test_a_joint_that_is_hidden_for_a_while_is_no_mixture() -> None:
    given, unseen_s = estimate(1), np.zeros((1, 22))
    unseen_s[0, SPINES + COLLARS] = 3.0
    assert mix(given, unseen_s) is given
