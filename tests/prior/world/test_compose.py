from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from tests.helpers.bodies import clean_body

from steadypose.msgs.types import JointState, Tracking, WorldBody
from steadypose.prior.body.kinematics import forward_kinematics
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J
from steadypose.prior.models.contacts import Contacts
from steadypose.prior.world.compose import compose, fit_legs, standing_velocity, turn_legs
from steadypose.prior.world.core import BodyEstimate
from steadypose.prior.world.feet import Feet, FeetState, Soles, StillFeet
from steadypose.prior.world.filter import RootState
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.networks import Stance
from steadypose.prior.world.observe import FEET, SOLE, BodyObservation

LENGTHS = np.linalg.norm(REST_OFFSETS, axis=1)
LEGS = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee", "ankle", "foot")]


def pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Local rotations (22, 4) and positions (22, 3) of a body somewhere."""
    turns = Rotation.from_rotvec(0.4 * np.random.default_rng(seed).normal(size=(22, 3)))
    return turns.as_quat(), forward_kinematics(turns.as_matrix(), REST_OFFSETS, np.array([1.0, 2.0, 0.9]))[0]


def lengths(positions: np.ndarray) -> np.ndarray:
    return np.linalg.norm(positions - positions[list(PARENTS)], axis=1)


def test_the_answer_is_the_most_likely_one():
    """The gradient of the energy, sum of (x - x0)² / s² + (|bone| - length)² / s_l², is all but gone."""
    rng = np.random.default_rng(2)
    _, positions = pose(2)
    sigma = 0.02 * np.exp(0.3 * rng.normal(size=22))
    seen = positions + 0.01 * rng.normal(size=(22, 3))

    def energy(p: np.ndarray) -> float:
        bones = [j for j in LEGS if j not in (J["left_hip"], J["right_hip"])]
        lengths_off = (lengths(p) - LENGTHS)[bones] / 0.025
        return float((((p - seen) / sigma[:, None]) ** 2).sum() + (lengths_off**2).sum())

    fitted = fit_legs(seen, sigma, LENGTHS)
    moves = 0.0005 * rng.normal(size=(200, 22, 3)) * np.isin(range(22), LEGS)[:, None]
    least = min(energy(fitted + move) for move in moves)
    assert energy(fitted) < energy(seen)
    assert energy(fitted) < least + 0.01


def test_joints_and_lengths_that_are_not_known_are_left_out():
    _, positions = pose(3)
    positions[J["left_knee"]] = np.nan
    fitted = fit_legs(positions + 0.01, np.full(22, 0.02), np.zeros(22))
    np.testing.assert_array_equal(fitted, positions + 0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotations_go_with_the_legs(sign: float):
    """A quaternion and its negative are the same rotation."""
    rotations, positions = pose(4)
    rotations *= sign
    moved = positions.copy()
    for side in ("left", "right"):
        moved[J[f"{side}_knee"]] += [0.02, 0.01, 0.0]
        moved[J[f"{side}_ankle"]] += [0.03, -0.02, 0.01]
        moved[J[f"{side}_foot"]] += [0.03, 0.0, 0.0]
    turned = turn_legs(rotations, positions, moved)
    offsets = REST_OFFSETS * (lengths(moved) / np.maximum(LENGTHS, 1e-9))[:, None]
    placed = forward_kinematics(Rotation.from_quat(turned).as_matrix(), offsets, moved[0])[0]
    np.testing.assert_allclose(placed[LEGS], moved[LEGS], atol=1e-9)
    others = sorted(set(range(22)) - set(LEGS))
    np.testing.assert_array_equal(turned[others], rotations[others])


def test_rotations_that_are_none_are_left_alone():
    rotations, positions = pose(5)
    rotations[J["left_knee"]] = np.nan
    rotations[J["right_ankle"]] = 0.0
    np.testing.assert_array_equal(turn_legs(rotations, positions, positions + 0.01), rotations)


def composed(
    lost_sigma: float = 0.5, speed: float = 2.0, guessed: tuple[bool, ...] = (False,) * 6, **fields: Any
) -> tuple[WorldBody, BodyEstimate]:
    """A body that moves on resting feet as published, heels 5 cm from where they are seen, and no toes."""
    rotations, positions = pose(6)
    body = clean_body(positions, id=3, rotations=rotations, bone_lengths=np.zeros(22))
    observed = BodyObservation(
        body, 0, 1 / 30, positions.copy(), np.array([0.0, 0.0, 0.6, 0.8]), np.ones(22, dtype=bool),
        **({"sigma": np.full(22, 0.01), "root_sigma": 0.02, "pelvis_observed": True} | fields),
    )  # fmt: skip
    heels = np.full((4, 3), np.nan)
    heels[:2] = observed.feet[:2] + [0.05, 0.0, 0.0]
    covariance = np.diag([0.3, 0.4, 0.1, 0.02, 0.02, 0.02]) ** 2
    root = RootState(
        np.array([1.0, 2.0, 1.0]), np.array([speed, 0.0, 0.0]), covariance, heels, np.full((4, 3), 0.02),
        np.array([0.1, 0.2, 0.3]),
    )  # fmt: skip
    ramp = np.linspace(0, 1, 8, dtype=np.float32)
    contacts = Contacts(ramp, ramp[::-1], ramp[:1])
    rest = np.array([0.9, 0.0, 0.0, 0.8])
    feet = FeetState(heels, np.full(4, 0.03))
    estimate = BodyEstimate(observed, contacts, np.array(guessed), Stance(rest, rest), root, feet)
    return compose(estimate, lost_sigma), estimate


@pytest.mark.parametrize("root_sigma", [0.02, np.inf])
def test_joints_are_published_where_and_as_surely_as_root_and_feet_are_estimated(root_sigma: float) -> None:
    body, estimate = composed(root_sigma=root_sigma)
    spread = np.sqrt((0.3**2 + 0.4**2 + 0.1**2) / 3)
    places, sigma = (
        estimate.observed.positions + [0.1, 0.2, 0.3],
        np.full(22, 0.01 if root_sigma < 1.0 else np.hypot(0.01, spread)),
    )
    places[0], sigma[0] = [1.0, 2.0, 1.0], spread
    heels = [J["left_ankle"], J["right_ankle"]]
    places[heels], sigma[heels] = estimate.feet.positions[:2], 0.03
    np.testing.assert_allclose(body.positions, places, atol=1e-6)
    np.testing.assert_allclose(body.sigma, sigma, rtol=1e-6)
    np.testing.assert_allclose(body.rotations[0], [0.0, 0.0, 0.6, 0.8], atol=1e-6)
    np.testing.assert_allclose(body.contacts, np.linspace(0, 1, 8), atol=1e-6)
    assert (body.state == JointState.SEEN).all()


def test_of_a_guessed_leg_no_contact_is_published_and_its_foot_is_as_uncertain_as_it_was_said_to_be() -> None:
    said = np.full(22, 0.01)
    said[[J["left_ankle"], J["right_ankle"]]] = 0.14
    guessed = (False, False, True, False, True, False)
    body, estimate = composed(guessed=guessed, sigma=said)
    np.testing.assert_array_equal(np.isnan(body.contacts), [*guessed, False, False])
    np.testing.assert_allclose(body.contacts[[0, 1, 3, 5, 6, 7]], np.linspace(0, 1, 8)[[0, 1, 3, 5, 6, 7]], atol=1e-6)
    assert body.sigma[[J["left_ankle"], J["right_ankle"]]].tolist() == pytest.approx([0.14, 0.03])
    assert np.isfinite(estimate.contacts.load).all(), "the estimate itself is left alone"
    surer, _ = composed(guessed=guessed)
    assert surer.sigma[J["left_ankle"]] == pytest.approx(0.03)


@pytest.mark.parametrize(("lost_sigma", "lost"), [(0.51, False), (0.49, True)])
def test_a_body_is_lost_beyond_a_horizontal_deviation(lost_sigma: float, lost: bool) -> None:
    assert composed(lost_sigma)[0].tracking == (Tracking.LOST if lost else Tracking.OK)
    assert composed(lost_sigma, root_sigma=np.inf)[0].tracking == (Tracking.LOST if lost else Tracking.COASTING)


@pytest.mark.parametrize(("pelvis", "share"), [(True, 0.6), (False, 1.0)])
def test_a_velocity_is_surer_than_the_filter_states_where_the_pelvis_is_observed(pelvis: bool, share: float) -> None:
    body, _ = composed(pelvis_observed=pelvis)
    np.testing.assert_allclose(np.sqrt(np.diag(body.covariance)), [0.3, 0.4, 0.1, *[0.02 * share] * 3], rtol=1e-6)


def test_only_over_feet_that_are_seen_to_rest_a_slow_root_sways() -> None:
    speeds = [composed(speed=0.02, root_sigma=sigma)[0].root_velocity[0] for sigma in (0.02, np.inf)]
    assert speeds[0] < 0.018
    assert speeds[1] == pytest.approx(0.02)


DT = 1 / 30
DEADBAND, EASE_S = 0.5, 0.1
SWAY, MOVES, SWAYS, VELOCITY_ERROR = 0.015, 0.1, 0.5, 0.3
SIGMA = np.full(4, 0.01)
RESTS, SWINGS = np.ones(4), np.zeros(4)


def test_it_is_dragged_along_by_an_estimate_that_goes_on_moving():
    feet = StillFeet()
    estimates = np.zeros((30, 4, 3))
    estimates[..., 0] = 0.01 * np.arange(30)[:, None]
    published = [feet.update(places, SIGMA, RESTS, DT) for places in estimates]
    np.testing.assert_allclose(estimates[-1, :, 0] - published[-1][:, 0], DEADBAND * SIGMA, atol=1e-12)


def test_a_foot_that_has_lifted_comes_to_its_estimate_smoothly():
    feet = StillFeet()
    feet.update(np.zeros((4, 3)), SIGMA, RESTS, DT)
    place = np.array([[0.004, 0.0, 0.0]] * 4)
    feet.update(place, SIGMA, RESTS, DT)
    off = np.array([np.linalg.norm(feet.update(place, SIGMA, SWINGS, DT) - place, axis=1).max() for _ in range(30)])
    np.testing.assert_allclose(off, 0.004 * np.exp(-DT / EASE_S * np.arange(1, 31)), atol=1e-12)


def test_a_foot_of_no_known_place_has_none_and_stands_anew():
    feet, nowhere = StillFeet(), np.full((4, 3), np.nan)
    feet.update(np.zeros((4, 3)), SIGMA, RESTS, DT)
    assert np.isnan(feet.update(nowhere, SIGMA, RESTS, DT)).all()
    np.testing.assert_array_equal(feet.update(np.ones((4, 3)), SIGMA, RESTS, DT), np.ones((4, 3)))


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000))
def test_it_is_never_further_off_than_the_deadband(seed: int):
    rng, feet = np.random.default_rng(seed), StillFeet()
    for _ in range(20):
        places, sigma = rng.normal(0.0, 0.02, (4, 3)), rng.uniform(0.0, 0.02, 4)
        published = feet.update(places, sigma, rng.random(4), DT)
        assert (np.linalg.norm(published - places, axis=1) <= DEADBAND * sigma + 1e-12).all()


def test_the_velocity_of_a_root_that_sways_is_the_mean_of_the_mixture():
    velocity, error = np.array([0.03, -0.02, 0.01]), 0.1 * VELOCITY_ERROR
    seen = [norm.pdf(velocity, scale=np.hypot(sigma, error)).prod() for sigma in (SWAY, MOVES)]
    weights = np.array([SWAYS, 1 - SWAYS]) * seen
    sways = weights[0] / weights.sum()
    slowed = velocity * SWAY**2 / (SWAY**2 + error**2)
    expected = sways * slowed + (1 - sways) * velocity
    found, covariance = standing_velocity(velocity, _covariance(0.1), 1.0, scale=VELOCITY_ERROR)
    np.testing.assert_allclose(found, expected)
    variance = sways * SWAY**2 * error**2 / (SWAY**2 + error**2) + (1 - sways) * error**2
    between = sways * np.outer(slowed - expected, slowed - expected)
    between += (1 - sways) * np.outer(velocity - expected, velocity - expected)
    np.testing.assert_allclose(covariance[3:, 3:], variance * np.eye(3) + between)


def test_a_root_that_moves_over_resting_feet_or_walks_keeps_its_velocity():
    bends, slow = np.array([0.0, 0.2, -0.3]), np.array([0.03, 0.0, 0.0])
    np.testing.assert_allclose(standing_velocity(bends, _covariance(0.1), 1.0, scale=0.5)[0], bends, rtol=1e-6)
    velocity, covariance = standing_velocity(slow, _covariance(0.1), 0.0, scale=1.0)
    np.testing.assert_array_equal(velocity, slow)
    np.testing.assert_allclose(covariance, _covariance(0.1))


@given(speed=st.floats(0, 100), sigma=st.floats(1e-6, 10), both_rest=st.floats(0, 1), scale=st.floats(0.1, 1))
def test_no_velocity_grows_or_turns_nor_is_its_covariance_none(speed: float, sigma: float, both_rest: float, scale):
    direction = np.array([0.6, 0.0, 0.8])
    slowed, covariance = standing_velocity(speed * direction, _covariance(sigma), both_rest, scale=scale)
    assert 0.0 <= slowed @ direction <= speed + 1e-9
    np.testing.assert_allclose(slowed, (slowed @ direction) * direction, atol=1e-9)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def _covariance(sigma: float) -> NDArray[np.float64]:
    """(6, 6) of a position known to 2 cm and a velocity to ``sigma`` m/s, correlated."""
    return np.kron(np.array([[0.02**2, 0.3 * 0.02 * sigma], [0.3 * 0.02 * sigma, sigma**2]]), np.eye(3)).astype(float)


FLOOR, FOUR = np.zeros(4), np.ones(4)
SOLE_SIGMA, UNEVEN, AIR_M, OUTLIER = np.array([0.013, 0.006]), 0.006, 0.1, 0.05
STANDS = 0.99 * FOUR
SURE, UNSURE = 0.001**2 * FOUR, 0.02**2 * FOUR


def settle(above: float, variances: np.ndarray = UNSURE, rest: np.ndarray = STANDS, floor: np.ndarray = FLOOR):
    """Of feet so many metres above where they would stand."""
    return Soles().settle(SOLE + above, variances, floor, 0.0, rest, FOUR, DT)


@pytest.mark.parametrize("above", [-0.01, 0.01])
def test_the_standing_part_is_the_product_of_two_gaussians(above: float):
    """And what is anywhere above stands too if it is seen below."""
    grid = np.linspace(-0.2, 0.3, 20_001)
    heights, variances, stands = settle(above)
    for k in range(4):
        s = np.hypot(SOLE_SIGMA[k // 2], UNEVEN)
        seen, stand = norm.pdf(grid, SOLE[k] + above, 0.02), norm.pdf(grid, SOLE[k], s)
        total = np.hypot(0.02, s)
        both = seen * stand / (seen * stand).sum()
        mean, known = (both * grid).sum(), 1 - OUTLIER
        air = np.hypot(AIR_M, np.sqrt(2 * np.pi) * total)
        weights = np.array([
            known * STANDS[k] * norm.pdf(above, 0, total), known * (1 - STANDS[k]) * norm.cdf(above / total) / air,
            OUTLIER / air,
        ])  # fmt: skip
        weights /= weights.sum()
        free = SOLE[k] + above
        means = np.array([mean, mean if above < 0 else free, free])
        narrow = (both * (grid - mean) ** 2).sum()
        spreads = np.array([narrow, narrow if above < 0 else 0.02**2, 0.02**2])
        assert stands[k] == pytest.approx(weights[0])
        assert heights[k] == pytest.approx(weights @ means, abs=1e-6)
        assert variances[k] == pytest.approx(weights @ (spreads + means**2) - (weights @ means) ** 2, abs=1e-8)


def test_where_no_floor_is_known_nothing_is_said():
    heights, variances, stands = settle(-0.03, floor=np.full(4, np.nan))
    np.testing.assert_array_equal(heights, SOLE - 0.03)
    np.testing.assert_array_equal(variances, UNSURE)
    assert not stands.any()


def test_of_a_body_that_lies_nothing_is_said():
    heights, _, _ = Soles().settle(SOLE - 0.03, UNSURE, FLOOR, 0.0, STANDS, 0.0 * FOUR, DT)
    np.testing.assert_array_equal(heights, SOLE - 0.03)


@settings(max_examples=200)
@given(above=st.floats(-0.2, 0.2), sigma=st.floats(1e-3, 0.2), rest=st.floats(0, 1), floor_sigma=st.floats(0, 0.2))
def test_it_moves_feet_towards_the_floor_and_never_past_it(above: float, sigma: float, rest: float, floor_sigma: float):
    heights, left, stands = Soles().settle(SOLE + above, sigma**2 * FOUR, FLOOR, floor_sigma, rest * FOUR, FOUR, DT)
    low, high = sorted((0.0, above))
    assert ((heights - SOLE > low - 1e-9) & (heights - SOLE < high + 1e-9)).all()
    assert ((left > 0.0) & np.isfinite(left)).all()
    assert ((stands >= 0.0) & (stands <= 1.0)).all()


def test_a_person_whose_feet_stand_higher_is_learned_and_then_left_alone():
    soles, above = Soles(), SOLE + np.array([0.03, 0.03, 0.01, 0.01])
    before = soles.settle(above, UNSURE, FLOOR, 0.0, STANDS, FOUR, DT)[0]
    for _ in range(30 * 60):
        stands = soles.settle(above, UNSURE, FLOOR, 0.0, STANDS, FOUR, DT)[2]
        soles.learn(above, 0.02 * FOUR, stands, DT)
    after = soles.settle(above, UNSURE, FLOOR, 0.0, STANDS, FOUR, DT)[0]
    assert (np.abs(after - above) < 0.3 * np.abs(before - above)).all()
    assert np.ptp(soles.heights.reshape(2, 2), axis=1).max() == 0.0


def test_a_foot_comes_to_the_floor_smoothly():
    soles, away = Soles(), np.full(4, np.nan)
    soles.settle(SOLE - 0.03, UNSURE, away, 0.0, STANDS, FOUR, DT)
    goal = settle(-0.03)[0]
    off = [np.abs(soles.settle(SOLE - 0.03, UNSURE, FLOOR, 0.0, STANDS, FOUR, DT)[0] - goal).max() for _ in range(10)]
    np.testing.assert_allclose(off, np.abs(goal - SOLE + 0.03).max() * np.exp(-DT / 0.05 * np.arange(1, 11)))


def test_what_no_foot_tells_is_not_learned():
    soles = Soles()
    soles.learn(np.full(4, np.nan), 0.02 * FOUR, FOUR, DT)
    soles.learn(SOLE + 0.05, np.full(4, np.inf), FOUR, DT)
    soles.learn(SOLE + 0.05, 0.02 * FOUR, 0.0 * FOUR, DT)
    np.testing.assert_array_equal(soles.heights, SOLE)


def test_repeated_measurements_of_one_stance_count_like_one_in_a_second_and_a_half():
    for dt, repeats in ((DT, 45.0), (3.0, 1.0)):
        soles, stands = Soles(), 0.8
        soles.learn(SOLE + [0.02, np.nan, np.nan, 0.02], 0.02 * FOUR, stands * FOUR, dt)
        noise = (0.02**2 + UNEVEN**2) * repeats / stands
        learned = np.repeat(0.02 * SOLE_SIGMA**2 / (SOLE_SIGMA**2 + noise), 2)
        np.testing.assert_allclose(soles.heights, SOLE + learned)


def frame(
    pelvis: float = 0.9, at: np.ndarray = FLOOR, sigma: float = 0.02, above: float = -0.02, root_sigma: float = 0.01
) -> tuple[BodyObservation, RootState]:
    """A body whose feet are seen, and estimated, above where they stand, at (4,) metres along x."""
    positions = np.zeros((22, 3))
    positions[0, 2] = pelvis
    positions[list(FEET), 0], positions[list(FEET), 2] = at, SOLE + above
    now = BodyObservation(
        cast(Any, None), 0, DT, positions, np.array([0.0, 0.0, 0.0, 1.0]), np.ones(22, dtype=bool),
        np.full(22, sigma), root_sigma, True,
    )  # fmt: skip
    spread = np.tile([0.03, 0.03, 0.01], (4, 1))
    return now, RootState(positions[0], np.zeros(3), np.eye(6), now.feet, spread, np.zeros(3))


@pytest.mark.parametrize(("pelvis", "share"), [(0.2, 0.0), (0.35, 0.5), (0.45, 1.0), (0.9, 1.0)])
def test_the_floor_tells_less_of_the_feet_the_lower_the_pelvis(pelvis: float, share: float):
    for seen in (0.02, np.inf):
        variances = (0.01**2 + (seen if seen < 1.0 else 0.0) ** 2) * FOUR
        heights, left, _ = Soles().settle(SOLE - 0.02, variances, FLOOR, 0.01, STANDS, share * FOUR, DT)
        found = Feet().update(*frame(pelvis, sigma=seen), STANDS, Floor(calibrated=True))
        np.testing.assert_allclose(found.positions[:, 2], heights)
        np.testing.assert_allclose(found.sigma, np.sqrt((2 * 0.03**2 + np.minimum(0.01**2, left)) / 3))


@pytest.mark.parametrize("root_sigma", [0.01, np.inf])
def test_standing_heights_are_learned_of_feet_that_are_seen_in_the_world(root_sigma: float):
    feet, floor = Feet(), Floor(calibrated=True)
    found = [feet.update(*frame(above=0.02, root_sigma=root_sigma), STANDS, floor) for _ in range(30 * 20)][-1]
    lowered = np.abs(found.positions[:2, 2] - SOLE[:2] - 0.02)
    first = Feet().update(*frame(above=0.02), STANDS, floor).positions[:2, 2]
    if root_sigma < 1.0:
        assert (lowered < 0.7 * np.abs(first - SOLE[:2] - 0.02)).all()
    else:
        np.testing.assert_allclose(lowered, np.abs(first - SOLE[:2] - 0.02))


def test_a_foot_stands_on_the_ground_straight_under_it():
    floor = Floor(calibrated=True)
    for _ in range(30):
        floor.observe(np.array([0.0, 0.0, 0.3]), 0.02, DT)
    at = np.array([-0.39, 0.39, -0.41, 0.41])  # a step ends 40 cm from where feet have stood
    now, root = frame(1.2, at, above=0.28)
    moved = Feet().update(now, root, STANDS, floor).positions[:, 2] - now.feet[:, 2]
    assert (moved > 0.001).tolist() == [True, True, False, False]
    assert (moved[2:] == 0.0).all()
