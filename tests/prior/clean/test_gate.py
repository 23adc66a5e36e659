from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import observation

from steadypose.prior.body.skeleton import MIRROR, J
from steadypose.prior.clean.gate import Gate
from steadypose.prior.clean.settings import GateSettings

WRIST, KNEE = J["left_wrist"], J["right_knee"]
ARM = [J[f"left_{name}"] for name in ("shoulder", "elbow", "wrist")]


def run(positions: np.ndarray, **settings) -> tuple[np.ndarray, Counter[str]]:
    counters: Counter[str] = Counter()
    gate = Gate(GateSettings(**settings), 1, counters)
    passed = [gate.update(observation(frame[None], k / 30)).positions[0] for k, frame in enumerate(positions)]
    return np.array(passed), counters


def test_ordinary_motion_with_ordinary_noise_passes_untouched() -> None:
    positions = noisy(90, 0.01)
    passed, counters = run(positions)
    assert np.array_equal(passed, positions)
    assert not counters


def test_a_spike_becomes_unobserved_and_the_next_frame_passes() -> None:
    positions = noisy(90, 0.01)
    positions[50, WRIST] += [0.3, 0, 0]
    passed, counters = run(positions)
    assert np.isnan(passed[50, WRIST]).all()
    assert np.array_equal(passed[51], positions[51])
    assert counters["joints_refused"] == 1


def struck(frames: int = 90) -> np.ndarray:
    """Somebody whose forearm turns over by two radians in one frame and back, about an elbow that rests."""
    positions = np.repeat(waving(1), frames, axis=0)
    turn = Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()
    positions[50, WRIST] = positions[50, ARM[1]] + turn @ (positions[50, WRIST] - positions[50, ARM[1]])
    return positions


def test_of_a_perfect_sensor_a_joint_that_kept_its_bones_is_believed_however_fast() -> None:
    positions = struck()
    assert np.linalg.norm(positions[50, WRIST] - positions[49, WRIST]) > 0.2
    passed, counters = run(positions)
    assert np.array_equal(passed, positions)
    assert not counters


def test_of_a_sensor_whose_bones_vary_their_lengths_excuse_nothing() -> None:
    positions = struck()
    noise = np.random.default_rng(0).normal(size=positions.shape) * 0.02
    noise[50, ARM] = 0.0
    passed, _ = run(positions + noise)
    assert np.isnan(passed[50, WRIST]).all()


def test_a_joint_that_stays_where_it_jumped_is_believed_before_long() -> None:
    positions = noisy(90, 0.01)
    positions[40:, WRIST] += [0.0, 0.0, 0.4]
    passed, _ = run(positions)
    refused = np.isnan(passed[:, WRIST, 0])
    assert refused[40]
    assert 2 <= refused.sum() <= 10


@pytest.mark.parametrize("lost_at", [43, 45, 47, 57, 59])
def test_a_joint_that_turned_round_or_set_off_while_it_was_away_is_believed_at_once(lost_at: int) -> None:
    positions = np.repeat(waving(1), 90, axis=0)
    angle = np.sin(2 * np.pi * 1.5 * np.arange(50) / 30)  # the wrist is half a metre from the shoulder
    arm = positions[40:, ARM] - positions[40:, [ARM[0]]]
    turns = Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    positions[40:, ARM] = positions[40:, [ARM[0]]] + arm @ turns.swapaxes(1, 2)
    positions[lost_at : lost_at + 6, WRIST] = np.nan
    passed, counters = run(positions)
    assert np.array_equal(passed, positions, equal_nan=True)
    assert not counters


def test_exchanged_legs_are_put_back() -> None:
    positions = waving(90)
    legs = [J[f"{s}_{j}"] for s in ("left", "right") for j in ("knee", "ankle", "foot")]
    positions[30:90, [J["left_knee"], J["left_ankle"], J["left_foot"]], 0] += np.linspace(0, 0.3, 60)[:, None]
    swapped = positions.copy()
    swapped[60:66, legs] = positions[60:66][:, MIRROR[legs]]
    passed, counters = run(swapped)
    assert counters["limbs_exchanged"] == 6
    assert np.allclose(passed, positions)


