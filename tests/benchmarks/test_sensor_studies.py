import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.motion import simulated_clips
from steadypose.benchmarks.studies import layouts
from steadypose.benchmarks.studies.counter import COUNTERS, SITS, STANDS, behind, errors, rules, truth_at
from steadypose.benchmarks.studies.mediapipe import Stream, error_of
from steadypose.benchmarks.systems.events import simulated
from steadypose.prior.body.layouts import KINECT22, SKELETONS, to_canonical
from steadypose.prior.body.skeleton import J


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_a_sensors_joints_are_those_of_the_body(layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts, "NOISE", 0.0)
    clips = simulated_clips(20, 2, 0)
    joints = layouts.sensed(clips, layout, np.random.default_rng(0), counter=False)
    body, _ = to_canonical(SKELETONS[layout], joints)
    off = np.linalg.norm(body - clips.positions, axis=-1).mean(axis=(0, 1))
    assert np.nanmax(off) < 0.035
    assert np.isfinite(off[[J["pelvis"], J["neck"], J["left_wrist"]]]).all()
    hidden = layouts.sensed(clips, layout, np.random.default_rng(0), counter=True)
    body, _ = to_canonical(SKELETONS[layout], hidden)
    assert np.isnan(body[:, :, [J["pelvis"], J["left_hip"], J["right_ankle"]]]).all()
    assert np.isfinite(body[:, :, [J["left_shoulder"], J["right_wrist"]]]).all()


def test_errors_ask_neither_where_the_body_stands_nor_how_it_is_turned_nor_what_a_joint_is() -> None:
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(0, 0.01, (40, 22, 3)), axis=0) + rng.normal(0, 0.4, (22, 3))
    truth[3, J["left_wrist"]] = np.nan
    turn = Rotation.from_rotvec((0.2, 0.4, 2.0)).as_matrix()
    walked = truth @ turn.T + np.cumsum(rng.normal(0, 0.1, (40, 1, 3)), axis=0)
    assert error_of(walked, Stream("cam01", walked, truth))["position_mm"] < 1e-6
    off = error_of(walked + np.eye(22)[:, :1] * 0.05, Stream("cam01", walked, truth))
    assert off["position_mm"] < 1.0
    shaken = walked + rng.normal(0, 0.02, walked.shape)
    found = error_of(shaken, Stream("cam01", shaken, truth))
    assert found["position_mm"] == pytest.approx(1e3 * 0.02 * np.sqrt(8 / np.pi), rel=0.25)


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
