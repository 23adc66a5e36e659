import numpy as np
import pytest
from numpy.typing import NDArray
from tests.helpers.bodies import waving

from steadypose.prior.body.inverse_kinematics import RIGID
from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS
from steadypose.prior.clean.bones import (
    MEMORY,
    MIN_FRAMES,
    UNKNOWN_VARIANCE,
    BiasEstimator,
    PersonEstimator,
    SensorBias,
)
from steadypose.prior.clean.frame import Person
from steadypose.prior.clean.sensor_error import DepthError
from steadypose.prior.clean.settings import PersonSettings
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

BONES = Person.generic(1)


def found(seen: np.ndarray, sigma: float, jitter: float, bias_sigma: float = 0.02) -> SensorBias:
    """After all frames (T, 22, 3) of one body."""
    estimator = BiasEstimator(bias_sigma, 1)
    error = estimator.update(None, BONES, np.array([jitter]))
    for frame in seen:
        error = estimator.update(Smoothed(0.0, frame[None], np.full((1, 22), sigma)), BONES, np.array([jitter]))
    return error


def test_a_perfect_sensor_has_none() -> None:
    error = found(waving(90), sigma=1e-4, jitter=1e-4)
    assert error.bias_sigma[0] < 0.001
    assert np.sqrt(error.length_variance[0]).max() < 0.002


@pytest.mark.parametrize("bias", [0.01, 0.02])
def test_an_error_that_lasts_is_found_from_bones(bias: float) -> None:
    seen = waving(240) + time_correlated(bias * np.random.default_rng(0).standard_normal((240, 22, 3)), 0.95)
    assert found(seen, sigma=0.002, jitter=0.004).bias_sigma[0] == pytest.approx(bias, rel=0.35)


def test_noise_that_the_smoother_states_is_none() -> None:
    rng, truth = np.random.default_rng(1), waving(240)
    assert found(truth + 0.02 * rng.standard_normal(truth.shape), sigma=0.02, jitter=0.0).bias_sigma[0] < 0.008


def test_before_anything_is_seen_it_is_what_was_expected_but_not_of_a_sensor_without_jitter() -> None:
    assert found(waving(1)[:0], 0.01, jitter=0.02).bias_sigma[0] == pytest.approx(0.02)
    nothing = np.full((1, 22, 3), np.nan)
    assert found(nothing, 0.01, jitter=0.02).bias_sigma[0] == pytest.approx(0.02)
    assert found(nothing, 0.01, jitter=0.0).bias_sigma[0] == 0.0
    assert (found(waving(MIN_FRAMES), 0.01, 0.02).length_variance == UNKNOWN_VARIANCE).all()


def test_a_rig_with_other_bones_is_not_at_fault() -> None:
    """Lengths that differ from the bones in use, but do not vary, are uncertain: nothing is moved for them."""
    error = found(1.1 * waving(120), sigma=1e-4, jitter=1e-4)
    rigid = np.linalg.norm(REST_POSITIONS[RIGID[:, 0]] - REST_POSITIONS[RIGID[:, 1]], axis=-1)
    np.testing.assert_allclose(np.sqrt(error.length_variance[0]), 0.1 * rigid, rtol=0.1, atol=1e-3)
    assert error.bias_sigma[0] < 0.001


def test_lengths_are_those_observed_as_soon_as_they_are_known() -> None:
    generic = np.linalg.norm(BONES.offsets[0], axis=-1)
    nothing = found(np.full((1, 22, 3), np.nan), sigma=0.01, jitter=0.0)
    np.testing.assert_allclose(nothing.lengths[0], generic)
    seen = found(1.1 * waving(60), sigma=1e-4, jitter=1e-4)
    np.testing.assert_allclose(seen.lengths[0], 1.1 * generic, rtol=0.01)
    rough = found(1.1 * waving(6), sigma=0.04, jitter=0.04).lengths[0]
    assert (rough[1:] > generic[1:]).all()
    assert (rough[1:] < 1.05 * generic[1:]).all()


def test_a_mean_length_is_as_uncertain_after_minutes_as_when_its_memory_is_full() -> None:
    soon, late = (found(1.1 * waving(n * MEMORY), sigma=0.04, jitter=0.04) for n in (1, 20))
    np.testing.assert_allclose(late.lengths, soon.lengths, rtol=1e-3)
    np.testing.assert_allclose(late.length_variance, soon.length_variance, rtol=0.02)


BIAS = 0.02


def lengths(offsets: np.ndarray) -> np.ndarray:
    return np.linalg.norm(offsets, axis=-1)


def test_the_stage_knows_bones_from_the_first_frame_and_then_moves_without_steps() -> None:
    stage, present = PersonEstimator(PersonSettings(), 2), np.array([True, False])
    told = []
    for frame in waving(120, 0.85) + np.random.default_rng(0).normal(size=(120, 22, 3)) * 0.02:
        both = np.stack([frame, np.full((22, 3), np.nan)])
        smoothed = Smoothed(0.0, both, np.where(np.isnan(both[..., 0]), np.inf, 0.02))
        told.append(lengths(stage.update(smoothed, np.full(2, BIAS), present).offsets[0]))
    assert np.abs(told[0] - 0.85 * lengths(REST_OFFSETS)).max() < 0.06
    assert np.abs(np.diff(told, axis=0)).max() < 0.005
    assert np.abs(lengths(stage.current.offsets[0]) - 0.85 * lengths(REST_OFFSETS)).max() < 0.03
    np.testing.assert_array_equal(stage.current.offsets[1], REST_OFFSETS)


def test_in_a_crowd_everybodys_bones_are_renewed_as_often_as_those_of_one_of_eight() -> None:
    """A bench puts clips side by side as bodies: they must not wait for one another."""

    def renewals(slots: int) -> np.ndarray:
        stage, present = PersonEstimator(PersonSettings(), slots), np.ones(slots, dtype=bool)
        for number, frame in enumerate(waving(120, 0.85)):
            smoothed = Smoothed(0.0, np.tile(frame, (slots, 1, 1)), np.full((slots, 22), 0.02))
            person = stage.update(smoothed, np.full(slots, BIAS), present)
            if number == 0:
                assert (lengths(person.offsets)[:, 1:] < 0.98 * lengths(REST_OFFSETS)[1:]).any(axis=1).all()
        return stage._used

    assert renewals(8).min() == renewals(64).min() > 12


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


def test_hidden_joints_count_for_nothing() -> None:
    seen = waving(FRAMES) + noise(DEPTH)
    whole = left_out(seen)
    seen[::2, 18:] = np.nan
    assert 0.5 * whole < left_out(seen) < 1.5 * whole
    assert DepthError(2).update(None, np.zeros(2)).tolist() == [0.0, 0.0]


def test_an_error_that_has_ended_is_forgotten_within_some_ten_seconds() -> None:
    seen, estimator = waving(FRAMES) + noise(DEPTH), DepthError(1)
    during = left_out(seen, estimator=estimator)
    after = left_out(waving(FRAMES), estimator=estimator)
    assert (after / during) ** 2 == pytest.approx(np.exp(-1.0), rel=0.25)
