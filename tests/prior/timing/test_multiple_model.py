"""The bank weighed by its predictions: the sensor's noise is not told, and between two sightings it interpolates."""

import numpy as np
import pytest
from numpy.typing import NDArray

from steadypose.prior.timing.fixed_lag import FixedLagRTS, Smoothed
from steadypose.prior.timing.multiple_model import MEMORY, MultipleModelSmoother

Floats = NDArray[np.float64]
DELAY, FRAMES = 4, 60
DENSITIES, MEASUREMENT_SIGMA = np.array([0.01, 0.2, 4.0, 60.0, 400.0]), 0.02


def _swinging(noise: float, seed: int = 0) -> tuple[Floats, Floats]:
    """Truth and what is seen of it, (T, 2, 3, 3) metres: one body swings, the other stands."""
    t = np.arange(FRAMES) / 30
    truth = np.zeros((FRAMES, 2, 3, 3))
    truth[:, 0] = 0.4 * np.sin(2 * np.pi * np.stack([0.7 * t, 1.1 * t, 0.4 * t], -1))[:, None]
    return truth, truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)


def _run(seen: Floats, delay: int = DELAY) -> list[Smoothed]:
    smoother = MultipleModelSmoother(delay, *seen.shape[1:3], DENSITIES, MEASUREMENT_SIGMA)
    confidence = np.ones(seen.shape[1:3])
    answers = [smoother.update(frame, t / 30, confidence) for t, frame in enumerate(seen)]
    return [answer for answer in answers if answer is not None] + smoother.flush()


def test_weights_are_the_likelihood_of_the_innovations_at_the_noise_that_they_show() -> None:
    seen = _swinging(0.01)[1][:, :1, :1]
    filters = [FixedLagRTS(DELAY, density, MEASUREMENT_SIGMA) for density in DENSITIES]
    squares, spreads, answers = ([[] for _ in filters] for _ in range(3))
    for t, frame in enumerate(seen):
        for m, bank in enumerate(filters):
            if (expected := bank.predict(t / 30)) is not None:
                variance = expected.sigma[0, 0] ** 2 + MEASUREMENT_SIGMA**2
                squares[m].append(np.square(frame - expected.positions).sum() / 3 / variance + 1e-4)
                spreads[m].append(np.log(variance))
            answers[m].append(bank.update(frame, t / 30))
    fading = (1 - 1 / MEMORY) ** np.arange(FRAMES - 1)[::-1]
    count = fading.sum()
    scale = np.array([fading @ s / count for s in squares])
    log_likelihood = -1.5 * (count * np.log(scale) + np.array([fading @ s for s in spreads]))
    weights = np.exp(log_likelihood - log_likelihood.max())
    weights /= weights.sum()
    last = [answer[-1] for answer in answers]
    places = np.array([answer.positions[0, 0] for answer in last])
    mean = weights @ places
    variance = weights @ (scale * [answer.sigma[0, 0] ** 2 for answer in last] + np.square(places - mean).mean(axis=1))

    found = _run(seen)[FRAMES - 1 - DELAY]
    np.testing.assert_allclose(found.positions[0, 0], mean, atol=1e-12)
    np.testing.assert_allclose(found.sigma[0, 0], np.sqrt(variance), rtol=1e-9)


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.05])
def test_deviation_follows_the_noise_that_nobody_told(noise: float) -> None:
    truth, seen = _swinging(noise)
    answers = _run(seen)[15:]
    off = np.array([answer.positions for answer in answers]) - truth[15:]
    stated = np.array([answer.sigma for answer in answers])
    assert 0.5 < np.sqrt(np.square(off).mean()) / np.sqrt(np.square(stated).mean()) < 1.3


def test_between_two_sightings_it_is_near_the_truth() -> None:
    truth, seen = _swinging(0.002)
    seen[30:34, 0, 1] = np.nan
    answer = _run(seen)[31]
    assert np.linalg.norm(answer.positions[0, 1] - truth[31, 0, 1]) < 0.015
    assert answer.sigma[0, 1] < 0.02


def test_bodies_do_not_know_of_each_other_and_a_slot_begins_anew() -> None:
    seen = _swinging(0.01)[1]
    both, alone = _run(seen), _run(seen[:, :1])
    for a, b in zip(both, alone, strict=True):
        np.testing.assert_array_equal(a.positions[:1], b.positions)
    smoother, fresh = (MultipleModelSmoother(0, 1, 3, DENSITIES, MEASUREMENT_SIGMA) for _ in range(2))
    for t, frame in enumerate(seen[:20, :1]):
        smoother.update(frame, t / 30, np.ones((1, 3)))
    smoother.forget(np.array([True]))
    for t, frame in enumerate(seen[20:40, 1:]):
        anew = smoother.update(frame, (20 + t) / 30, np.ones((1, 3)))
        first = fresh.update(frame, (20 + t) / 30, np.ones((1, 3)))
        assert anew is not None
        assert first is not None
        np.testing.assert_allclose(anew.positions, first.positions, atol=1e-12)


def test_a_joint_never_seen_has_no_answer() -> None:
    seen = _swinging(0.01)[1]
    seen[:, 1] = np.nan
    answer = _run(seen)[20]
    assert np.isnan(answer.positions[1]).all()
    assert np.isinf(answer.sigma[1]).all()
