import numpy as np
import pytest
from numpy.typing import NDArray
from tests.helpers.bodies import waving

from steadypose.prior.models.mixture.whiteness import LARGE, LARGE_NEWEST, Whiteness, fallback
from steadypose.prior.sim.noise import time_correlated

FRAMES, SIGMA = 90, 0.01


def lasting(shape: tuple[int, ...], seconds: float) -> NDArray[np.float64]:
    kept = np.exp(-1 / (30 * seconds)) if seconds else 0.0
    return SIGMA * time_correlated(np.random.default_rng(0).standard_normal(shape), kept)


def white_share(positions: NDArray[np.float64], delay: int = 4) -> float:
    whiteness = Whiteness(1, delay)
    return float([whiteness.share(frame[None]) for frame in positions][-1][0])


@pytest.mark.parametrize(("seconds", "least", "most"), [(0.0, 0.75, 1.0), (0.5, 0.0, 0.06), (2.0, 0.0, 0.015)])
def test_noise_that_lasts_is_told_from_noise_that_does_not(seconds: float, least: float, most: float) -> None:
    truth = waving(FRAMES)
    assert least <= white_share(truth + lasting(truth.shape, seconds)) <= most


def test_a_body_whose_bones_vary_by_themselves_is_one_of_white_noise_still() -> None:
    """Between markers on skin bones are not rigid; a sensor that errs by as much is another matter."""
    time = np.arange(FRAMES)[:, None, None] / 30
    by_itself = 1 + np.sin(2 * np.pi * 0.4 * time + np.arange(22)[None, :, None]) * (1.0, 0.3, -0.5)
    noise = 0.2 * lasting((FRAMES, 22, 3), 0.0)
    skin, sensor = (white_share(waving(FRAMES) + size * by_itself + noise) for size in (0.002, 0.02))
    assert skin == 1.0
    assert sensor < 0.06


def test_what_a_sensor_smooths_itself_is_not_white() -> None:
    white = lasting((FRAMES, 22, 3), 0.0)
    smoothed = white.copy()
    smoothed[1:] = (white[1:] + white[:-1]) / 2
    assert white_share(waving(FRAMES) + smoothed) < 0.015


def test_white_noise_is_known_within_a_third_of_a_second() -> None:
    truth = waving(10)
    assert white_share(truth + lasting(truth.shape, 0.0)) > 0.4
    assert white_share(truth + lasting(truth.shape, 0.0), delay=0) < 0.24  # where the network is far better
    assert white_share(truth + lasting(truth.shape, 0.5)) < 0.06


def test_that_noise_lasts_is_not_certain_at_first() -> None:
    truth = waving(FRAMES)
    for seconds, high in ((0.0, 0.1), (0.5, 1.0)):
        whiteness, certain = Whiteness(1, 4), []
        for frame in truth + lasting(truth.shape, seconds):
            whiteness.share(frame[None])
            certain.append(whiteness.correlated[0])
        assert certain[0] < 0.1
        assert high - 0.25 < certain[-1] <= high


def test_motion_without_noise_is_not_white() -> None:
    assert white_share(waving(FRAMES)) == 0.0


def test_missing_joints_and_a_forgotten_body_count_for_nothing() -> None:
    seen = waving(FRAMES) + lasting((FRAMES, 22, 3), 0.0)
    seen[::3, 5:12] = np.nan
    assert 0.54 < white_share(seen) <= 1.0
    whiteness = Whiteness(2, 4)
    for frame in seen:
        whiteness.share(np.stack([frame, frame]))
    whiteness.forget(np.array([True, False]))
    new = Whiteness(1, 4)
    for frame in waving(FRAMES) + lasting((FRAMES, 22, 3), 0.1):
        assert whiteness.share(np.stack([frame, frame]))[0] == new.share(frame[None])[0]


def test_the_estimate_by_likelihood_has_all_of_little_noise_and_half_of_much() -> None:
    scale = np.array([1e-4, LARGE, 100 * LARGE, LARGE])
    np.testing.assert_allclose(fallback(np.array([1.0, 1.0, 1.0, 0.3]), scale, 4), [1.0, 0.75, 0.5, 0.3], atol=1e-3)
    assert fallback(np.ones(1), np.array([LARGE_NEWEST]), 0) == 0.75
