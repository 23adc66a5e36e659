import numpy as np
import pytest
from tests.helpers.bodies import waving

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import RIGID
from steadypose.prior.body.skeleton import JOINTS, PARENT, J
from steadypose.prior.clean.fuse import (
    DERIVED_SIGMA,
    Precision,
    _align,
    _completable,
    _complete,
    _determined,
    _merge,
    _output_sigma,
    _rigid_variance,
    _unobserved_of_subtree,
    _weigh,
)
from steadypose.prior.clean.occluded import _unobserved_part_factors

ELBOW, WRIST, SHOULDER, KNEE, PELVIS = (
    J[name] for name in ("left_elbow", "left_wrist", "left_shoulder", "right_knee", "pelvis")
)


def unobserved(**seconds: float) -> np.ndarray:
    """(1, 22) all seen but these."""
    found = np.zeros((1, 22))
    for name, value in seconds.items():
        found[0, J[name]] = value
    return found


def test_a_joint_is_held_by_whatever_is_seen_below_it() -> None:
    found = _unobserved_of_subtree(
        unobserved(left_shoulder=2.0, left_elbow=1.0, left_wrist=0.5, right_elbow=1.0, pelvis=3.0)
    )
    assert found[0, [SHOULDER, ELBOW, WRIST]].tolist() == [0.5, 0.5, 0.5]
    assert found[0, [J["right_elbow"], PELVIS]].tolist() == [0.0, 0.0]


def test_variances_of_smoother_and_bias_add_and_those_of_the_prior_grow_until_it_fades() -> None:
    deviation, held = np.full((1, 22), 0.03), unobserved(left_wrist=2.0, left_elbow=9.0)
    deviation[0, KNEE] = np.inf
    seen, prior = _weigh(deviation, held, np.array([0.04]), 0.1, 0.25, 3.0)
    assert seen[0, WRIST] == pytest.approx(1 / 0.05**2)
    assert seen[0, KNEE] == 0.0
    assert prior[0, [PELVIS, WRIST, ELBOW]] == pytest.approx(
        [1 / 0.1**2, 1 / (0.1**2 + 0.5**2), 1 / (0.1**2 + 0.75**2)]
    )
    assert np.isfinite(_weigh(0 * deviation[:, :0], held[:, :0], np.zeros(1), 0.0, 0.0, 3.0)[0]).all()


def test_a_body_is_put_where_most_that_is_seen_of_it_says() -> None:
    seen, body = waving(1), waving(1) - [0.5, 0.2, -0.1]
    seen[0, WRIST], seen[0, ELBOW] = np.nan, seen[0, ELBOW] + 0.3
    precision = Precision(np.full((1, 22), 300.0), np.full((1, 22), 100.0))
    precision.smoother[0, [WRIST, ELBOW]] = 0.0, 25.0  # shares of 0.75, and of 0.2 of the elbow
    precise = _align(body, seen, precision)
    off = 0.2 / (20 * 0.75 + 0.2) * 0.3
    np.testing.assert_allclose(body, waving(1) + off, atol=1e-9)
    assert np.flatnonzero(np.isnan(precise[0, :, 0])).tolist() == sorted([ELBOW, WRIST])
    np.testing.assert_array_equal(precise[0, KNEE], seen[0, KNEE])


TRUNK = {"pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"}


def determined(gone: Floats) -> set[str]:
    return {JOINTS[joint] for joint in np.flatnonzero(_determined(gone)[0])}


def test_the_trunk_follows_from_joints_on_two_sides_of_each_and_limbs_do_not() -> None:
    assert determined(np.zeros((1, 22))) == TRUNK
    assert determined(unobserved(left_elbow=np.inf, left_knee=np.inf, spine2=np.inf)) == TRUNK
    assert determined(unobserved(head=np.inf)) == TRUNK - {"neck"}


def test_arms_and_head_alone_and_one_side_alone_do_not_determine_the_trunk() -> None:
    shown = ["left_shoulder", "right_shoulder", "left_wrist", "right_wrist", "head"]
    counter = np.full((1, 22), np.inf)
    counter[0, [J[name] for name in shown]] = 0.0
    assert determined(counter) == set()
    counter[0, J["left_hip"]] = 5.0
    assert determined(counter) >= TRUNK - {"pelvis"}
    side = np.full((1, 22), np.inf)
    side[0, [J[name] for name in ("left_hip", "left_shoulder", "left_ankle", "head")]] = 0.0
    assert determined(side) == set()
    side[0, J["right_knee"]] = 0.0
    assert determined(side) >= {"pelvis", "spine1", "spine2", "spine3"}


