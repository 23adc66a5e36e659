import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import norm

from steadypose.prior.world.compose import standing_velocity
from steadypose.prior.world.feet import StillFeet

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
    found, covariance = standing_velocity(velocity, _covariance(0.1), 1.0, stated=VELOCITY_ERROR)
    np.testing.assert_allclose(found, expected)
    variance = sways * SWAY**2 * error**2 / (SWAY**2 + error**2) + (1 - sways) * error**2
    between = sways * np.outer(slowed - expected, slowed - expected)
    between += (1 - sways) * np.outer(velocity - expected, velocity - expected)
    np.testing.assert_allclose(covariance[3:, 3:], variance * np.eye(3) + between)


def test_a_root_that_moves_over_resting_feet_or_walks_keeps_its_velocity():
    bends, slow = np.array([0.0, 0.2, -0.3]), np.array([0.03, 0.0, 0.0])
    np.testing.assert_allclose(standing_velocity(bends, _covariance(0.1), 1.0, stated=0.5)[0], bends, rtol=1e-6)
    velocity, covariance = standing_velocity(slow, _covariance(0.1), 0.0, stated=1.0)
    np.testing.assert_array_equal(velocity, slow)
    np.testing.assert_allclose(covariance, _covariance(0.1))


@given(
    speed=st.floats(0.0, 100.0), sigma=st.floats(1e-6, 10.0), both_rest=st.floats(0.0, 1.0), stated=st.floats(0.1, 1.0)
)
def test_no_velocity_grows_or_turns_and_its_covariance_is_one(
    speed: float, sigma: float, both_rest: float, stated: float
):
    direction = np.array([0.6, 0.0, 0.8])
    slowed, covariance = standing_velocity(speed * direction, _covariance(sigma), both_rest, stated=stated)
    assert 0.0 <= slowed @ direction <= speed + 1e-9
    np.testing.assert_allclose(slowed, (slowed @ direction) * direction, atol=1e-9)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0


def _covariance(sigma: float) -> NDArray[np.float64]:
    """(6, 6) of a position known to 2 cm and a velocity to ``sigma`` m/s, correlated."""
    return np.kron(np.array([[0.02**2, 0.3 * 0.02 * sigma], [0.3 * 0.02 * sigma, sigma**2]]), np.eye(3)).astype(float)
