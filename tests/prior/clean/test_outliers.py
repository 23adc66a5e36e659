import numpy as np
import pytest
from tests.helpers.bodies import noisy, waving

from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.outliers import RECENT, BoneOutliers, frozen_joints

SHOULDER, ELBOW, WRIST = (J[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
LEG = [J[f"right_{name}"] for name in ("knee", "ankle", "foot")]


def judged(positions: np.ndarray) -> np.ndarray:
    """(T, 22) of a body's frames (T, 22, 3)."""
    outliers = BoneOutliers(1)
    return np.array([outliers.update(frame[None])[0] for frame in positions])


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.04, 0.1])
@pytest.mark.parametrize("speed", [0.0, 1.0, 4.0])
def test_bones_as_long_as_ever_are_not_judged_whatever_the_noise_and_the_motion(sigma: float, speed: float) -> None:
    assert not judged(noisy(150, sigma, speed)).any()


def test_a_wrist_that_collapses_onto_the_elbow_is_found_at_once_and_alone() -> None:
    positions = noisy(150, 0.005)
    positions[60:80, WRIST] = positions[60:80, ELBOW] + 0.02
    found = judged(positions)
    assert found[60:80, WRIST].all()
    assert found.sum() == 20


def test_what_hangs_from_a_joint_thrown_aside_goes_with_it() -> None:
    positions = noisy(150, 0.005)
    positions[60, LEG] += [0.0, 0.5, 0.0]
    assert set(np.flatnonzero(judged(positions)[60])) == set(LEG)


def test_of_two_bad_bones_the_joint_between_is_wrong() -> None:
    positions = noisy(150, 0.005)
    positions[60, ELBOW] += [0.0, 0.5, 0.0]
    assert list(np.flatnonzero(judged(positions)[60])) == [ELBOW]


def test_when_most_bones_change_it_is_another_body() -> None:
    positions = noisy(150, 0.005)
    positions[60:] = 2.0 * positions[60:]
    assert not judged(positions).any()


def test_a_bone_that_stays_as_it_is_is_believed_within_two_seconds() -> None:
    positions = noisy(200, 0.005)
    positions[60:, WRIST] = positions[60:, ELBOW] + 0.02
    found = judged(positions)[:, WRIST]
    assert found[60:70].all()
    assert not found[120:].any()


def test_joints_unseen_and_bodies_forgotten_are_not_judged() -> None:
    positions = noisy(60, 0.005)
    positions[30:40, ELBOW] = np.nan
    outliers = BoneOutliers(2)
    for frame in positions:
        assert not outliers.update(np.stack([frame, frame])).any()
    outliers.forget(np.array([True, False]))
    collapsed = positions[-1].copy()
    collapsed[WRIST] = collapsed[ELBOW]
    assert list(outliers.update(np.stack([collapsed, collapsed]))[:, WRIST]) == [False, True]


def test_a_joint_is_frozen_that_repeats_itself_while_others_shake() -> None:
    rng = np.random.default_rng(0)
    seen = np.stack([waving(50)] * 3)
    seen[:2] += rng.normal(0.0, 0.005, seen[:2].shape)
    seen[:, -RECENT:, J["left_wrist"]] = seen[:, -RECENT - 1, None, J["left_wrist"]]
    seen[1, :, J["neck"]] = np.nan
    found = frozen_joints(seen)
    assert np.flatnonzero(found[0]).tolist() == [J["left_wrist"]]
    assert np.flatnonzero(found[1]).tolist() == [J["left_wrist"]]
    assert not found[2].any()  # without noise, it may be at rest
    seen[0, -RECENT + 5 :, J["left_wrist"]] += rng.random((RECENT - 5, 3))
    assert not frozen_joints(seen)[0].any()


@pytest.mark.parametrize("sigma", [0.0, 0.005])
def test_what_rests_beside_steady_motion_is_frozen_only_if_the_sensor_has_noise(sigma: float) -> None:
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.01, 0.03, (22, 3)) * np.arange(50)[:, None, None] + rng.normal(0.0, sigma, (50, 22, 3))
    seen[:, WRIST] = seen[0, WRIST]
    assert np.flatnonzero(frozen_joints(seen[None])[0]).tolist() == ([WRIST] if sigma else [])


def test_a_foot_at_rest_in_a_fast_body_without_noise_is_not_frozen() -> None:
    seen = 0.3 * np.sin(np.arange(50)[:, None, None] / 30 * np.linspace(4.0, 8.0, 22)[:, None] + [0.0, 1.0, 2.0])
    seen[:, LEG] = seen[0, LEG]
    assert np.linalg.norm(np.diff(seen, 2, axis=0), axis=-1).max() * 30**2 > 10.0
    assert not frozen_joints(seen[None]).any()


@pytest.mark.parametrize("rounds", [False, True])
def test_a_sensor_rounds_whose_joints_repeat_coordinates_in_the_frames_that_have_them(rounds: bool) -> None:
    seen = np.random.default_rng(0).normal(0.0, 0.005, (51, 22, 3))
    seen[::3, :10] = np.nan
    seen[:, WRIST] = seen[0, WRIST]
    if rounds:
        seen[2::3, :10, :2] = seen[1::3, :10, :2]
    assert np.flatnonzero(frozen_joints(seen[None])[0]).tolist() == ([] if rounds else [WRIST])


def test_a_body_that_is_repeated_whole_has_no_joint_frozen() -> None:
    """A camera of 15 Hz on a grid of 30, or one that pauses."""
    rng = np.random.default_rng(0)
    seen = (waving(50) + rng.normal(0.0, 0.005, (50, 22, 3)))[None]
    slower = seen[:, np.arange(50) // 2 * 2]
    assert not frozen_joints(slower).any()
    assert not frozen_joints(np.repeat(seen[:, :1], RECENT + 1, axis=1)).any()
    slower[:, :, WRIST] = slower[:, :1, WRIST]
    assert np.flatnonzero(frozen_joints(slower[0:1, -RECENT - 1 :])[0]).tolist() == [WRIST]


def test_what_a_sensor_rounds_is_not_frozen_while_it_rests() -> None:
    rng = np.random.default_rng(0)
    seen = (waving(50) + rng.normal(0.0, 0.001, (50, 22, 3)))[None]
    seen[:, :, 12:] += 0.02 * rng.standard_normal((1, 50, 10, 3))
    rounded = 0.02 * np.round(seen / 0.02)
    resting = (np.diff(rounded[0, -RECENT:], axis=0) == 0).all(axis=-1).mean(axis=0) > 0.5
    assert resting.any()
    assert not frozen_joints(rounded).any()
    rounded = 0.001 * np.round((seen + 0.005 * rng.standard_normal(seen.shape)) / 0.001)
    rounded[:, -RECENT:, WRIST] = rounded[:, -RECENT - 1, None, WRIST]
    assert np.flatnonzero(frozen_joints(rounded)[0]).tolist() == [WRIST], "by the millimetre, what stays is frozen"
