from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from steadypose.prior.world.floor import Floor

DT = 1 / 30


HERE, ELSEWHERE = (0.0, 0.0), (5.0, 0.0)


def stand(floor: Floor, height: float, seconds: float, at: tuple[float, float] = HERE) -> None:
    rng = np.random.default_rng(0)
    for _ in range(round(seconds / DT)):
        floor.observe(np.array([*at, height + 0.01 * rng.normal()]), 0.02, DT)


def test_uncalibrated_floor_is_unknown_then_found():
    floor = Floor(calibrated=False)
    assert not floor.known
    floor.initialise(-1.3)
    assert floor.sigma == pytest.approx(0.15)
    floor.initialise(-1.0)
    assert floor.height == -1.3, "only the first is needed"
    stand(floor, -1.2, seconds=10)
    assert floor.height == pytest.approx(-1.2, abs=0.01)
    assert floor.sigma < 0.01
    np.testing.assert_allclose(floor.plane, [0, 0, 1, -floor.height])


@pytest.mark.parametrize("seen", [True, False])
def test_it_is_guessed_from_feet_that_are_seen(seen: bool):
    floor, soles = Floor(calibrated=False), np.array([[0.0, 0.0, height] for height in (-1.1, -1.2, -1.2, -1.15)])
    observed: Any = SimpleNamespace(feet_observed=np.full(4, seen), soles=soles, root_observed=False)
    floor.update(observed, np.ones(4), np.zeros(4, dtype=bool))
    assert floor.known == seen
    assert floor.height == (-1.2 if seen else 0.0)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_floor_that_nobody_touches_is_given_up_unless_calibrated(calibrated: bool):
    floor = Floor(calibrated)
    stand(floor, 0.0, seconds=10)
    stand(floor, 0.3, seconds=4.9)
    assert floor.height == pytest.approx(0.0, abs=0.02)
    stand(floor, 0.3, seconds=10)
    assert floor.height == pytest.approx(0.0 if calibrated else 0.3, abs=0.02)


def test_a_step_is_a_level_where_it_was_stood_on():
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds=2)
    assert floor.height == pytest.approx(0.0, abs=0.001)
    assert floor.under(np.array([*HERE, 0.32])) == pytest.approx(0.3, abs=0.02)
    assert np.isnan(floor.under(np.array([*ELSEWHERE, 0.32])))
    assert floor.under(np.array([*HERE, 0.03])) == pytest.approx(0.0, abs=0.001)


@pytest.mark.parametrize(("seconds", "known"), [(0.27, False), (0.34, True)])
def test_a_moment_in_the_air_is_no_level(seconds: float, known: bool):
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds)
    assert np.isfinite(floor.under(np.array([*HERE, 0.3]))) == known


@pytest.mark.parametrize("way", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_a_level_ends_forty_centimetres_from_where_feet_have_stood(way: tuple[float, float]):
    floor = Floor(calibrated=True)
    for at in (HERE, (0.2, 0.2)):
        stand(floor, 0.3, seconds=1, at=at)
    edge = 0.4 + 0.2 * max(sum(way), 0.0)
    for far, known in ((edge - 0.01, True), (edge + 0.01, False)):
        assert np.isfinite(floor.under(np.array([*(far * np.array(way)), 0.3]))) == known


@pytest.mark.parametrize(("apart", "levels"), [(0.04, 1), (0.06, 2)])
def test_levels_less_than_five_centimetres_apart_are_one(apart: float, levels: int):
    floor = Floor(calibrated=True)
    for height in (0.3, 0.3 + apart):
        for _ in range(30):
            floor.observe(np.array([*HERE, height]), 0.02, DT)
    assert len(floor.levels) == levels


def test_nothing_is_under_a_foot_high_up_and_the_floor_is_under_one_too_low():
    floor = Floor(calibrated=True)
    assert np.isnan(floor.under(np.array([*HERE, 0.11])))
    assert floor.under(np.array([*HERE, 0.09])) == 0.0
    assert floor.under(np.array([*HERE, -0.1])) == 0.0
    assert np.isnan(Floor(calibrated=False).under(np.zeros(3)))


def test_a_level_that_nobody_stands_on_is_forgotten():
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds=2)
    stand(floor, 0.0, seconds=59, at=ELSEWHERE)
    assert len(floor.levels) == 1
    stand(floor, 0.0, seconds=2, at=ELSEWHERE)
    assert floor.levels == []


