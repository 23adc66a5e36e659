from collections import Counter
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import clean_bodies, observation

from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.body.skeleton import MIRROR, J, limbs
from steadypose.prior.clean.exchanged import ExchangedLimbs
from steadypose.prior.clean.gate import Gate
from steadypose.prior.clean.mirrored import FIRST, IN_A_ROW, LONGEST, REMEMBERED
from steadypose.prior.clean.settings import GateSettings

WRIST, KNEE = J["left_wrist"], J["right_knee"]
ARM = [J[f"left_{name}"] for name in ("shoulder", "elbow", "wrist")]


def limbs_of(*parts: str) -> list[int]:
    return [joint for limb in limbs(parts) for joint in limb]


def run(positions: np.ndarray, **settings) -> tuple[np.ndarray, Counter[str]]:
    counters: Counter[str] = Counter()
    gate = Gate(GateSettings(**settings), 1, counters)
    passed = [gate.update(observation(frame[None], k / 30)).positions[0] for k, frame in enumerate(positions)]
    return np.array(passed), counters


def struck(frames: int = 90) -> np.ndarray:
    """Somebody whose forearm turns over by two radians in one frame and back, about an elbow that rests."""
    positions = np.repeat(waving(1), frames, axis=0)
    turn = Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()
    positions[50, WRIST] = positions[50, ARM[1]] + turn @ (positions[50, WRIST] - positions[50, ARM[1]])
    return positions


def crossed() -> np.ndarray:
    """Legs wide apart, the head far back, and then left and right legs exchanged: a misfit of 54 when swapped back."""
    positions = noisy(30, 0.01)
    positions[:, J["head"], 0] -= 0.2
    left, right = limbs(("knee", "ankle", "foot"))
    positions[:, left, 1] += 0.4
    positions[:, right, 1] -= 0.4
    positions[:, (*left, *right)] = positions[:, (*right, *left)]
    return positions


@pytest.mark.parametrize(
    ("positions", "enabled"),
    [
        (noisy(90, 0.01), True),
        (crossed(), True),
        (struck(), True),
        (noisy(90, 0.01) + np.repeat([0.0, 1.0], 45)[:, None, None], False),
    ],
    ids=["ordinary", "crossed legs", "a perfect sensor's joint that kept its bones", "switched off"],
)
def test_what_may_be_passes_untouched_and_everything_where_it_is_switched_off(positions: np.ndarray, enabled: bool):
    passed, counters = run(positions, enabled=enabled)
    assert np.array_equal(passed, positions)
    assert not counters


@pytest.mark.parametrize(("joints", "by", "frames"), [([WRIST], 0.3, 1), (range(22), 1.0, 1), (range(22), 1.0, 3)])
def test_what_jumps_for_a_few_frames_is_refused_in_these_alone(joints: Sequence[int], by: float, frames: int) -> None:
    positions = noisy(90, 0.01)
    jumps = np.zeros((90, 22), dtype=bool)
    jumps[50 : 50 + frames, joints] = True
    positions[jumps] += [by, 0, 0]
    passed, counters = run(positions)
    assert np.array_equal(passed, np.where(jumps[..., None], np.nan, positions), equal_nan=True)
    assert counters == {"joints_refused": jumps.sum()}


def test_of_a_sensor_whose_bones_vary_their_lengths_excuse_nothing() -> None:
    positions = struck()
    assert np.linalg.norm(positions[50, WRIST] - positions[49, WRIST]) > 0.2
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


SIDES = {
    "whole": MIRROR,
    "arms": [MIRROR[j] if j in limbs_of("elbow", "wrist") else j for j in range(22)],
    "legs": [MIRROR[j] if j in limbs_of("knee", "ankle", "foot") else j for j in range(22)],
    "legs and hips": [MIRROR[j] if j in limbs_of("hip", "knee", "ankle", "foot") else j for j in range(22)],
}


@pytest.mark.parametrize("order", SIDES.values(), ids=SIDES)
@pytest.mark.parametrize(
    "exchanged", [slice(0, 1), slice(0, 20), slice(0, None, 10), slice(30, 33), slice(30, 80)], ids=str
)
@pytest.mark.parametrize("layout", ["smpl22", "kinect22", "coco17"])
def test_exchanged_sides_are_put_back_from_the_first_frame_on_and_for_seconds(
    order: list[int], exchanged: slice, layout: str
) -> None:
    positions = noisy(90, 0.01)
    positions[:, ~SKELETONS[layout].observable] = np.nan
    seen = positions.copy()
    seen[exchanged] = positions[exchanged][:, order]
    passed, _ = run(seen)
    assert np.array_equal(passed, positions, equal_nan=True)


