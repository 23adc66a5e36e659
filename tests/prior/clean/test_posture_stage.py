import warnings

import numpy as np
import pytest
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import clean_bodies, estimate

from steadypose.msgs.types import JointState
from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS, J
from steadypose.prior.clean.posture import AT_MOST, LITTLE, NARROW, SHARE, WIDE, Posture, mix
from steadypose.prior.clean.settings import PostureSettings
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.sim.noise import time_correlated

FRAMES, SETTLED = 120, 40
LENGTHS, NOISE = np.linalg.norm(REST_OFFSETS, axis=-1)[None], np.array([0.02])
CERTAIN = np.ones(1)


def _positions(seen: np.ndarray, enabled: bool = True) -> np.ndarray:
    return np.array([body.positions for body in clean_bodies(seen, posture={"enabled": enabled})])


def test_an_error_that_lasts_gets_smaller() -> None:
    truth = waving(FRAMES)
    seen = truth + time_correlated(np.random.default_rng(0).normal(0.0, 0.02, truth.shape), 0.95)
    on, off = (np.linalg.norm(_positions(seen, on) - truth, axis=-1)[SETTLED:].mean() for on in (True, False))
    assert on < 0.9 * off


def test_a_perfect_input_stays() -> None:
    truth = waving(FRAMES)
    np.testing.assert_allclose(_positions(truth)[SETTLED:], truth[SETTLED:], atol=1e-5)


def test_joints_move_a_share_of_the_way_and_in_white_noise_those_observed_are_then_surer() -> None:
    before = estimate(REST_POSITIONS + np.random.default_rng(1).normal(0.0, 0.02, (1, 22, 3)), 0.02)
    before.state[0, J["left_wrist"]] = JointState.IMPUTED
    for correlated, spread in ((0.0, WIDE), (0.5, 4.0), (1.0, NARROW)):
        after = Posture(PostureSettings()).update(before, LENGTHS, NOISE, np.array([correlated]))
        whole = LivePosture.load("default")(before.positions, before.sigma, LENGTHS, spread).positions
        moved = SHARE * (whole - before.positions)
        np.testing.assert_allclose(after.positions - before.positions, moved, rtol=0.03, atol=1e-4)
    assert np.linalg.norm(after.positions - REST_POSITIONS, axis=-1).mean() < 0.033
    np.testing.assert_array_equal(after.sigma, before.sigma, "joints whose errors last share them")
    surer = Posture(PostureSettings()).update(before, LENGTHS, NOISE, np.zeros(1)).sigma < before.sigma
    assert not surer[0, J["left_wrist"]]
    assert surer.sum() == 21


def test_in_little_white_noise_joints_hardly_move_however_unsure_the_smoother_is() -> None:
    before = estimate(REST_POSITIONS + np.random.default_rng(2).normal(0.0, 0.02, (1, 22, 3)), 0.03)
    little = np.array([0.2 * LITTLE / AT_MOST])
    for correlated, low, high in ((0.0, 0.0, 0.001), (1.0, 0.005, 0.1)):
        after = Posture(PostureSettings()).update(before, LENGTHS, little, np.array([correlated]))
        assert low < np.linalg.norm(after.positions - before.positions, axis=-1).max() < high


def test_a_slot_without_a_body_stays_empty() -> None:
    body, both = (estimate(np.tile(REST_POSITIONS + 0.01, (count, 1, 1)), 0.02) for count in (1, 2))
    both.positions[1], both.sigma[1] = np.nan, np.inf
    after = Posture(PostureSettings()).update(both, np.concatenate([LENGTHS, LENGTHS]), np.full(2, 0.02), np.ones(2))
    assert np.isnan(after.positions[1]).all()
    assert np.isinf(after.sigma[1]).all()
    alone = Posture(PostureSettings()).update(body, LENGTHS, NOISE, CERTAIN)
    np.testing.assert_array_equal(after.positions[0], alone.positions[0])


def test_a_joint_between_two_observations_is_as_sure_as_its_own_filters() -> None:
    truth, hidden = waving(FRAMES), np.zeros((FRAMES, 22), dtype=bool)
    hidden[60:66, J["left_wrist"]] = True
    seen = np.where(hidden[..., None], np.nan, noisy(FRAMES, 0.01))
    bodies, wrist = clean_bodies(seen), J["left_wrist"]
    off = np.mean([np.square(bodies[t].positions[wrist] - truth[t, wrist]).mean() ** 0.5 for t in range(62, 66)])
    stated = np.mean([bodies[t].sigma[wrist] for t in range(62, 66)])
    assert stated < 0.012
    assert off < 1.3 * stated


def test_it_is_no_surer_than_the_observed_joints_whose_errors_last() -> None:
    truth, wrist = waving(FRAMES), J["left_wrist"]
    seen = truth + time_correlated(np.random.default_rng(0).normal(0.0, 0.02, truth.shape), 0.97)
    seen[60::12, wrist] = np.nan
    bodies = clean_bodies(seen)
    hidden, observed = (np.mean([bodies[t].sigma[wrist] for t in range(at, FRAMES - 4, 12)]) for at in (60, 66))
    assert hidden > 0.9 * observed > 0.01


def test_a_frame_in_which_nothing_is_observed_warns_of_nothing() -> None:
    seen, wrist = noisy(FRAMES, 0.01), J["left_wrist"]
    seen[60:64, wrist], seen[62] = np.nan, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bodies = clean_bodies(seen)
    assert 0.0 < bodies[62].sigma[wrist] < 0.1


RNG = np.random.default_rng(4)
SPINES, COLLARS = [J["spine1"], J["spine2"]], [J["left_collar"], J["right_collar"]]


def test_joints_that_a_kinect_lacks_are_means_of_its_own_in_the_body_that_lacks_them_alone() -> None:
    given, unobserved_s = estimate(RNG.normal(size=(2, 22, 3))), np.zeros((2, 22))
    unobserved_s[1, SPINES + COLLARS] = np.inf
    mixed = mix(given, unobserved_s)
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
    given, unobserved_s = estimate(RNG.normal(size=(1, 22, 3))), np.zeros((1, 22))
    unobserved_s[0, [*SPINES, *COLLARS, J["spine3"]]] = np.inf
    mixed = mix(given, unobserved_s)
    np.testing.assert_array_equal(mixed.positions[0, SPINES], given.positions[0, SPINES])
    assert (mixed.positions[0, COLLARS] != given.positions[0, COLLARS]).all()


def test_a_joint_that_is_hidden_for_a_while_is_no_mixture() -> None:
    given, unobserved_s = estimate(RNG.normal(size=(1, 22, 3))), np.zeros((1, 22))
    unobserved_s[0, SPINES + COLLARS] = 3.0
    assert mix(given, unobserved_s) is given