def test_a_body_whose_first_frame_is_exchanged_like_every_tenth_is_right_within_half_a_second() -> None:
    positions = noisy(90, 0.01)
    seen = positions.copy()
    seen[::10] = positions[::10][:, MIRROR]
    passed, _ = run(seen)
    limbs = [J[f"{side}_{name}"] for side in ("left", "right") for name in ("wrist", "ankle")]
    apart = np.linalg.norm(passed - positions, axis=-1)[:, limbs]
    assert np.nanmax(apart[5]) > 0.2, "nothing tells yet which is right"
    assert np.nanmax(apart[15:]) < 1e-9


def test_shoulders_that_are_exchanged_with_the_arms_are_put_back_too() -> None:
    positions = noisy(90, 0.01)
    arms = [J[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist") for side in ("left", "right")]
    spoilt = positions.copy()
    spoilt[50:53, arms] = positions[50:53][:, MIRROR[arms]]
    passed, counters = run(spoilt)
    assert np.array_equal(passed, positions)
    assert counters == {"limbs_exchanged": 3}


@pytest.mark.parametrize("bad", [1, 3])
def test_a_body_that_jumps_for_a_few_frames_is_refused_in_these(bad: int) -> None:
    positions = noisy(90, 0.01)
    positions[50 : 50 + bad] += [1.0, 0, 0]
    passed, counters = run(positions)
    assert np.isnan(passed[50 : 50 + bad]).all()
    assert np.array_equal(
        np.delete(passed, np.s_[50 : 50 + bad], axis=0), np.delete(positions, np.s_[50 : 50 + bad], axis=0)
    )
    assert counters == {"joints_refused": 22 * bad}


def test_a_body_that_jumped_for_good_is_believed_soon_and_after_a_gap_at_once() -> None:
    positions = noisy(90, 0.01)
    positions[50:] += [1.0, 0, 0]
    refused = np.isnan(run(positions)[0]).all(axis=(1, 2))
    assert np.flatnonzero(refused).tolist() == [50, 51, 52, 53, 54, 55]
    positions[45:50] = np.nan
    assert np.array_equal(run(positions)[0], positions, equal_nan=True)


def test_frames_interpolated_from_a_bad_one_are_refused_too() -> None:
    positions = noisy(90, 0.01)
    positions[50:53] += np.array([0.6, 0.9, 0.3])[:, None, None] * [1.0, 0, 0]
    passed, _ = run(positions)
    assert (np.isnan(passed[50:53, :, 0]).mean(axis=1) > 0.5).all()
    assert np.array_equal(passed[53:], positions[53:])


def test_a_refused_body_says_nothing_of_the_sensors_noise() -> None:
    positions = noisy(60, 0.01)
    positions[50] += [1.0, 0, 0]
    gate = Gate(GateSettings(), 1, Counter())
    jitter = [gate.update(observation(frame[None], k / 30)).jitter[0] for k, frame in enumerate(positions)]
    assert jitter[50] == jitter[49]


def test_low_confidence_is_not_seen() -> None:
    confidence = np.ones((1, 22))
    confidence[0, KNEE] = 0.05
    gate = Gate(GateSettings(), 1, Counter())
    passed = gate.update(observation(waving(1), confidence=confidence)).positions[0]
    assert np.isnan(passed[KNEE]).all()
    assert np.isfinite(passed[WRIST]).all()


def test_switched_off_everything_passes() -> None:
    positions = noisy(90, 0.01)
    positions[50, WRIST] += [0.5, 0, 0]
    passed, counters = run(positions, enabled=False)
    assert np.array_equal(passed, positions)
    assert not counters


def test_a_joint_that_is_frozen_becomes_unobserved() -> None:
    positions = noisy(90, 0.01)
    positions[40:70, WRIST] = positions[39, WRIST]
    passed, counters = run(positions)
    assert np.isnan(passed[47:70, WRIST]).all()
    assert np.isfinite(np.delete(passed, WRIST, axis=1)).all()
    assert np.isfinite(passed[-10:]).all()
    assert counters["joints_stuck"] >= 23