def test_sides_are_put_back_while_a_joint_is_hidden() -> None:
    positions = noisy(90, 0.01)
    positions[40:60, WRIST] = np.nan
    seen = positions.copy()
    seen[30:80] = positions[30:80][:, MIRROR]
    passed, _ = run(seen)
    assert np.array_equal(passed, positions, equal_nan=True)


def test_sides_of_a_body_whose_first_frame_is_no_posture_are_put_back_from_the_next_on() -> None:
    positions = noisy(90, 0.01)
    seen = positions.copy()
    seen[:20] = positions[:20][:, MIRROR]
    seen[0] += np.random.default_rng(3).normal(0.0, 0.15, (22, 3))
    passed, _ = run(seen)
    assert np.array_equal(passed[0], seen[0])
    assert np.array_equal(passed[20:], positions[20:])
    limbs = limbs_of("knee", "ankle", "elbow", "wrist")
    assert np.nanmax(np.linalg.norm(passed[1:] - positions[1:], axis=-1)[:, limbs]) < 1e-9


@pytest.mark.parametrize(("order", "exchanged"), [("arms", slice(30, 80)), ("whole", slice(54, 58))])
def test_arms_that_meet_while_they_are_exchanged_are_put_back_too(order: str, exchanged: slice) -> None:
    positions = noisy(90, 0.002)
    apart = np.interp(np.arange(90), [30, 50, 60, 80], [1.0, 0.15, 0.15, 1.0])
    arms = limbs_of("elbow", "wrist")
    middle = 0.5 * (positions[:, arms] + positions[:, MIRROR[arms]])
    positions[:, arms] = middle + apart[:, None, None] * (positions[:, arms] - middle)
    seen = positions.copy()
    seen[exchanged] = positions[exchanged][:, SIDES[order]]
    passed, _ = run(seen)
    assert np.array_equal(passed, positions)


def test_a_body_that_faces_the_other_way_all_at_once_is_believed_before_long() -> None:
    """An estimator that takes somebody's back for the front exchanges sides too, but what it says is a posture."""
    positions = noisy(90, 0.01)
    middle = positions[:, [J["pelvis"]]]
    positions[40:] = (middle + (positions - middle) * [-1.0, -1.0, 1.0])[40:]
    passed, counters = run(positions)
    assert counters["limbs_exchanged"]
    assert np.array_equal(passed[55:], positions[55:])


def test_in_noise_that_hides_the_posture_no_first_frame_is_exchanged() -> None:
    noise = np.random.default_rng(0).normal(0.0, [0.04, 0.12, 0.04], (300, 22, 3))
    seen = waving(300) + noise
    assert not ExchangedLimbs(0.3, 300).begin(seen).any()


def test_a_body_that_jumped_for_good_is_believed_soon_and_after_a_gap_at_once() -> None:
    positions = noisy(90, 0.01)
    positions[50:] += [1.0, 0, 0]
    refused = np.isnan(run(positions)[0]).all(axis=(1, 2))
    assert np.flatnonzero(refused).tolist() == [50, 51, 52, 53, 54, 55]
    positions[45:50] = np.nan
    assert np.array_equal(run(positions)[0], positions, equal_nan=True)


def test_shoulders_that_are_exchanged_with_the_arms_are_put_back_too() -> None:
    positions = noisy(90, 0.01)
    arms = limbs_of("shoulder", "elbow", "wrist")
    spoilt = positions.copy()
    spoilt[50:53, arms] = positions[50:53][:, MIRROR[arms]]
    passed, counters = run(spoilt)
    assert np.array_equal(passed, positions)
    assert counters == {"limbs_exchanged": 3}


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


def test_a_joint_that_is_frozen_becomes_unobserved() -> None:
    positions = noisy(90, 0.01)
    positions[40:70, WRIST] = positions[39, WRIST]
    passed, counters = run(positions)
    assert np.isnan(passed[47:70, WRIST]).all()
    assert np.isfinite(np.delete(passed, WRIST, axis=1)).all()
    assert np.isfinite(passed[-10:]).all()
    assert counters["joints_stuck"] >= 23


