from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tests.helpers.bodies import waving
from tests.helpers.values import clean_bodies

from steadypose.prior.body.skeleton import MIRROR, PARENTS, J
from steadypose.prior.clean.score import OwnScale, Scorer
from steadypose.prior.clean.settings import ScoreSettings
from steadypose.prior.models.hgvae.config import FaultNetConfig
from steadypose.prior.models.hgvae.faults import (
    FROZEN_ODDS,
    MISSING,
    OFF_SCALE,
    PACES,
    RATES,
    RECENT,
    ROUGH_SCALE,
    SENSOR_SIGMAS,
    Calibration,
    decimals,
    fault_features,
    joint_odds,
    pace,
)
from steadypose.training.networks.graph import FaultNet, load_fault_net

HEIGHTS = np.linspace(0.0, 7.0, len(RATES))
SCALE = Calibration(np.broadcast_to(HEIGHTS, (len(MISSING), len(SENSOR_SIGMAS), len(PACES), len(RATES))))


def looks(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Windows (count, 66, 20): tracks, NaN where not seen, what is made of them, how surely, and what was seen."""
    rng = np.random.default_rng(0)
    x, found = rng.normal(scale=0.5, size=(2, count, 66, 20))
    seen = np.repeat(rng.random((count, 22, 20)) < 0.7, 3, axis=1)
    return np.where(seen, x, np.nan), found, rng.uniform(0.005, 0.1, x.shape), seen.astype(float)


def awake() -> FaultNet:
    torch.manual_seed(0)
    network = FaultNet(FaultNetConfig(frames=20, features=8)).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return network


def test_the_fault_network_is_told_of_what_was_seen_alone() -> None:
    x, found, sigma, observed = looks(2)
    mean = np.linspace(-1.0, 1.0, 66)
    told = fault_features(x, found, sigma, observed, np.array([0.01, 0.02]), mean)
    seen = observed > 0
    expected = [
        np.where(seen, (x - mean[:, None]) / 0.2, 0.0), np.where(seen, np.arcsinh((x - found) / OFF_SCALE), 0.0),
        np.log(sigma / OFF_SCALE), observed,
    ]  # fmt: skip
    np.testing.assert_allclose(told[..., :80], np.concatenate(expected, axis=-1), rtol=1e-5, atol=1e-6)
    shaken = np.diff(x, n=2, axis=-1)[..., -RECENT:]
    rough = np.nansum(shaken**2, axis=-1) / np.maximum(np.isfinite(shaken).sum(axis=-1), 1)
    np.testing.assert_allclose(told[..., 80], 0.5 * np.log(rough / ROUGH_SCALE**2 + 1e-3), rtol=1e-5)
    np.testing.assert_allclose(told[..., 81], np.tile(np.log([[1.0], [2.0]]), 66), atol=1e-6)


def test_a_joint_not_seen_of_late_has_no_odds_and_a_frozen_one_high_ones() -> None:
    observed = np.ones((2, 66, 20))
    observed[0, 3 * J["neck"] : 3 * J["neck"] + 3, -RECENT:] = 0
    frozen = np.zeros((2, 22), dtype=bool)
    frozen[:, J["neck"]] = True
    odds = joint_odds(np.zeros((2, 22)), observed, frozen)
    assert odds[0, J["neck"]] == -np.inf
    assert odds[1, J["neck"]] == FROZEN_ODDS
    assert (np.delete(odds, J["neck"], axis=1) == 0).all()


def test_the_scale_is_the_decimals_of_the_rate_among_clean_windows() -> None:
    limits = SCALE.limits(np.zeros(1, dtype=int), np.full(1, 0.02), np.ones(1))
    np.testing.assert_allclose(decimals(HEIGHTS[None], limits)[0], -np.log10(RATES), atol=1e-6)
    beyond = decimals(np.array([[7.0, 8.0, 9.0]]), limits)[0]
    assert beyond[2] - beyond[1] == pytest.approx(beyond[1] - beyond[0])
    assert (decimals(np.array([[-50.0, -np.inf]]), limits) == 0).all()


def test_between_what_was_measured_the_scale_is_between() -> None:
    quantiles = np.zeros_like(SCALE.quantiles)
    quantiles[:, 1, 1] = 1.0
    sensor, coarser = np.sqrt(SENSOR_SIGMAS[1] * SENSOR_SIGMAS[2]), 2 * SENSOR_SIGMAS[-1]
    pace_between = np.sqrt(PACES[1] * PACES[2])
    limits = Calibration(quantiles).limits(
        np.array([0, 2, 1]), np.array([sensor, coarser, sensor]), np.array([PACES[1], PACES[1], pace_between])
    )
    np.testing.assert_allclose(limits, [[0.5] * len(RATES), [0.0] * len(RATES), [0.25] * len(RATES)])


def test_the_pace_is_that_of_the_body_not_of_a_limb() -> None:
    mean = np.zeros((2, 22, 3, 50))
    mean[:, :, 0] = np.arange(50) / 30 * np.array([0.5, 1.5])[:, None, None]
    mean[0, 18:, 1, ::2] += 0.3
    np.testing.assert_allclose(pace(mean.reshape(2, 66, 50)), [0.5, 1.5])


def test_the_weights_that_ship_find_the_wrist_of_which_the_last_answer_is_repeated() -> None:
    assert load_fault_net("default").config.frames == 50
    moving = waving(90, speed=2.0)
    moving += np.random.default_rng(0).normal(0.0, 0.005, moving.shape)
    frozen = moving.copy()
    frozen[60:, J["left_wrist"]] = moving[59, J["left_wrist"]]
    gate_off = {"gate": {"enabled": False}, "person": {"enabled": False}}
    clean, spoilt = clean_bodies(moving, delay=0, **gate_off)[-1], clean_bodies(frozen, delay=0, **gate_off)[-1]
    assert spoilt.anomaly > clean.anomaly + 1
    assert np.nanargmax(spoilt.joint_anomaly) == J["left_wrist"]


def test_exchanged_arms_raise_the_flag_which_goes_down_after_they_are_over() -> None:
    """The gate is off: it would put them back."""
    spoilt = waving(200)
    arms = [J[f"{side}_{n}"] for n in ("elbow", "wrist") for side in ("left", "right")]
    spoilt[60:100, arms] = spoilt[60:100][:, MIRROR[arms]]
    bodies = clean_bodies(spoilt, delay=0, gate={"enabled": False}, person={"enabled": False})
    flags = np.array([b.anomaly_flag for b in bodies])
    assert not flags[:60].any()
    assert flags[60:90].any()
    assert not flags[165:].any()
    worst = bodies[int(np.argmax([b.anomaly for b in bodies]))]
    assert np.nanargmax(worst.joint_anomaly) in {*arms, *(PARENTS[j] for j in arms)}
    assert np.nanmax(worst.joint_anomaly) == pytest.approx(worst.anomaly, rel=1e-5)


def test_a_flag_is_held_until_it_has_been_quiet_for_a_while() -> None:
    stage = Scorer(ScoreSettings(false_alarms=0.01, hold=0.1), "default", 1)
    told = iter([0.0, 2.1, 1.7, 0.9, 0.9, 0.9, 0.9, 2.5])
    windows: Any = SimpleNamespace(slots=np.array([0]))
    frozen = np.zeros((1, 22), dtype=bool)
    stage._score = lambda *_: (np.array([next(told)]), np.zeros((1, 22)))  # type: ignore[method-assign]
    flags = [bool(stage.update(windows, frozen, np.full(1, 0.02)).flag[0]) for _ in range(8)]
    assert flags == [False, True, True, True, True, False, False, True]


def test_what_a_body_scores_all_the_time_is_no_fault_and_a_fault_of_a_second_no_habit() -> None:
    rng = np.random.default_rng(0)
    slots = np.arange(3)
    habit = np.array([1.0, 1.7, 10.0])  # validation's people; an unknown sensor; a wrong skeleton
    scale, told, scales = OwnScale(3), rng.exponential(1 / np.log(10), (3000, 3)) * habit, []
    for frame in told:
        scales.append(scale.update(slots, frame))
    rates = (told[300:] / np.array(scales)[300:] > 2).mean(axis=0)
    assert rates[0] < 0.011
    assert rates[1] < 0.6 * (told[300:, 1] > 2).mean()
    assert rates[2] > 0.3
    before = scale.update(slots, told[0])
    for _ in range(30):
        scale.update(slots, np.full(3, 50.0))
    assert (scale.update(slots, told[0]) <= before + 0.45).all()
    scale.update(slots, np.full(3, np.nan))
    assert np.isfinite(scale.update(slots, told[0])).all(), "one window without a score spoils none of the next"


def test_switched_off_nothing_is_scored() -> None:
    bodies = clean_bodies(waving(30), delay=0, score={"enabled": False})
    assert np.isnan([b.anomaly for b in bodies]).all()
    assert not any(b.anomaly_flag for b in bodies)
