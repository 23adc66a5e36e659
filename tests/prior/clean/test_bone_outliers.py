import numpy as np
import pytest
from tests.helpers.bodies import waving

from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.bone_outliers import BoneOutliers

SHOULDER, ELBOW, WRIST = (J[f"left_{name}"] for name in ("shoulder", "elbow", "wrist"))
LEG = [J[f"right_{name}"] for name in ("knee", "ankle", "foot")]


def judged(positions: np.ndarray) -> np.ndarray:
    """(T, 22) of a body's frames (T, 22, 3)."""
    outliers = BoneOutliers(1)
    return np.array([outliers.update(frame[None])[0] for frame in positions])


def noisy(frames: int = 150, sigma: float = 0.005, speed: float = 1.0) -> np.ndarray:
    return waving(frames, speed=speed) + np.random.default_rng(0).normal(scale=sigma, size=(frames, 22, 3))


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.04, 0.1])
@pytest.mark.parametrize("speed", [0.0, 1.0, 4.0])
def test_bones_as_long_as_ever_are_not_judged_whatever_the_noise_and_the_motion(sigma: float, speed: float) -> None:
    assert not judged(noisy(sigma=sigma, speed=speed)).any()


def test_a_wrist_that_collapses_onto_the_elbow_is_found_at_once_and_alone() -> None:
    positions = noisy()
    positions[60:80, WRIST] = positions[60:80, ELBOW] + 0.02
    found = judged(positions)
    assert found[60:80, WRIST].all()
    assert found.sum() == 20


def test_what_hangs_from_a_joint_thrown_aside_goes_with_it() -> None:
    positions = noisy()
    positions[60, LEG] += [0.0, 0.5, 0.0]
    assert set(np.flatnonzero(judged(positions)[60])) == set(LEG)


def test_of_two_bad_bones_the_joint_between_is_wrong() -> None:
    positions = noisy()
    positions[60, ELBOW] += [0.0, 0.5, 0.0]
    assert list(np.flatnonzero(judged(positions)[60])) == [ELBOW]


def test_when_most_bones_change_it_is_another_body() -> None:
    positions = noisy()
    positions[60:] = 2.0 * positions[60:]
    assert not judged(positions).any()


def test_a_bone_that_stays_as_it_is_is_believed_within_two_seconds() -> None:
    positions = noisy(200)
    positions[60:, WRIST] = positions[60:, ELBOW] + 0.02
    found = judged(positions)[:, WRIST]
    assert found[60:70].all()
    assert not found[120:].any()


def test_joints_unseen_and_bodies_forgotten_are_not_judged() -> None:
    positions = noisy(60)
    positions[30:40, ELBOW] = np.nan
    outliers = BoneOutliers(2)
    for frame in positions:
        assert not outliers.update(np.stack([frame, frame])).any()
    outliers.forget(np.array([True, False]))
    collapsed = positions[-1].copy()
    collapsed[WRIST] = collapsed[ELBOW]
    assert list(outliers.update(np.stack([collapsed, collapsed]))[:, WRIST]) == [False, True]
