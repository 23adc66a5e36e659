from types import SimpleNamespace

import numpy as np
import pytest

from prior.anomaly import (
    MISSING,
    RATES,
    RECENT,
    SENSOR_SIGMAS,
    Calibration,
    Score,
    ScoreSettings,
    decimals,
    deviations,
    oddities,
)  # fmt: skip
from prior.pipeline import PriorPipeline, PriorSettings
from prior.skeletons import MIRROR, PARENTS, J
from prior.window import Window
from tests.prior.bodies import stream, waving

SHAPE = (len(MISSING), len(SENSOR_SIGMAS))
HEIGHTS = np.linspace(0.0, 7.0, len(RATES))
SCALE = Calibration(np.zeros((*SHAPE, 22)), np.ones((*SHAPE, 22)), np.broadcast_to(HEIGHTS, (*SHAPE, len(RATES))))


def scored(positions: np.ndarray, **settings) -> list:
    pipeline = PriorPipeline(PriorSettings.from_dict({"delay": 0, **settings}))
    return [c.bodies[0] for m in stream(positions) for c in pipeline.process(m)]


def test_deviations_are_of_recent_frames_seen_bias_and_variance_together() -> None:
    x, mean, sigma, observed = np.zeros((66, 50)), np.zeros((66, 50)), np.full((66, 50), 0.03), np.ones((66, 50))
    x[:, : 50 - RECENT] = 9.0  # long ago
    x[3 * J["head"] : 3 * J["head"] + 3, -RECENT:] = 0.1
    observed[3 * J["neck"] : 3 * J["neck"] + 3, -RECENT:] = 0
    logs = deviations(x, mean, sigma, observed)
    assert logs[J["head"]] == pytest.approx(np.log(0.1**2 + 0.03**2))
    assert np.isnan(logs[J["neck"]])
    odd = oddities(logs, SCALE.at(0.02), np.array(1))
    assert odd.argmax() == J["head"]
    assert odd[J["neck"]] == -np.inf


def test_the_scale_is_the_decimals_of_the_rate_among_clean_windows() -> None:
    scale = SCALE.at(0.02)
    missing = np.zeros(len(RATES), dtype=int)
    np.testing.assert_allclose(decimals(HEIGHTS, scale, missing), -np.log10(RATES), atol=1e-6)
    beyond = decimals(np.array([7.0, 8.0, 9.0]), scale, missing[:3])
    assert beyond[2] - beyond[1] == pytest.approx(beyond[1] - beyond[0])
    assert decimals(np.array([-50.0]), scale, missing[:1]) == 0


def test_between_measured_sensors_the_scale_is_between_theirs() -> None:
    mean = np.zeros((*SHAPE, 22))
    mean[:, 1] = 1.0
    middle = Calibration(mean, SCALE.spread, SCALE.quantiles).at(float(np.sqrt(SENSOR_SIGMAS[1] * SENSOR_SIGMAS[2])))
    np.testing.assert_allclose(middle.mean, 0.5)


def test_clean_motion_is_no_anomaly_and_frames_are_scored_alike_twice() -> None:
    clean = waving(90)
    bodies = scored(clean)
    assert not any(b.anomaly_flag for b in bodies)
    assert [b.anomaly for b in bodies] == [b.anomaly for b in scored(clean)]


def test_exchanged_arms_raise_the_flag_which_goes_down_after_they_are_over() -> None:
    """The gate is off: it would put them back."""
    spoilt = waving(200)
    arms = [J[f"{side}_{n}"] for n in ("elbow", "wrist") for side in ("left", "right")]
    spoilt[60:100, arms] = spoilt[60:100][:, MIRROR[arms]]
    bodies = scored(spoilt, gate={"enabled": False}, bones={"enabled": False})
    flags = np.array([b.anomaly_flag for b in bodies])
    assert not flags[:60].any()
    assert flags[60:90].any()
    assert not flags[165:].any()
    worst = bodies[int(np.argmax([b.anomaly for b in bodies]))]
    assert np.nanargmax(worst.joint_anomaly) in {*arms, *(PARENTS[j] for j in arms)}
    assert np.nanmax(worst.joint_anomaly) == pytest.approx(worst.anomaly, rel=1e-5)


def test_a_flag_is_held_until_it_has_been_quiet_for_a_while() -> None:
    stage = Score(ScoreSettings(false_alarms=0.01, hold=0.1), "default", 0.02, 1)
    window = Window(4, 1)
    told = iter([0.0, 2.5, 1.5, 0.9, 0.9, 0.9, 0.9, 2.5])
    window.encoded = SimpleNamespace(slots=np.array([0]))  # type: ignore[assignment]
    stage._score = lambda _: (np.array([next(told)]), np.zeros((1, 22)))  # type: ignore[method-assign]
    flags = [bool(stage.update(window).anomaly_flag[0]) for _ in range(8)]
    assert flags == [False, True, True, True, True, False, False, True]


def test_switched_off_nothing_is_scored() -> None:
    bodies = scored(waving(30), score={"enabled": False})
    assert np.isnan([b.anomaly for b in bodies]).all()
    assert not any(b.anomaly_flag for b in bodies)


def test_an_impossible_rate_is_refused() -> None:
    with pytest.raises(ValueError, match="false_alarms"):
        PriorPipeline(PriorSettings.from_dict({"score": {"false_alarms": 0.0}}))
