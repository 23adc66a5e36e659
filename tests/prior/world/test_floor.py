"""The floor found from standing feet."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from steadypose.prior.world.floor import CALIBRATED_SIGMA, CREEP, FORGOTTEN_S, GUESS_SIGMA, PATIENCE_S, Floor

DT = 1 / 30


HERE, ELSEWHERE = (0.0, 0.0), (5.0, 0.0)


def stand(floor: Floor, height: float, seconds: float, at: tuple[float, float] = HERE) -> None:
    rng = np.random.default_rng(0)
    for _ in range(round(seconds / DT)):
        floor.observe(np.array([*at, height + 0.01 * rng.normal()]), 0.02, DT)


def test_uncalibrated_floor_is_unknown_then_found():
    floor = Floor(calibrated=False)
    assert not floor.known
    floor.guess(-1.3)
    assert floor.sigma == pytest.approx(GUESS_SIGMA)
    stand(floor, -1.2, seconds=10)
    assert floor.height == pytest.approx(-1.2, abs=0.01)
    assert floor.sigma < 0.01
    np.testing.assert_allclose(floor.plane, [0, 0, 1, -floor.height])


@pytest.mark.parametrize("seen", [True, False])
def test_it_is_guessed_from_feet_that_are_seen(seen: bool):
    floor, soles = Floor(calibrated=False), np.array([[0.0, 0.0, height] for height in (-1.1, -1.2, -1.2, -1.15)])
    observed: Any = SimpleNamespace(feet_observed=np.full(4, seen), soles=soles, root_observed=False)
    floor.update(observed, np.ones(4))
    assert floor.known == seen
    assert floor.height == (-1.2 if seen else 0.0)


def test_once_sure_it_is_slow():
    floor = Floor(calibrated=False)
    stand(floor, 0.0, seconds=20)
    before = floor.height
    stand(floor, 0.04, seconds=1)
    assert 0 < floor.height - before < 0.01


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_floor_that_nobody_touches_is_given_up_unless_calibrated(calibrated: bool):
    floor = Floor(calibrated)
    stand(floor, 0.0, seconds=10)
    stand(floor, 0.3, seconds=PATIENCE_S + 10)
    assert floor.height == pytest.approx(0.0 if calibrated else 0.3, abs=0.02)


def test_feet_under_the_floor_are_believed_in_time_but_not_at_once():
    floor = Floor(calibrated=False)
    stand(floor, 0.0, seconds=20)
    floor.observe(np.array([*HERE, -0.2]), 0.02, DT)
    assert abs(floor.height) < 0.03
    stand(floor, -0.2, seconds=4)
    assert floor.height == pytest.approx(-0.2, abs=0.02)


def test_a_step_is_a_level_where_it_was_stood_on():
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds=2)
    assert floor.height == pytest.approx(0.0, abs=0.001)
    assert floor.under(np.array([*HERE, 0.32])) == pytest.approx(0.3, abs=0.02)
    assert np.isnan(floor.under(np.array([*ELSEWHERE, 0.32])))
    assert floor.under(np.array([*HERE, 0.03])) == pytest.approx(0.0, abs=0.001)


def test_a_moment_in_the_air_is_no_level():
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds=0.2)
    assert np.isnan(floor.under(np.array([*HERE, 0.3])))


def test_nothing_is_under_a_foot_high_up_and_the_floor_is_under_one_too_low():
    floor = Floor(calibrated=True)
    assert np.isnan(floor.under(np.array([*HERE, 0.5])))
    assert floor.under(np.array([*HERE, -0.1])) == 0.0
    assert np.isnan(Floor(calibrated=False).under(np.zeros(3)))


def test_a_level_that_nobody_stands_on_is_forgotten():
    floor = Floor(calibrated=True)
    stand(floor, 0.3, seconds=2)
    stand(floor, 0.0, seconds=FORGOTTEN_S + 1, at=ELSEWHERE)
    assert floor.levels == []


def test_when_the_floor_moves_up_the_levels_above_it_stay():
    floor = Floor(calibrated=False)
    stand(floor, 0.0, seconds=10)
    stand(floor, 0.6, seconds=1)
    stand(floor, 0.3, seconds=PATIENCE_S + 1, at=ELSEWHERE)
    assert floor.height == pytest.approx(0.3, abs=0.02)
    assert floor.levels == pytest.approx([0.6], abs=0.02)


def test_a_floor_that_nothing_tells_of_grows_uncertain_by_its_creep():
    floor = Floor(calibrated=True)
    floor.observe(np.array([*HERE, 0.0]), 1e6, 100.0)
    assert floor.sigma**2 == pytest.approx(CALIBRATED_SIGMA**2 + CREEP**2 * 100.0)
