from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from steadypose.benchmarks.baselines.kalman import fixed_lag
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS
from steadypose.prior.models.mixture import bank as banks
from steadypose.prior.models.mixture.bank import DENSITIES, EXPERTS, MEASUREMENT_SIGMA, Bank, advance, new_bank
from steadypose.prior.models.mixture.features import FEATURES, PARENT, describe
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.models.mixture.tracks import HELD, MEMORY, MIN_SCALE, SETTLED, body_covariance
from steadypose.prior.timing.kalman import ConstantVelocityFilter, Smoothed
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.sensors import Sensed
from steadypose.training.networks.mixture import MixtureConfig, MixtureNet, estimate
from steadypose.training.recipes.mixture import through_bank

DELAYS = (0, 1, 4, 16)


def walk(frames: int = 90, clips: int = 1, pace: float = 1.0) -> Floats:
    """(T, C, 22, 3) metres: a body of which every bone swings, each at its own rate, and which moves on."""
    time = np.arange(frames)[:, None, None] / FPS
    rng = np.random.default_rng(3)
    places = np.zeros((frames, clips, 22, 3))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        phase, rate = rng.uniform(0, 6, (clips, 3)), rng.uniform(0.3, 1.0, (clips, 3)) * pace
        bone = REST_OFFSETS[joint] + 0.3 * np.linalg.norm(REST_OFFSETS[joint]) * np.sin(phase + 6.28 * rate * time)
        bone *= np.linalg.norm(REST_OFFSETS[joint]) / np.linalg.norm(bone, axis=-1, keepdims=True)
        places[:, :, joint] = places[:, :, parent] + bone
    return places + np.array([0.8, 0.3, 0.0]) * time[..., None, :] + (1.0, 2.0, 0.9)


def smoothed(seen: Floats, delay: int, weights: str = "default") -> list[Smoothed]:
    """All answers to (T, S, 22, 3)."""
    smoother = MixtureSmoother(delay, seen.shape[1], weights)
    found = [smoother.update(frame, t / FPS) for t, frame in enumerate(seen)]
    return [one for one in found if one is not None] + smoother.flush()


def places(found: list[Smoothed]) -> Floats:
    return np.stack([one.positions for one in found])


def noisy(truth: Floats, sigma: float = 0.02) -> Floats:
    return truth + sigma * np.random.default_rng(5).standard_normal(truth.shape)


@pytest.mark.parametrize("white", [0.0, 0.6])
@pytest.mark.parametrize("delay", DELAYS)
def test_experts_are_fixed_lag_smoothers_and_their_mean_by_predictions(delay: int, white: float) -> None:
    seen, known_sigma = noisy(walk(40)), MEASUREMENT_SIGMA / 0.8
    bank, confidence = new_bank(1, delay), np.full((1, 22), 0.8)
    textbook = [ConstantVelocityFilter(density, known_sigma) for density in DENSITIES]
    misfit, spread, count = (np.zeros((22, len(DENSITIES))) for _ in range(3))
    for t, frame in enumerate(seen):
        advance(bank, t, 1 / FPS, frame, confidence, DENSITIES, MEASUREMENT_SIGMA, np.eye(22))
        for m, smoother in enumerate(textbook):
            ahead = smoother.predict(t / FPS)
            if ahead is None:
                smoother.update(frame, t / FPS)
                continue
            variance = ahead.sigma[0] ** 2 + known_sigma**2
            square = np.square(frame[0] - ahead.positions[0]).sum(axis=1) / 3 / variance + MIN_SCALE
            for total, new in ((misfit, square), (spread, np.log(variance)), (count, 1.0)):
                total[:, m] = (1 - 1 / MEMORY) * total[:, m] + new
            smoother.update(frame, t / FPS)
        if t < max(delay, 1):
            continue
        experts, _ = described(bank, t + 1, delay, white)
        so_far = seen[: t + 1, 0], np.arange(t + 1) / FPS, delay, 2
        each = np.stack([fixed_lag(*so_far, density, known_sigma)[t - delay] for density in DENSITIES], axis=1)
        np.testing.assert_allclose(experts[:, : len(DENSITIES)], each, atol=1e-6)
        noise = (likely(count, misfit, spread) * misfit / count).sum(axis=1)
        shared = banks.SHARED * white
        weights = likely(count + shared, misfit + shared * np.exp(np.log(noise).mean()), spread)
        mean = (weights[..., None] * each).sum(axis=1)
        np.testing.assert_allclose(experts[:, banks.MULTIPLE_MODEL], mean, atol=1e-6)