def test_what_is_hidden_is_completed_but_for_what_follows_and_lost_frames() -> None:
    gone = unobserved(left_elbow=np.inf, right_wrist=np.inf, spine2=np.inf, left_wrist=0.5)
    completed = waving(1)
    assert {JOINTS[joint] for joint in np.flatnonzero(_completable(gone, completed)[0])} == {
        "left_elbow", "right_wrist", "left_wrist"
    }  # fmt: skip
    completed[0, WRIST] = np.nan
    assert not _completable(gone, completed)[0, WRIST]
    assert not _completable(np.full((1, 22), 0.1), completed).any(), "a frame that was lost whole"


def test_a_completion_is_moved_by_its_error_at_joints_seen_the_nearest_most() -> None:
    seen, completed, body, hidden = waving(1), waving(1), np.zeros((1, 22, 3)), np.zeros((1, 22), dtype=bool)
    hidden[0, WRIST] = True
    completed[0, ELBOW, 0] -= 0.10
    completed[0, SHOULDER, 0] -= 0.01
    apart = np.full((1, 22), 1.0)
    apart[0, [ELBOW, SHOULDER]] = 0.0  # the only ones seen: one bone from the wrist, and two
    _complete(body, completed, seen, apart, hidden, np.full((1, 22), 7.0))
    moved = body[0, WRIST] - completed[0, WRIST]
    assert moved == pytest.approx([(0.10 / 4 + 0.01 / 9) / (1 / 4 + 1 / 9), 0.0, 0.0])
    precise = np.full((1, 22), 7.0)
    precise[0, SHOULDER] = 0.0
    _complete(body, completed, seen, apart, hidden, precise)
    assert body[0, WRIST, 0] - completed[0, WRIST, 0] == pytest.approx(0.10)
    assert not np.delete(body, WRIST, axis=1).any()


def test_a_hidden_joint_is_the_weighted_mean_and_one_that_is_here_stays() -> None:
    body, seen, here = np.zeros((1, 22, 3)), np.ones((1, 22, 3)), np.zeros((1, 22), dtype=bool)
    here[0, ELBOW], seen[0, KNEE] = True, np.nan
    precision = Precision(np.full((1, 22), 300.0), np.full((1, 22), 100.0))
    precision.smoother[0, KNEE] = 0.0
    variance = _merge(body, seen, here, precision)
    assert body[0, [ELBOW, WRIST, KNEE], 0] == pytest.approx([1.0, 0.75, 0.0])
    assert variance[0, [WRIST, KNEE]] == pytest.approx([1 / 400, 1 / 100])


def test_of_a_hidden_joint_the_smaller_deviation_is_stated() -> None:
    deviation, derived = np.full((1, 22), 0.01), np.zeros((1, 22), dtype=bool)
    deviation[0, KNEE], derived[0, J["spine2"]] = np.inf, True
    precision = Precision(np.full((1, 22), 1 / 0.2**2), np.full((1, 22), 1 / 0.3**2))
    precision.prior[0, WRIST] = 1 / 0.1**2
    found = _output_sigma(unobserved(left_wrist=0.5, left_elbow=0.5, spine2=np.inf), deviation, precision, derived)[0]
    assert found[[SHOULDER, ELBOW, WRIST, KNEE]] == pytest.approx([0.01, 0.2, 0.1, 0.2])
    assert DERIVED_SIGMA < found[J["spine2"]] < 0.2, "an arm is hidden"
    seen = _output_sigma(unobserved(spine2=np.inf), np.full((1, 22), 0.01), precision, derived)[0]
    assert seen[J["spine2"]] == DERIVED_SIGMA
    hips = _output_sigma(
        unobserved(spine2=np.inf, pelvis=1.0, left_hip=1.0, right_hip=1.0), deviation, precision, derived
    )[0]
    assert hips[J["spine2"]] > 1.5 * found[J["spine2"]], "the hips are nearer"


def test_what_is_rigid_across_two_bones_varies_by_both() -> None:
    variance = np.arange(22.0)[None]
    for (end, start), found in zip(RIGID, _rigid_variance(variance)[0], strict=True):
        assert found == (end if PARENT[end] == start else end + start)


def test_a_part_of_which_nothing_was_ever_observed_is_less_certain_than_the_completion_says() -> None:
    never = np.zeros((2, 22), dtype=bool)
    for part in ("left_hip", "right_hip", "spine1", "spine2", "left_knee"):
        never[0, J[part]] = True
    never[1, J["left_hip"]] = True
    factors = _unobserved_part_factors(never)
    assert factors[0, J["left_hip"]] == factors[0, J["spine1"]] == 2.0
    assert factors[0, J["left_knee"]] == 1.0, "its ankle and foot were observed"
    assert (factors[1] == 1.0).all()
