from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from steadypose.prior.world.feet import Feet, Soles
from steadypose.prior.world.filter import RootState
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.observe import FEET, SOLE, BodyObservation

FLOOR, FOUR = np.zeros(4), np.ones(4)
DT = 1 / 30
SOLE_SIGMA, UNEVEN, AIR_M, OUTLIER = np.array([0.013, 0.006]), 0.006, 0.1, 0.05
RESTS = 0.99 * FOUR
SURE, UNSURE = 0.001**2 * FOUR, 0.02**2 * FOUR


def settle(above: float, variances: np.ndarray = UNSURE, rest: np.ndarray = RESTS, floor: np.ndarray = FLOOR):
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
            known * RESTS[k] * norm.pdf(above, 0, total), known * (1 - RESTS[k]) * norm.cdf(above / total) / air,
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
    np.testing.assert_array_equal(
        Soles().settle(SOLE - 0.03, UNSURE, FLOOR, 0.0, RESTS, 0.0 * FOUR, DT)[0], SOLE - 0.03
    )


@settings(max_examples=200)
@given(
    above=st.floats(-0.2, 0.2), sigma=st.floats(1e-3, 0.2), rest=st.floats(0.0, 1.0), floor_sigma=st.floats(0.0, 0.2),
)  # fmt: skip
def test_it_moves_feet_towards_the_floor_and_never_past_it(above: float, sigma: float, rest: float, floor_sigma: float):
    heights, variances, stands = Soles().settle(
        SOLE + above, sigma**2 * FOUR, FLOOR, floor_sigma, rest * FOUR, FOUR, DT
    )
    low, high = sorted((0.0, above))
    assert ((heights - SOLE > low - 1e-9) & (heights - SOLE < high + 1e-9)).all()
    assert ((variances > 0.0) & np.isfinite(variances)).all()
    assert ((stands >= 0.0) & (stands <= 1.0)).all()


def test_a_person_whose_feet_stand_higher_is_learned_and_then_left_alone():
    soles, above = Soles(), SOLE + np.array([0.03, 0.03, 0.01, 0.01])
    before = soles.settle(above, UNSURE, FLOOR, 0.0, RESTS, FOUR, DT)[0]
    for _ in range(30 * 60):
        stands = soles.settle(above, UNSURE, FLOOR, 0.0, RESTS, FOUR, DT)[2]
        soles.learn(above, 0.02 * FOUR, stands, DT)
    after = soles.settle(above, UNSURE, FLOOR, 0.0, RESTS, FOUR, DT)[0]
    assert (np.abs(after - above) < 0.3 * np.abs(before - above)).all()
    assert np.ptp(soles.heights.reshape(2, 2), axis=1).max() == 0.0


def test_a_foot_comes_to_the_floor_smoothly():
    soles, away = Soles(), np.full(4, np.nan)
    soles.settle(SOLE - 0.03, UNSURE, away, 0.0, RESTS, FOUR, DT)
    goal = settle(-0.03)[0]
    off = [np.abs(soles.settle(SOLE - 0.03, UNSURE, FLOOR, 0.0, RESTS, FOUR, DT)[0] - goal).max() for _ in range(10)]
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
        heights, left, _ = Soles().settle(SOLE - 0.02, variances, FLOOR, 0.01, RESTS, share * FOUR, DT)
        found = Feet().update(*frame(pelvis, sigma=seen), RESTS, Floor(calibrated=True))
        np.testing.assert_allclose(found.positions[:, 2], heights)
        np.testing.assert_allclose(found.sigma, np.sqrt((2 * 0.03**2 + np.minimum(0.01**2, left)) / 3))


@pytest.mark.parametrize("root_sigma", [0.01, np.inf])
def test_standing_heights_are_learned_of_feet_that_are_seen_in_the_world(root_sigma: float):
    feet, floor = Feet(), Floor(calibrated=True)
    found = [feet.update(*frame(above=0.02, root_sigma=root_sigma), RESTS, floor) for _ in range(30 * 20)][-1]
    lowered = np.abs(found.positions[:2, 2] - SOLE[:2] - 0.02)
    first = Feet().update(*frame(above=0.02), RESTS, floor).positions[:2, 2]
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
    moved = Feet().update(now, root, RESTS, floor).positions[:, 2] - now.feet[:, 2]
    assert (moved > 0.001).tolist() == [True, True, False, False]
    assert (moved[2:] == 0.0).all()
