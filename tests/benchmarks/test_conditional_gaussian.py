import numpy as np
import pytest

from steadypose.benchmarks.baselines.body import ConditionalGaussian
from steadypose.benchmarks.studies.hidden_joints import given_the_seen
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS, J

ELBOW, WRIST, HEAD = J["left_elbow"], J["left_wrist"], J["head"]


def poses(count: int, seed: int) -> np.ndarray:
    """Bodies anywhere, facing anywhere: an elbow moves at random, the wrist by 0.6 of it and by as much at random."""
    rng = np.random.default_rng(seed)
    body = np.tile(REST_POSITIONS, (count, 1, 1))
    swing, own = 0.1 * rng.standard_normal((2, count, 3))
    body[:, ELBOW] += swing
    body[:, WRIST] += 0.6 * swing + own
    body[:, HEAD] += 0.05 * rng.standard_normal((count, 3))
    turn = yaw_matrix(rng.uniform(-np.pi, np.pi, count))
    return body @ turn.swapaxes(-1, -2) + rng.uniform(-3, 3, (count, 1, 3))


@pytest.fixture(scope="module")
def gaussian() -> ConditionalGaussian:
    return ConditionalGaussian(poses(20_000, 0))


def test_a_hidden_joint_is_the_regression_on_the_seen_ones(gaussian: ConditionalGaussian) -> None:
    """Closed form: E[wrist | elbow] = rest + 0.6 (elbow - rest), whatever else is seen, place and heading."""
    rng = np.random.default_rng(1)
    body, angle, place = np.array(REST_POSITIONS), rng.uniform(-np.pi, np.pi), rng.uniform(-3, 3, 3)
    swing = np.array([0.1, -0.05, 0.2])
    body[ELBOW] += swing
    expected = body[WRIST] + 0.6 * swing
    turn = yaw_matrix(np.array(angle))
    seen = body @ turn.T + place
    seen[WRIST] = np.nan
    found = gaussian(seen[None, None])[0, 0]
    np.testing.assert_allclose(found[WRIST], turn @ expected + place, atol=5e-3)
    np.testing.assert_array_equal(np.delete(found, WRIST, axis=0), np.delete(seen, WRIST, axis=0))


def test_two_hidden_joints_that_nothing_tells_of_are_at_their_means(gaussian: ConditionalGaussian) -> None:
    seen = np.array(REST_POSITIONS)
    seen[[WRIST, ELBOW]] = np.nan
    np.testing.assert_allclose(gaussian(seen)[[WRIST, ELBOW]], REST_POSITIONS[[WRIST, ELBOW]], atol=5e-3)


@pytest.mark.parametrize("hidden", [[], [J["pelvis"]], [J["left_hip"], WRIST], list(range(22))])
def test_without_a_frame_to_answer_in_it_answers_nothing(hidden: list[int]) -> None:
    seen = poses(3, 2)
    seen[:, hidden] = np.nan
    np.testing.assert_array_equal(ConditionalGaussian(poses(100, 0))(seen), seen)


def test_a_heading_that_is_given_does_without_hips_and_shoulders(gaussian: ConditionalGaussian) -> None:
    anchors = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "shoulder")]
    turn = yaw_matrix(np.array([0.3, 2.0]))
    truth = np.einsum("nab,jb->nja", turn, REST_POSITIONS)
    seen = truth.copy()
    seen[:, anchors] = np.nan
    np.testing.assert_allclose(gaussian(seen, np.array([0.3, 2.0])), truth, atol=5e-3)


def test_one_shoulder_and_both_hips_give_a_heading_and_without_any_a_joint_is_held_beside_the_body() -> None:
    gaussian, turn = ConditionalGaussian(poses(20_000, 0)), yaw_matrix(np.array([0.3, 2.0]))
    truth = np.tile(np.einsum("nab,jb->nja", turn, REST_POSITIONS), (12, 1, 1, 1))
    seen = truth.copy()
    seen[:, :, [J["left_shoulder"], ELBOW, WRIST]] = np.nan
    found = given_the_seen(seen, np.arange(12) / 30, 4, gaussian)
    np.testing.assert_allclose(found, truth, atol=5e-3)
    seen[6:, :, [J["right_hip"], J["right_shoulder"]]] = np.nan
    found = given_the_seen(seen, np.arange(12) / 30, 4, gaussian)[:, :, J["right_shoulder"]]
    np.testing.assert_allclose(found, truth[:, :, J["right_shoulder"]], atol=5e-3)