def likely(count: Floats, misfit: Floats, spread: Floats) -> Floats:
    """(22, M) weights of the smoothers, by the likelihood of so many innovations."""
    likelihood = -1.5 * (count * np.log(misfit / count) + spread)
    weights = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    return weights / weights.sum(axis=1, keepdims=True)


def described(bank: Bank, count: int, delay: int, white: float = 0.0) -> tuple[Floats, Floats]:
    """Experts (22, EXPERTS, 3) and gaps (22,) of a bank's only body."""
    experts, features, scale = np.empty((1, 22, EXPERTS, 3)), np.empty((1, 22, FEATURES), np.float32), np.empty(1)
    gap, between = np.empty((2, 1, 22))
    describe(bank, count, delay, PARENT, np.array([white]), experts, features, scale, gap, between)
    return experts[0], gap[0]


def multiple_model(seen: Floats, covariance: Floats, delay: int = 4) -> tuple[Floats, Floats, Bank]:
    """Of a body (T, 22, 3): multiple-model estimates (T - delay, 22, 3), gaps (T - delay, 22), the bank at the end."""
    bank, found = new_bank(1, delay), []
    for t, frame in enumerate(seen[:, None]):
        advance(bank, t, 1 / FPS, frame, np.ones((1, 22)), DENSITIES, MEASUREMENT_SIGMA, covariance)
        if t >= delay:
            experts, gap = described(bank, t + 1, delay)
            found.append((experts[:, banks.MULTIPLE_MODEL], gap))
    estimates, gaps = zip(*found, strict=True)
    return np.array(estimates), np.array(gaps), bank


@pytest.mark.parametrize("hidden", [False, True])
def test_a_body_is_smoothed_better_than_its_joints(hidden: bool) -> None:
    covariance, rng = body_covariance(), np.random.default_rng(8)
    values, vectors = np.linalg.eigh(covariance)
    pushes = rng.standard_normal((150, 22, 3)) * np.sqrt(np.maximum(values, 0.0))[:, None]
    truth = np.einsum("jm,tma->tja", vectors, np.cumsum(np.cumsum(pushes, axis=0) - 0.5 * pushes, axis=0)) * 0.01
    seen = truth + 0.03 * rng.standard_normal(truth.shape)
    if hidden:
        seen[60:80, 7] = seen[30::9, 3] = np.nan
    of_body, of_joints = (multiple_model(seen, matrix)[0] - truth[:-4] for matrix in (covariance, np.eye(22)))
    assert np.linalg.norm(of_body, axis=-1).mean() < 0.92 * np.linalg.norm(of_joints, axis=-1).mean()


def test_a_joint_that_is_missed_for_long_is_a_track_by_itself_until_it_has_settled() -> None:
    seen = noisy(walk(60))[:, 0]
    seen[30:40, 7] = np.nan
    belongs = [bool(multiple_model(seen[:t], body_covariance(), 0)[2].member[0, 7]) for t in range(20, 60)]
    assert belongs == [not 30 + HELD < t <= 40 + SETTLED for t in range(20, 60)]
    bank = multiple_model(seen[:37], body_covariance(), 0)[2]
    np.testing.assert_allclose(bank.modes[0] @ bank.modes[0].T, np.eye(22), atol=1e-12)
    assert np.flatnonzero(bank.modes[0, 7]).tolist() == [7]


def test_the_gap_is_the_time_to_the_nearest_observation() -> None:
    seen = walk(12)[:, 0]
    seen[:3, 5] = np.nan
    seen[6:9, 5] = np.nan
    gaps = multiple_model(seen, body_covariance())[1]
    assert gaps[:, 5].tolist() == [-1, -1, -1, 0, 0, 0, 1, 2]
    assert (np.delete(gaps, 5, axis=1) == 0).all()