def test_when_the_floor_moves_up_the_levels_above_it_stay():
    floor = Floor(calibrated=False)
    stand(floor, 0.0, seconds=10)
    stand(floor, 0.6, seconds=1)
    stand(floor, 0.3, seconds=6, at=ELSEWHERE)
    assert floor.height == pytest.approx(0.3, abs=0.02)
    assert floor.levels == pytest.approx([0.6], abs=0.02)


def observed(floor: Floor, height: float, sigma: float, dt: float) -> tuple[float, float]:
    """Height and variance after a foot has stood at a height."""
    floor.observe(np.array([*HERE, height]), sigma, dt)
    return floor.height, floor.sigma**2


@pytest.mark.parametrize("dt", [DT, 0.3, 1.0])
def test_it_is_a_kalman_filter_whose_measurements_are_repeated_for_half_a_second(dt: float):
    first = Floor(calibrated=False)
    assert observed(first, 0.1, 0.02, dt) == pytest.approx((0.1, 0.02**2))
    variance = 0.01**2 + 0.001**2 * dt
    gain = variance / (variance + 0.02**2 * max(0.5 / dt, 1.0))
    expected = (gain * 0.03, (1 - gain) * variance)
    assert observed(Floor(calibrated=True), 0.03, 0.02, dt) == pytest.approx(expected)
    assert observed(Floor(calibrated=True), -0.03, 0.02, dt) == pytest.approx((-expected[0], expected[1]))


def test_a_foot_three_standard_deviations_up_stands_on_something_else_and_one_so_low_corrects_the_floor():
    total = np.hypot(0.01, 0.02)
    assert observed(Floor(calibrated=True), 2.9 * total, 0.02, DT)[0] > 0.0
    assert observed(Floor(calibrated=True), 3.1 * total, 0.02, DT)[0] == 0.0
    height, variance = observed(Floor(calibrated=True), -3.1 * total, 0.02, 1.0)
    assert (height, variance) == pytest.approx((-3.1 * total / 2, 0.02**2 / 2)), "as unsure as what corrects it"


def test_a_level_is_the_mean_of_what_feet_measure_of_it():
    floor = Floor(calibrated=True)
    for height in (0.3, 0.32):
        floor.observe(np.array([*HERE, height]), 0.02, 1.0)
    first = 0.02**2 + 0.001**2
    second = first * 0.02**2 / (first + 0.02**2) + 0.001**2
    assert floor.levels == pytest.approx([0.3 + 0.02 * second / (second + 0.02**2)])


def test_only_feet_that_rest_under_an_upright_body_with_an_observed_root_measure_the_floor():
    def moved(rest: float = 0.51, pelvis: float = 0.46, root: bool = True, sigma: float = 0.01) -> float:
        floor = Floor(calibrated=True)
        now: Any = SimpleNamespace(
            soles=np.tile([0.0, 0.0, 0.01], (4, 1)), feet_sigma=np.full(4, sigma), feet_observed=np.ones(4, bool),
            positions=np.array([[0.0, 0.0, pelvis + 0.01]]), root_observed=root, dt=1.0,
        )  # fmt: skip
        floor.update(now, np.array([rest, 0.0, 0.0, 0.0]), np.zeros(4, dtype=bool))
        return floor.height

    variance = 0.01**2 + 0.001**2
    assert moved() == pytest.approx(0.01 * variance / (variance + 0.01**2 + 0.02**2))
    assert moved(rest=0.49) == moved(pelvis=0.44) == moved(root=False) == moved(sigma=np.inf) == 0.0


@pytest.mark.parametrize(("calibrated", "guessed"), [(True, True), (True, False), (False, True)])
def test_feet_that_are_guessed_start_a_floor_and_never_move_one(calibrated: bool, guessed: bool) -> None:
    """They are guessed 20 cm too low, then 40."""
    floor = Floor(calibrated)
    for height in (-0.2, -0.4):
        observed: Any = SimpleNamespace(
            feet_observed=np.full(4, not guessed), root_observed=True, positions=np.array([[0.0, 0.0, 0.8]]), dt=DT,
            soles=np.array([[0.1 * k, 0.0, height] for k in range(4)]), feet_sigma=np.full(4, 0.02),
        )  # fmt: skip
        for _ in range(60):
            floor.update(observed, np.ones(4), np.full(4, guessed))
    expected = (0.0 if calibrated else -0.2) if guessed else -0.4
    assert floor.height == pytest.approx(expected, abs=0.01)
