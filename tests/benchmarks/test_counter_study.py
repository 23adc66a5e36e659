import numpy as np
import pytest

from steadypose.benchmarks.studies.counter import COUNTERS, SITS, STANDS, behind, errors, rules, truth_at
from steadypose.benchmarks.systems.events import simulated
from steadypose.prior.body.layouts import KINECT22


def test_the_truth_has_no_error_and_what_is_wrong_has_its_own() -> None:
    scene, raw = simulated("sits", 1)
    (motion,), stamps_s = scene.motions, np.arange(0.0, 19.0, 0.1)
    true = {"stamps_s": stamps_s, **truth_at(motion, "sits", stamps_s)}
    assert {STANDS, SITS} < set(true["posture"])
    found = true | {"sigma": np.ones((len(stamps_s), 4)), "contacts": stamps_s > 0.0}
    exact = {name: np.nanmean(values) for name, values in errors(found, motion, "sits").items()}
    assert exact == pytest.approx({**dict.fromkeys(exact, 0.0), "posture": 100.0, "contacts": 100.0}, abs=1e-4)
    found |= {
        "facing": true["facing"] + 2 * np.pi + 0.1, "root": true["root"] + [0.3, -0.4, 0.01],
        "head": true["head"] - 0.02, "posture": np.full(len(stamps_s), STANDS), "feet": true["feet"] + [2.0, 1.0, 2.0],
    }  # fmt: skip
    wrong = {name: np.nanmean(values) for name, values in errors(found, motion, "sits").items()}
    expected = {"facing": np.degrees(0.1), "place": 500.0, "hips": 10.0, "head": 20.0, "feet": 3000.0, "ratio": 3.0}
    assert {name: wrong[name] for name in expected} == pytest.approx(expected)
    assert 20.0 < wrong["posture"] < 80.0

    hidden = behind(raw, COUNTERS["hips and below hidden"])
    gone = {name for name, p in zip(KINECT22.joints, hidden[9].bodies[0].positions, strict=True) if np.isnan(p).all()}
    assert {"Waist", "LUpperLeg", "RLowerLeg", "LFoot", "RToes"} <= gone
    assert not gone & {"LUpperArm", "Spine", "Head"}
    seen, guessed = (errors(rules(frames), motion, "sits") for frames in (raw, hidden))
    assert guessed["facing"].mean() == pytest.approx(seen["facing"].mean(), rel=0.3)  # across the shoulders
    assert seen["hips"].mean() < 80.0
    assert guessed["place"].mean() > seen["place"].mean()
