from collections import Counter

import numpy as np
from tests.helpers.bodies import waving

from steadypose.prior.body.skeleton import MIRROR, J
from steadypose.prior.clean.frame import Window
from steadypose.prior.clean.gate import RECENT, Gate, GateSettings, stuck

WRIST, KNEE = J["left_wrist"], J["right_knee"]


def run(positions: np.ndarray, **settings) -> tuple[np.ndarray, Counter[str]]:
    counters: Counter[str] = Counter()
    gate, window = Gate(GateSettings(**settings), 1, counters), Window(8, 1)
    window.present[:] = True
    passed = []
    for k, frame in enumerate(positions):
        window.stamp_s.push(k / 30)
        window.raw.push(frame[None])
        window.confidence.push(np.ones((1, 22)))
        passed.append(gate.update(window).positions.newest[0].copy())
    return np.array(passed), counters


def noisy(frames: int = 90) -> np.ndarray:
    return waving(frames) + np.random.default_rng(0).normal(size=(frames, 22, 3)) * 0.01


def test_ordinary_motion_with_ordinary_noise_passes_untouched() -> None:
    positions = noisy()
    passed, counters = run(positions)
    assert np.array_equal(passed, positions)
    assert not counters


def test_a_spike_becomes_unobserved_and_the_next_frame_passes() -> None:
    positions = noisy()
    positions[50, WRIST] += [0.3, 0, 0]
    passed, counters = run(positions)
    assert np.isnan(passed[50, WRIST]).all()
    assert np.array_equal(passed[51], positions[51])
    assert counters["joints_refused"] == 1


def test_a_joint_that_stays_where_it_jumped_is_believed_before_long() -> None:
    positions = noisy()
    positions[40:, WRIST] += [0.0, 0.0, 0.4]
    passed, _ = run(positions)
    refused = np.isnan(passed[:, WRIST, 0])
    assert refused[40]
    assert 2 <= refused.sum() <= 10


def test_exchanged_legs_are_put_back() -> None:
    positions = waving(90)
    legs = [J[f"{s}_{j}"] for s in ("left", "right") for j in ("knee", "ankle", "foot")]
    positions[30:90, [J["left_knee"], J["left_ankle"], J["left_foot"]], 0] += np.linspace(0, 0.3, 60)[:, None]
    swapped = positions.copy()
    swapped[60:66, legs] = positions[60:66][:, MIRROR[legs]]
    passed, counters = run(swapped)
    assert counters["limbs_exchanged"] == 6
    assert np.allclose(passed, positions)


def test_a_whole_body_that_jumps_is_another_matter_than_its_joints() -> None:
    positions = noisy()
    positions[50:] += [1.0, 0, 0]
    passed, counters = run(positions)
    assert np.array_equal(passed, positions)
    assert counters["joints_refused"] == 0


def test_low_confidence_is_not_seen() -> None:
    counters: Counter[str] = Counter()
    gate, window = Gate(GateSettings(), 1, counters), Window(8, 1)
    window.stamp_s.push(0.0)
    window.raw.push(waving(1))
    trust = np.ones((1, 22))
    trust[0, KNEE] = 0.05
    window.confidence.push(trust)
    passed = gate.update(window).positions.newest[0]
    assert np.isnan(passed[KNEE]).all()
    assert np.isfinite(passed[WRIST]).all()


def test_switched_off_everything_passes() -> None:
    positions = noisy()
    positions[50, WRIST] += [0.5, 0, 0]
    passed, counters = run(positions, enabled=False)
    assert np.array_equal(passed, positions)
    assert not counters


def test_a_joint_is_stuck_that_repeats_itself_while_others_shake() -> None:
    rng = np.random.default_rng(0)
    seen = np.stack([waving(50)] * 3)
    seen[:2] += rng.normal(0.0, 0.005, seen[:2].shape)
    seen[:, -RECENT:, J["left_wrist"]] = seen[:, -RECENT - 1, None, J["left_wrist"]]
    seen[1, :, J["neck"]] = np.nan
    found = stuck(seen)
    assert np.flatnonzero(found[0]).tolist() == [J["left_wrist"]]
    assert np.flatnonzero(found[1]).tolist() == [J["left_wrist"]]
    assert not found[2].any()  # without noise, it may be at rest
    seen[0, -RECENT + 5 :, J["left_wrist"]] += rng.random((RECENT - 5, 3))
    assert not stuck(seen)[0].any()


def test_a_body_that_is_repeated_whole_has_no_joint_stuck() -> None:
    """A camera of 15 Hz on a grid of 30, or one that pauses."""
    rng = np.random.default_rng(0)
    seen = (waving(50) + rng.normal(0.0, 0.005, (50, 22, 3)))[None]
    slower = seen[:, np.arange(50) // 2 * 2]
    assert not stuck(slower).any()
    assert not stuck(np.repeat(seen[:, :1], RECENT + 1, axis=1)).any()
    slower[:, :, WRIST] = slower[:, :1, WRIST]
    assert np.flatnonzero(stuck(slower[0:1, -RECENT - 1 :])[0]).tolist() == [WRIST]


def test_a_joint_that_is_stuck_becomes_unobserved() -> None:
    positions = noisy()
    positions[40:70, WRIST] = positions[39, WRIST]
    passed, counters = run(positions)
    assert np.isnan(passed[46:70, WRIST]).all()
    assert np.isfinite(np.delete(passed, WRIST, axis=1)).all()
    assert np.isfinite(passed[-10:]).all()
    assert counters["joints_stuck"] >= 24