FOREARM, LEG = ([J[f"left_{name}"] for name in chain] for chain in (("elbow", "wrist"), ("knee", "ankle", "foot")))
ROOT = {FOREARM[0]: J["left_shoulder"], LEG[0]: J["left_hip"]}
BEFORE_CAMERA = np.array([-2.2, -2.2, -1.0])


def seen(frames: int, sigma: float = 0.005) -> np.ndarray:
    """Somebody who waves, three metres from a camera at the origin, which is at the height of the hips."""
    return waving(frames) + BEFORE_CAMERA + np.random.default_rng(0).normal(size=(frames, 22, 3)) * sigma


def mirrored(positions: np.ndarray, limb: list[int], frames: slice) -> np.ndarray:
    """The limb's depth relative to its root negated, along the ray from the origin to the root."""
    out, root = positions.copy(), positions[frames, None, ROOT[limb[0]]]
    ray = root / np.linalg.norm(root, axis=-1, keepdims=True)
    out[frames, limb] -= 2 * ((positions[frames, limb] - root) * ray).sum(axis=-1, keepdims=True) * ray
    return out


def judged(positions: np.ndarray, gate: Gate | None = None, start: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What passes of one body (T, 22, 3), and which joints (T, 22) count as faulty."""
    gate = gate or Gate(GateSettings(), 1, Counter())
    answers = [gate.update(observation(frame[None], (start + k) / 30)) for k, frame in enumerate(positions)]
    return np.array([answer.positions[0] for answer in answers]), np.array([answer.faulty[0] for answer in answers])


@pytest.mark.parametrize("limb", [FOREARM, LEG])
def test_a_mirrored_limb_is_mirrored_back_from_its_onset_to_its_end(limb: list[int]) -> None:
    truth = seen(90)
    spoilt = mirrored(truth, limb, slice(40, 70))
    assert np.linalg.norm(spoilt[40:70] - truth[40:70], axis=-1).max(axis=1).min() > 0.15
    passed, faulty = judged(spoilt)
    np.testing.assert_allclose(passed, truth, atol=1e-9)
    expected = np.zeros((90, 22), dtype=bool)
    expected[40:70, limb] = True
    np.testing.assert_array_equal(faulty, expected)


def test_it_is_flagged_while_it_lasts_and_published_where_it_is() -> None:
    truth = seen(120)
    calm, spoilt = clean_bodies(truth), clean_bodies(mirrored(truth, FOREARM, slice(50, 80)))
    assert not any(body.anomaly_flag for body in calm)
    assert all(body.anomaly_flag for body in spoilt[50:76])
    off = [np.linalg.norm(a.positions - b.positions, axis=-1).max() for a, b in zip(calm, spoilt, strict=True)]
    assert max(off) < 0.01


@pytest.mark.parametrize("frames", [5, 8, 15])
@pytest.mark.parametrize("toward", [-1.0, 1.0])
def test_an_arm_that_moves_to_the_camera_and_back_is_believed(frames: int, toward: float) -> None:
    truth = np.repeat(waving(1), 90, axis=0) + BEFORE_CAMERA
    progress = np.clip((np.arange(90) - 40) / frames, 0.0, 1.0)
    angle = toward * 0.7 * np.pi * 0.5 * (1 - np.cos(np.pi * progress))
    shoulder = truth[:, None, J["left_shoulder"]]
    turns = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    truth[:, FOREARM] = shoulder + (truth[:, FOREARM] - shoulder) @ turns.swapaxes(1, 2)
    assert np.linalg.norm(np.ptp(truth[:, FOREARM[1]], axis=0)) > 0.5
    passed, faulty = judged(truth)
    np.testing.assert_array_equal(passed, truth)
    assert not faulty.any()


@pytest.mark.parametrize("shift", [0.4, -0.7])
@pytest.mark.parametrize("frames", [slice(40, 41), slice(40, 90)])
def test_a_body_that_jumps_along_the_ray_has_no_limb_mirrored(shift: float, frames: slice) -> None:
    moved = seen(90)
    moved[frames] *= 1.0 + shift / np.linalg.norm(moved[40, 0])
    assert not judged(moved)[1].any()


@pytest.mark.parametrize("sigma", [0.01, 0.02, 0.04])
def test_noise_is_no_onset(sigma: float) -> None:
    assert not judged(seen(600, sigma))[1].any()


def test_joints_relative_to_the_body_have_no_ray() -> None:
    truth = seen(90)
    spoilt = mirrored(truth, FOREARM, slice(40, 70))
    relative = spoilt - spoilt[:, :1]
    passed, faulty = judged(relative)
    assert not faulty[:, FOREARM].any()
    np.testing.assert_array_equal(passed[60, FOREARM], relative[60, FOREARM])


def test_it_is_given_up_after_a_while_and_the_end_is_then_no_onset() -> None:
    truth = seen(40 + LONGEST + 150)
    spoilt = mirrored(truth, LEG, slice(40, 40 + LONGEST + 60))
    passed, faulty = judged(spoilt)
    assert np.flatnonzero(faulty.any(axis=1)).tolist() == list(range(40, 40 + LONGEST))
    np.testing.assert_array_equal(passed[40 + LONGEST :], spoilt[40 + LONGEST :])


@pytest.mark.parametrize(("later", "repaired"), [(REMEMBERED - 20, False), (REMEMBERED + 20, True)])
def test_that_it_was_given_up_is_remembered_for_a_while(later: int, repaired: bool) -> None:
    end = 40 + LONGEST
    gate = Gate(GateSettings(), 1, Counter())
    truth = np.repeat(waving(1), end + later + 10, axis=0) + BEFORE_CAMERA
    spoilt = mirrored(truth, LEG, slice(40, end + later))
    judged(spoilt[: end + later], gate)
    assert judged(spoilt[end + later :], gate, end + later)[1].any() == repaired


def test_a_limb_of_which_a_joint_is_hidden_later_stays_mirrored_back() -> None:
    truth = seen(90)
    spoilt = mirrored(truth, LEG, slice(40, 70))
    spoilt[50:60, LEG[1]] = np.nan
    passed, _ = judged(spoilt)
    np.testing.assert_allclose(passed[:, [LEG[0], LEG[2]]], truth[:, [LEG[0], LEG[2]]], atol=1e-9)
    assert np.isnan(passed[50:60, LEG[1]]).all()


def test_a_single_joint_shows_no_onset_and_neither_do_the_first_frames() -> None:
    truth = seen(90)
    alone = mirrored(truth, FOREARM, slice(40, 70))
    alone[:, FOREARM[0]] = np.nan
    assert not judged(alone)[1].any()
    assert not judged(mirrored(truth, LEG, slice(FIRST - 2, 70)))[1][:60].any()
    assert judged(mirrored(truth, LEG, slice(FIRST + IN_A_ROW + 1, 40)))[1][FIRST + IN_A_ROW + 1 : 40, LEG].all()


def test_a_forgotten_body_is_not_mirrored_on() -> None:
    spoilt = mirrored(seen(90), LEG, slice(40, 90))
    gate = Gate(GateSettings(), 1, Counter())
    assert judged(spoilt[:50], gate)[1][-1].any()
    gate.forget(np.ones(1, dtype=bool))
    assert not judged(spoilt[50:], gate, 50)[1].any()


@pytest.mark.parametrize("limb", [FOREARM, LEG])
@pytest.mark.parametrize("frames", [1, 3, 8])
def test_a_limb_that_was_hidden_is_believed_wherever_it_comes_back(limb: list[int], frames: int) -> None:
    truth = mirrored(seen(90), limb, slice(40 + frames, 90))  # it has moved there
    truth[40 : 40 + frames, limb] = np.nan
    passed, faulty = judged(truth)
    assert not faulty.any()
    np.testing.assert_array_equal(passed[40 + frames + 9 :], truth[40 + frames + 9 :])  # a jump may be refused at first


@pytest.mark.parametrize(("frames", "mirrored_back"), [(2, True), (3, False)])
def test_a_fault_ends_where_its_limb_is_hidden_for_three_frames(frames: int, mirrored_back: bool) -> None:
    truth = seen(120)
    spoilt = mirrored(truth, LEG, slice(40, 60))
    spoilt[50 : 50 + frames, LEG] = np.nan
    _, faulty = judged(spoilt)
    assert faulty[49, LEG].all()
    assert faulty[58, LEG].all() == mirrored_back
    assert not faulty[60:].any(), "its end is no onset"
