import numpy as np
import pytest
from numpy.typing import NDArray
from tests.helpers.bodies import waving

from steadypose.prior.clean.sensor_error import DepthError
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

FRAMES, SIGMA, DEPTH = 300, 0.01, 0.04
KEPT = np.exp(-1 / (0.5 * FPS))
TURNED = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]


def noise(depth: float) -> NDArray[np.float64]:
    """Time-correlated, larger along x."""
    rng = np.random.default_rng(0)
    return time_correlated(rng.standard_normal((FRAMES, 22, 3)), KEPT) * (depth, SIGMA, SIGMA)


def left_out(positions: NDArray[np.float64], white: float = 0.0, estimator: DepthError | None = None) -> float:
    """At the end of the frames (T, 22, 3)."""
    estimator, found = estimator or DepthError(1), np.full(1, np.nan)
    for t, frame in enumerate(positions[:, None]):
        found = estimator.update(Smoothed(t / FPS, frame, np.full((1, 22), SIGMA)), np.array([white]))
    return float(found[0])


@pytest.mark.parametrize("turn", [np.eye(3), TURNED])
def test_errors_along_any_one_direction_are_left_out(turn: NDArray[np.float64]) -> None:
    truth = waving(FRAMES)
    error = np.sqrt((DEPTH**2 + 2 * SIGMA**2) / 3)
    assert 0.8 * error < np.hypot(left_out((truth + noise(DEPTH)) @ turn.T), SIGMA) < 1.4 * error


def test_nothing_is_left_out_of_errors_alike_in_all_directions_or_of_none() -> None:
    truth = waving(FRAMES)
    assert left_out(truth) < 1e-3
    assert left_out(truth + noise(SIGMA)) < 0.7 * SIGMA


def test_nothing_is_left_out_of_white_noise() -> None:
    seen = waving(FRAMES) + noise(DEPTH)
    assert left_out(seen, white=1.0) == 0.0
    assert left_out(seen, white=0.75) == pytest.approx(0.5 * left_out(seen))


def test_hidden_joints_and_a_forgotten_body_count_for_nothing() -> None:
    seen, estimator = waving(FRAMES) + noise(DEPTH), DepthError(1)
    whole = left_out(seen, estimator=estimator)
    seen[::2, 18:] = np.nan
    assert 0.5 * whole < left_out(seen) < 1.5 * whole
    estimator.forget(np.array([True]))
    assert left_out(seen[:1], estimator=estimator) == 0.0
    assert DepthError(2).update(None, np.zeros(2)).tolist() == [0.0, 0.0]


def test_an_error_that_has_ended_is_forgotten_within_some_ten_seconds() -> None:
    seen, estimator = waving(FRAMES) + noise(DEPTH), DepthError(1)
    during = left_out(seen, estimator=estimator)
    after = left_out(waving(FRAMES), estimator=estimator)
    assert (after / during) ** 2 == pytest.approx(np.exp(-1.0), rel=0.25)
