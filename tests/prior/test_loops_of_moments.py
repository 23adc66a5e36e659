"""Compiled loops against the same written as array expressions, whichever joints are missing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.helpers.bodies import waving
from tests.helpers.values import gated

from steadypose.prior.arrays import medians
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.clean import reconstruct, sensor_error
from steadypose.prior.clean.history import History
from steadypose.prior.clean.reconstruct import Denoise
from steadypose.prior.clean.sensor_error import DepthError
from steadypose.prior.compiled import median
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]
SLOTS, FRAMES = 2, 24
SEEDS = st.integers(0, 2**32 - 1)
MISSING = st.floats(0.0, 0.9)


def observed(rng: np.random.Generator, missing: float) -> Floats:
    """(T, S, 22, 3) metres, with noise and with joints missing; the second body is away at first."""
    frames = np.stack([waving(FRAMES), waving(FRAMES) + [1.0, 0.5, 0.0]], axis=1)
    frames += rng.normal(0.0, 0.01, frames.shape)
    frames[rng.random(frames.shape[:3]) < missing] = np.nan
    frames[:5, 1] = np.nan
    return frames


def bones_of(frames: Floats) -> Floats:
    return frames[..., 1:, :] - frames[..., list(PARENTS[1:]), :]


@settings(deadline=None, max_examples=20)
@given(SEEDS, MISSING)
def test_errors_along_a_direction_are_those_of_a_least_squares_fit(seed: int, missing: float) -> None:
    rng = np.random.default_rng(seed)
    frames, found = observed(rng, missing), DepthError(SLOTS)
    sigmas = rng.uniform(0.0, 1.2 * sensor_error.MAX_SIGMA, frames.shape[:3])
    rows: list[list[tuple[Floats, float, int]]] = [[] for _ in range(SLOTS)]
    count, mean = np.zeros((2, SLOTS, 21))
    left_out = np.zeros(SLOTS)
    for t, frame in enumerate(frames):
        left_out = found.update(Smoothed(t / FPS, frame, sigmas[t]), np.zeros(SLOTS))
        bones, ends = bones_of(frame), np.maximum(sigmas[t][:, 1:], sigmas[t][:, list(PARENTS[1:])])
        for slot, bone in np.argwhere(np.isfinite(bones[..., 0]) & (ends < sensor_error.MAX_SIGMA)):
            at, length = (slot, bone), float(np.linalg.norm(bones[slot, bone]))
            count[at] += 1
            mean[at] += (length - mean[at]) / count[at]
            residual = min((length - mean[at]) ** 2, sensor_error.MAX_RESIDUAL**2)
            x, y, z = bones[at] / length
            direction = np.array([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z])
            rows[slot].append((direction, 0.5 * residual, t))
    for slot in range(SLOTS):
        forgotten = np.array([(1 - 1 / sensor_error.MEMORY) ** (FRAMES - 1 - t) for _, _, t in rows[slot]])
        directions = np.array([direction for direction, _, _ in rows[slot]]).reshape(-1, 6)
        squares = np.array([square for _, square, _ in rows[slot]])
        total = forgotten.sum()
        ridge = sensor_error.RIDGE * total + sensor_error.PRIOR * 21
        isotropic = ridge * (forgotten @ squares) / max(total, 1.0)
        normal = (directions.T * forgotten) @ directions + ridge * np.diag([1.0, 1, 1, 2, 2, 2])
        form = np.linalg.solve(
            normal, (directions.T * forgotten) @ squares + isotropic * np.array([1.0, 1, 1, 0, 0, 0])
        )
        a, b, c, d, e, f = form
        values = np.linalg.eigvalsh([[a, d, e], [d, b, f], [e, f, c]])
        np.testing.assert_allclose(left_out[slot] ** 2, sensor_error.LEFT_OUT * (values[2] - values[1]), atol=1e-12)


@settings(deadline=None, max_examples=20)
@given(SEEDS, MISSING, st.integers(0, 4))
def test_denoising_weighs_two_estimates_of_which_one_has_part_of_the_others_noise(seed: int, missing: float, back: int):
    rng = np.random.default_rng(seed)
    frames, stage, history = observed(rng, missing), Denoise(back, SLOTS), History(8, SLOTS)
    jitter, bias = rng.uniform(0.0, 0.02, (2, SLOTS))
    apart, count, before = np.zeros((SLOTS, 22)), np.zeros((SLOTS, 22)), np.full((SLOTS, 22, 3), np.nan)
    late = np.interp(back, (0, reconstruct.SETTLED), (reconstruct.LATE_NEWEST_S, reconstruct.LATE_S)) * FPS
    for frame in frames:
        history.append(gated(frame))
        stage._reconstructed[:] = frame + rng.normal(0.0, 0.02, frame.shape)
        smoothed = Smoothed(0.0, frame, np.where(np.isnan(frame[..., 0]), np.inf, 0.01))
        found = stage._denoised(smoothed, history, jitter, bias, back)
        seen = np.isfinite(history.positions[-1 - back][..., 0])
        seen |= ~seen.any(axis=1, keepdims=True)
        seen |= history.observed_since(back) & (history.unobserved_s[-1 - back] < reconstruct.BRIEF_S)
        moved = stage._reconstructed[-1 - back] - frame
        square = np.square(moved).mean(axis=-1)
        positions, sigmas = frame.copy(), smoothed.sigma.copy()
        noise = np.hypot(jitter, bias * back / reconstruct.SETTLED)
        for at in zip(*np.nonzero(seen & np.isfinite(square)), strict=True):
            count[at] += 1
            apart[at] += (square[at] - apart[at]) / min(count[at], reconstruct.MEMORY)
            gained = (1 - reconstruct.NOISE_LEFT) * min(sigmas[at], noise[at[0]]) ** 2
            own = max(max(apart[at], square[at] / reconstruct.SUDDEN) - gained, reconstruct.MODEL_SIGMA**2)
            own += late**2 * np.square(np.nan_to_num(frame[at] - before[at])).mean()
            share = gained / (gained + own)
            positions[at] += share * moved[at]
            sigmas[at] *= np.sqrt(1 - share * (1 - reconstruct.NOISE_LEFT))
        np.testing.assert_allclose(found.positions, positions, rtol=1e-12)
        np.testing.assert_allclose(found.sigma, sigmas, rtol=1e-12)
        before = frame


@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("count", [1, 2, 7, 22])
def test_medians_are_numpys_without_what_is_missing(count: int) -> None:
    rng = np.random.default_rng(count)
    values = rng.normal(size=(count, 40))
    values[rng.random(values.shape) < rng.random(40)] = np.nan
    for axis in (0, 1):
        assert np.array_equal(medians(values, axis), np.nanmedian(values, axis=axis), equal_nan=True)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_the_median_of_loops_is_numpys(values: list[float]) -> None:
    given_ = np.array(values)
    before = given_.copy()
    assert median(given_) == np.median(given_)
    assert np.array_equal(given_, before)
