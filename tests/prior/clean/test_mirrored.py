from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving
from tests.helpers.values import clean_bodies, observation

from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.gate import Gate
from steadypose.prior.clean.mirrored import FIRST, IN_A_ROW, LONGEST, REMEMBERED
from steadypose.prior.clean.settings import GateSettings

ARM, LEG = ([J[f"left_{name}"] for name in chain] for chain in (("elbow", "wrist"), ("knee", "ankle", "foot")))
ROOT = {ARM[0]: J["left_shoulder"], LEG[0]: J["left_hip"]}
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


def run(positions: np.ndarray, gate: Gate | None = None, start: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What passes of one body (T, 22, 3), and which joints (T, 22) count as faulty."""
    gate = gate or Gate(GateSettings(), 1, Counter())
    answers = [gate.update(observation(frame[None], (start + k) / 30)) for k, frame in enumerate(positions)]
    return np.array([answer.positions[0] for answer in answers]), np.array([answer.faulty[0] for answer in answers])


@pytest.mark.parametrize("limb", [ARM, LEG])
def test_a_mirrored_limb_is_mirrored_back_from_its_onset_to_its_end(limb: list[int]) -> None:
    truth = seen(90)
    spoilt = mirrored(truth, limb, slice(40, 70))
    assert np.linalg.norm(spoilt[40:70] - truth[40:70], axis=-1).max(axis=1).min() > 0.15
    passed, faulty = run(spoilt)
    np.testing.assert_allclose(passed, truth, atol=1e-9)
    expected = np.zeros((90, 22), dtype=bool)
    expected[40:70, limb] = True
    np.testing.assert_array_equal(faulty, expected)


def test_it_is_flagged_while_it_lasts_and_published_where_it_is() -> None:
    truth = seen(120)
    calm, spoilt = clean_bodies(truth), clean_bodies(mirrored(truth, ARM, slice(50, 80)))
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
    truth[:, ARM] = shoulder + (truth[:, ARM] - shoulder) @ turns.swapaxes(1, 2)
    assert np.linalg.norm(np.ptp(truth[:, ARM[1]], axis=0)) > 0.5
    passed, faulty = run(truth)
    np.testing.assert_array_equal(passed, truth)
    assert not faulty.any()


@pytest.mark.parametrize("shift", [0.4, -0.7])
@pytest.mark.parametrize("frames", [slice(40, 41), slice(40, 90)])
def test_a_body_that_jumps_along_the_ray_has_no_limb_mirrored(shift: float, frames: slice) -> None:
    moved = seen(90)
    moved[frames] *= 1.0 + shift / np.linalg.norm(moved[40, 0])
    assert not run(moved)[1].any()


@pytest.mark.parametrize("sigma", [0.01, 0.02, 0.04])
def test_noise_is_no_onset(sigma: float) -> None:
    assert not run(seen(600, sigma))[1].any()


def test_joints_relative_to_the_body_have_no_ray() -> None:
    truth = seen(90)
    spoilt = mirrored(truth, ARM, slice(40, 70))
    relative = spoilt - spoilt[:, :1]
    passed, faulty = run(relative)
    assert not faulty[:, ARM].any()
    np.testing.assert_array_equal(passed[60, ARM], relative[60, ARM])


def test_it_is_given_up_after_a_while_and_the_end_is_then_no_onset() -> None:
    truth = seen(40 + LONGEST + 150)
    spoilt = mirrored(truth, LEG, slice(40, 40 + LONGEST + 60))
    passed, faulty = run(spoilt)
    assert np.flatnonzero(faulty.any(axis=1)).tolist() == list(range(40, 40 + LONGEST))
    np.testing.assert_array_equal(passed[40 + LONGEST :], spoilt[40 + LONGEST :])


@pytest.mark.parametrize(("later", "repaired"), [(REMEMBERED - 20, False), (REMEMBERED + 20, True)])
def test_that_it_was_given_up_is_remembered_for_a_while(later: int, repaired: bool) -> None:
    end = 40 + LONGEST
    gate = Gate(GateSettings(), 1, Counter())
    truth = np.repeat(waving(1), end + later + 10, axis=0) + BEFORE_CAMERA
    spoilt = mirrored(truth, LEG, slice(40, end + later))
    run(spoilt[: end + later], gate)
    assert run(spoilt[end + later :], gate, end + later)[1].any() == repaired


def test_a_limb_of_which_a_joint_is_hidden_later_stays_mirrored_back() -> None:
    truth = seen(90)
    spoilt = mirrored(truth, LEG, slice(40, 70))
    spoilt[50:60, LEG[1]] = np.nan
    passed, _ = run(spoilt)
    np.testing.assert_allclose(passed[:, [LEG[0], LEG[2]]], truth[:, [LEG[0], LEG[2]]], atol=1e-9)
    assert np.isnan(passed[50:60, LEG[1]]).all()


def test_a_single_joint_shows_no_onset_and_neither_do_the_first_frames() -> None:
    truth = seen(90)
    alone = mirrored(truth, ARM, slice(40, 70))
    alone[:, ARM[0]] = np.nan
    assert not run(alone)[1].any()
    assert not run(mirrored(truth, LEG, slice(FIRST - 2, 70)))[1][:60].any()
    assert run(mirrored(truth, LEG, slice(FIRST + IN_A_ROW + 1, 40)))[1][FIRST + IN_A_ROW + 1 : 40, LEG].all()


def test_a_forgotten_body_is_not_mirrored_on() -> None:
    spoilt = mirrored(seen(90), LEG, slice(40, 90))
    gate = Gate(GateSettings(), 1, Counter())
    assert run(spoilt[:50], gate)[1][-1].any()
    gate.forget(np.ones(1, dtype=bool))
    assert not run(spoilt[50:], gate, 50)[1].any()


@pytest.mark.parametrize("limb", [ARM, LEG])
@pytest.mark.parametrize("frames", [1, 3, 8])
def test_a_limb_that_was_hidden_is_believed_wherever_it_comes_back(limb: list[int], frames: int) -> None:
    truth = mirrored(seen(90), limb, slice(40 + frames, 90))  # it has moved there
    truth[40 : 40 + frames, limb] = np.nan
    passed, faulty = run(truth)
    assert not faulty.any()
    np.testing.assert_array_equal(passed[40 + frames + 9 :], truth[40 + frames + 9 :])  # a jump may be refused at first


@pytest.mark.parametrize(("frames", "mirrored_back"), [(2, True), (3, False)])
def test_a_fault_ends_where_its_limb_is_hidden_for_three_frames(frames: int, mirrored_back: bool) -> None:
    truth = seen(120)
    spoilt = mirrored(truth, LEG, slice(40, 60))
    spoilt[50 : 50 + frames, LEG] = np.nan
    _, faulty = run(spoilt)
    assert faulty[49, LEG].all()
    assert faulty[58, LEG].all() == mirrored_back
    assert not faulty[60:].any(), "its end is no onset"