def test_live_form_gives_what_torch_gives(tmp_path: Path) -> None:
    torch.manual_seed(0)
    net = MixtureNet(MixtureConfig(own=8, body=24, told=6, head=16))
    with torch.no_grad():
        net.write.weight.mul_(10)
    path = tmp_path / "some.safetensors"
    save_file({name: value.contiguous() for name, value in net.state_dict().items()}, path, metadata={"config": "{}"})
    truth = walk(50, 2)
    seen = noisy(truth)
    seen[20:30, :, 5] = np.nan
    clips = seen.swapaxes(0, 1)
    sensed = Sensed(clips, truth.swapaxes(0, 1), np.ones(clips.shape[:3]))
    for delay in (0, 4):
        batch = through_bank(sensed, delay)
        with torch.no_grad():
            outputs = net(batch.features, torch.ones(batch.features.shape[:2], dtype=torch.bool))
            described = batch.experts, batch.heading, batch.scale, batch.gap, batch.between, batch.fallback
            expected, variance = estimate(outputs, *described)
        found = smoothed(seen, delay, str(path))[: 50 - delay]
        origin = truth[0, :, 0][:, None, None]
        np.testing.assert_allclose(places(found).swapaxes(0, 1), expected.numpy() + origin, atol=2e-5)
        sigma = np.stack([one.sigma for one in found], axis=1)
        np.testing.assert_allclose(sigma, np.sqrt(variance.numpy()) * 1e-3, rtol=1e-3)


@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("pace", [0.5, 3.0])
def test_a_perfect_input_stays_what_it_is(delay: int, pace: float) -> None:
    truth = walk(pace=pace)
    off = np.linalg.norm(places(smoothed(truth, delay)) - truth, axis=-1)
    assert off.mean() < 0.002
    assert off[3:].max() < 0.001  # in the first frames nothing tells fast motion from noise


def test_noise_gets_less_and_more_so_with_more_delay() -> None:
    truth = walk()
    seen = noisy(truth, 0.04)
    raw = np.linalg.norm(seen - truth, axis=-1).mean()
    errors = [np.linalg.norm(places(smoothed(seen, delay)) - truth, axis=-1).mean() for delay in (0, 4, 16)]
    assert errors[0] < 0.85 * raw
    assert errors[1] < 0.9 * errors[0]
    assert errors[2] < 1.02 * errors[1]


@pytest.mark.parametrize("delay", [0, 4])
def test_an_unseen_joint_coasts_and_says_so(delay: int) -> None:
    seen = noisy(walk(), 0.005)
    seen[40:, :, 20] = np.nan
    found = smoothed(seen, delay)
    assert np.isfinite(places(found)).all()
    sigma = np.array([one.sigma[0, 20] for one in found])
    assert sigma[50] > sigma[30]
    assert sigma[85] > sigma[50]
    assert sigma[85] > 0.1


def test_between_two_observations_a_joint_is_near_the_truth_and_says_so() -> None:
    truth = walk(pace=1.5)
    seen = noisy(truth, 0.002)
    seen[45:48, :, 20] = np.nan
    found = smoothed(seen, 4)
    off = np.linalg.norm(places(found) - truth, axis=-1)[45:48, 0, 20]
    assert off.max() < 0.03
    assert max(one.sigma[0, 20] for one in found[45:48]) < 0.03


def test_a_joint_never_seen_is_not_known() -> None:
    seen = noisy(walk())
    seen[:, :, 3] = np.nan
    found = smoothed(seen, 4)
    assert np.isnan(places(found)[:, :, 3]).all()
    assert all(np.isinf(one.sigma[:, 3]).all() for one in found)
    assert np.isfinite(np.delete(places(found), 3, axis=2)).all()


def test_bodies_do_not_touch_each_other_and_the_same_gives_the_same() -> None:
    seen = noisy(walk(60, 3))
    together = smoothed(seen, 4)
    alone = smoothed(seen[:, 1:2], 4)
    assert (places(together)[:, 1:2] == places(alone)).all()
    assert all((a.sigma[1] == b.sigma[0]).all() for a, b in zip(together, alone, strict=True))
    assert (places(smoothed(seen, 4)) == places(together)).all()
