from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from steadypose.prior.body.capsules import TOE_HEIGHT, random_offsets, stature
from steadypose.prior.body.kinematics import CONTACT_JOINTS, label_contacts
from steadypose.prior.body.skeleton import MIRROR, PARENTS, REST_OFFSETS, J
from steadypose.prior.sim.gait import RATE, Stand, Walk, plan
from steadypose.prior.sim.motion import Intent, Motion, perform, two_bone
from steadypose.prior.sim.scripts import SCRIPTS

SEED = 5
FEET = list(CONTACT_JOINTS[2:6])


@cache
def played(script: str) -> list[Motion]:
    return SCRIPTS[script](np.random.default_rng(SEED))


@cache
def straight_walk() -> Motion:
    path = plan((0.0, 0.0), 0.0, [Stand(0.3), Walk([(3.0, 0.0), (7.0, 0.0)], 1.15), Stand(0.3)])
    return perform(Intent(path), REST_OFFSETS, np.random.default_rng(0))


@pytest.mark.parametrize("script", SCRIPTS)
def test_planted_feet_do_not_move(script: str) -> None:
    for motion in played(script):
        feet, planted = motion.positions[:, FEET], motion.contacts[:, 2:6]
        moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1)
        assert moved[planted[1:] & planted[:-1]].max() < 1e-9
        assert planted.any(axis=1).all(), "no script leaves the ground"


@pytest.mark.parametrize("script", SCRIPTS)
def test_bones_keep_their_lengths(script: str) -> None:
    for motion in played(script):
        bones = motion.positions[:, 1:] - motion.positions[:, list(PARENTS[1:])]
        lengths = np.linalg.norm(bones, axis=-1)
        np.testing.assert_allclose(lengths, np.broadcast_to(np.linalg.norm(motion.offsets[1:], axis=-1), lengths.shape))


@pytest.mark.parametrize("script", SCRIPTS)
def test_nothing_jerks_and_nothing_sinks(script: str) -> None:
    for motion in played(script):
        velocity = np.diff(motion.positions, axis=0) * RATE
        assert np.linalg.norm(velocity, axis=-1).max() < 7.0
        assert np.linalg.norm(np.diff(velocity, axis=0), axis=-1).max() < 1.0, "m/s from frame to frame at 120 Hz"
        assert motion.positions[..., 2].min() > TOE_HEIGHT - 1e-6


@pytest.mark.parametrize("script", SCRIPTS)
def test_contacts_are_those_that_motion_shows(script: str) -> None:
    for motion in played(script):
        labelled = label_contacts(motion.positions[::4], RATE / 4)
        assert (labelled == motion.contacts[::4])[:, 2:6].mean() > 0.88


def test_a_walk_has_the_measures_of_a_walk() -> None:
    motion = straight_walk()
    heel, toe = motion.contacts[:, 2], motion.contacts[:, 4]
    strikes = np.flatnonzero(np.diff(heel.astype(int)) == 1)
    strides = np.diff(motion.positions[strikes, J["left_ankle"], 0])[1:-1]
    rhythm = np.diff(motion.times[strikes])[1:-1]
    stance = (heel | toe)[strikes[1] : strikes[-2]].mean()
    assert 1.1 < strides.mean() < 1.5
    assert 0.95 < rhythm.mean() < 1.25
    assert 0.55 < stance < 0.65
    cruising = slice(strikes[1], strikes[-2])
    bob = np.ptp(motion.root[cruising, 2])
    assert 0.015 < bob < 0.07
    assert np.ptp(motion.root[cruising, 1]) < 0.08


def test_knees_bend_as_knees_do() -> None:
    for motion in (straight_walk(), *played("sit_rise")):
        for side in ("left", "right"):
            # Flexion is a turn about the leg's own y axis, never backwards and never folded flat.
            bend = motion.rotations[:, J[f"{side}_knee"]]
            angle = np.degrees(np.arctan2(bend[:, 0, 2] - bend[:, 2, 0], bend[:, 0, 0] + bend[:, 2, 2]))
            assert angle.min() > 0.0
            assert angle.max() < 130.0


def test_sitting_is_on_the_chair() -> None:
    (motion,) = played("sit_rise")
    hips = motion.positions[:, [J["left_hip"], J["right_hip"]], 2].mean(axis=1)
    assert 0.45 < hips.min() < 0.65
    knees = motion.positions[hips.argmin(), J["left_knee"], 2]
    assert abs(knees - hips.min()) < 0.15, "thighs are about level"


def test_between_frames_bones_keep_their_lengths_too() -> None:
    (motion,) = played("idle")
    between = motion.at(np.array([1.003, 4.5071, 9.9999]))
    lengths = np.linalg.norm(between.positions[:, 1:] - between.positions[:, list(PARENTS[1:])], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(np.linalg.norm(motion.offsets[1:], axis=-1), lengths.shape))
    with pytest.raises(ValueError, match="leave the motion"):
        motion.at(np.array([motion.times[-1] + 1.0]))


@given(st.integers(0, 2**32 - 1), st.floats(1.5, 2.0))
def test_random_bodies_have_the_height_asked_for_and_two_equal_sides(seed: int, height: float) -> None:
    offsets = random_offsets(np.random.default_rng(seed), height)
    assert stature(offsets) == pytest.approx(height)
    np.testing.assert_allclose(offsets[MIRROR] * [1, -1, 1], offsets, atol=1e-12)


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(directions, st.floats(0.2, 0.98), directions)
def test_two_bones_reach_their_goal(direction: tuple[float, ...], share: float, pole: tuple[float, ...]) -> None:
    lengths = np.array([0.3, 0.25])
    goal = np.array([direction]) / np.linalg.norm(direction) * share * lengths.sum()
    if np.linalg.norm(np.cross(goal[0], pole)) < 1e-3:
        return  # a pole along the limb points nowhere
    first, second, hinge = two_bone(np.zeros((1, 3)), goal, np.array([pole]), lengths)
    np.testing.assert_allclose(lengths[0] * first + lengths[1] * second, goal, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(first), 1.0)
    assert float((hinge * goal).sum()) == pytest.approx(0.0, abs=1e-9)
    across = np.array(pole) - goal[0] * (goal[0] @ pole) / (goal[0] @ goal[0])
    assert first[0] @ across >= -1e-9, "the middle joint lies on the pole's side"
