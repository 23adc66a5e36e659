import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import clean_body

from steadypose.msgs.types import CONTACTS, CleanBody, JointState
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT, yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.models.contacts import Contacts, LiveContacts
from steadypose.prior.models.root_velocity import LiveRootVelocity, NewestMotion
from steadypose.prior.world import observe
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.networks import ContactNetwork, MotionMemory, VelocityNetwork, stance
from steadypose.prior.world.observe import FEET, GUESSED_S, BodyObservation, LegMemory, unit_quaternion

STANDING = REST_POSITIONS - [0.0, 0.0, REST_POSITIONS[:, 2].min() - 0.022]
UNIT = np.array([0.0, 0.0, 0.0, 1.0])
HIPS = [J["left_hip"], J["right_hip"]]


def body(**fields: Any) -> CleanBody:
    return replace(clean_body(STANDING), **fields)


def seen(last: BodyObservation | None = None, after_s: float = 0.0, **fields: Any) -> BodyObservation:
    """The observation of a body by a sensor at the world's origin."""
    before, stamp_ns = ({1: last}, last.stamp_ns) if last else ({}, 0)
    return observe.observe([body(**fields)], round(stamp_ns + after_s * 1e9), UNIT, np.zeros(3), before)[0]


def test_a_body_is_where_the_sensors_pose_puts_it() -> None:
    turn, at = Rotation.from_rotvec([0.1, 0.2, 1.0]), np.array([1.0, 2.0, 3.0])
    own = Rotation.from_rotvec([0.3, -0.1, 0.7])
    rotations = np.tile(UNIT, (22, 1))
    rotations[0] = -3.0 * own.as_quat()  # of any length and sign
    (now,) = observe.observe([body(rotations=rotations)], 5, turn.as_quat(), at, {})
    np.testing.assert_allclose(now.positions, turn.apply(STANDING) + at, atol=1e-6)
    np.testing.assert_allclose(Rotation.from_quat(now.orientation).as_matrix(), (turn * own).as_matrix(), atol=1e-6)
    left = (turn * own).apply([0.0, 1.0, 0.0])
    assert now.yaw == pytest.approx(np.arctan2(-left[0], left[1]))
    assert (now.dt, now.after_gap) == (0.0, True)
    np.testing.assert_array_equal(now.feet, now.positions[list(FEET)])
    np.testing.assert_allclose(now.soles, now.feet - np.outer([0.07, 0.07, 0.022, 0.022], [0.0, 0.0, 1.0]), atol=1e-6)
    assert observe.observe([], 5, UNIT, at, {}) == []


def test_a_root_without_a_rotation_keeps_its_last() -> None:
    rotations = np.tile(UNIT, (22, 1))
    rotations[0] = [0.0, 0.0, 0.6, 0.8]
    first = seen(rotations=rotations)
    for none in (np.zeros(4), np.full(4, np.nan), np.full(4, 4e-7)):
        rotations = np.tile(none, (22, 1))
        np.testing.assert_allclose(seen(first, 0.1, rotations=rotations).orientation, [0.0, 0.0, 0.6, 0.8])
        np.testing.assert_array_equal(seen(rotations=rotations).orientation, UNIT)
        assert unit_quaternion(none) is None
    assert unit_quaternion(np.array([0.0, 0.0, 3.0, 4.0])) == pytest.approx([0.0, 0.0, 0.6, 0.8])


@pytest.mark.parametrize(("after_s", "gap"), [(0.1, False), (0.299, False), (0.301, True)])
def test_a_body_that_was_away_for_more_than_three_tenths_of_a_second_begins_anew(after_s: float, gap: bool) -> None:
    now = seen(seen(), after_s)
    assert now.dt == pytest.approx(after_s)
    assert now.after_gap == gap


def test_joints_out_of_reach_or_not_finite_or_unknown_are_not_known() -> None:
    positions, state = STANDING.copy(), np.full(22, JointState.SEEN)
    positions[J["left_wrist"]] = positions[0] + [0.0, 2.01, 0.0]
    positions[J["right_wrist"]] = positions[0] + [0.0, 1.99, 0.0]
    positions[J["head"], 1] = np.inf
    state[J["neck"]] = JointState.UNKNOWN
    state[J["left_knee"]], state[J["right_knee"]] = JointState.IMPUTED, JointState.REFINED
    now = seen(positions=positions, state=state)
    lost = [J["left_wrist"], J["head"], J["neck"]]
    assert sorted(np.flatnonzero(np.isnan(now.positions).any(axis=1))) == sorted(lost)
    assert sorted(np.flatnonzero(~now.observed)) == sorted([*lost, J["left_knee"]])
    assert now.root_known


def test_deviations_are_at_least_a_millimetre_and_infinite_where_there_is_none() -> None:
    sigma = np.full(22, 0.01)
    sigma[1:5] = [0.0005, -1.0, np.nan, np.inf]
    np.testing.assert_allclose(seen(sigma=sigma).sigma[:6], [0.01, 0.001, np.inf, np.inf, np.inf, 0.01], rtol=1e-6)


def test_a_root_is_as_sure_as_the_pelvis_and_less_so_if_it_is_inferred() -> None:
    def root(hidden: list[int], **fields: Any) -> BodyObservation:
        state = np.full(22, JointState.SEEN)
        state[hidden] = JointState.IMPUTED
        return seen(state=state, **fields)

    assert root([0, HIPS[0]]).root_sigma == pytest.approx(0.01)
    assert root([0, HIPS[0]]).pelvis_observed
    on_spine = root([0, *HIPS])
    assert on_spine.root_sigma == pytest.approx(np.hypot(0.01, 0.02)), "the spine carries it"
    inferred = root([0, *HIPS, J["spine1"]])
    assert inferred.root_sigma == pytest.approx(np.hypot(0.01, 0.05))
    assert (inferred.pelvis_observed, inferred.root_observed) == (False, True)
    assert not root(list(range(22))).root_observed
    positions = STANDING.copy()
    positions[0] = np.nan
    none = root([], positions=positions)
    assert (none.root_known, none.root_observed) == (False, False)


def test_feet_may_anchor_if_they_have_not_moved_and_they_or_the_root_are_observed() -> None:
    load, rest = (np.linspace(0.0, most, 8, dtype=np.float32) for most in (0.7, 0.35))
    chances = Contacts(load, rest, np.zeros(1, np.float32))
    feet = [CONTACT_JOINTS.index(joint) for joint in FEET]
    found = stance(chances, seen(), np.array([0.0, 2.9, 3.1, 0.0]))
    np.testing.assert_allclose(found.load, np.array(feet) / 10 * [1, 1, 0, 1])
    np.testing.assert_allclose(found.rest, np.array(feet) / 20 * [1, 1, 0, 1])
    state = np.full(22, JointState.IMPUTED)
    state[FEET[1]] = JointState.SEEN
    hidden = replace(seen(state=state), root_sigma=np.inf)
    assert stance(chances, hidden, np.zeros(4)).load.astype(bool).tolist() == [False, True, False, False]
    nowhere = replace(seen(), positions=np.full((22, 3), np.nan))
    assert not stance(chances, nowhere, np.zeros(4)).load.any()


def test_motion_is_read_from_the_root_and_a_joint_that_is_lost_stays_where_it_was() -> None:
    memory, wrist = MotionMemory(np.zeros(2, np.float32)), J["left_wrist"]
    rotations = np.tile([0.0, 0.0, 0.6, 0.8], (22, 1))
    lost = STANDING.copy()
    lost[wrist] = np.nan
    first = seen(positions=lost, rotations=rotations)
    local, before, dt = memory.update(first)
    np.testing.assert_allclose(local[wrist], yaw_matrix(first.yaw) @ REST_POSITIONS[wrist], atol=1e-6)
    np.testing.assert_array_equal(local, before)
    assert dt == 1 / 30
    memory.state += 1.0
    second = seen(first, 0.2, positions=STANDING + 0.5)
    local, before, dt = memory.update(second)
    np.testing.assert_allclose(local, STANDING - STANDING[0], atol=1e-6)
    np.testing.assert_allclose(before[J["head"]], (STANDING - STANDING[0])[J["head"]], atol=1e-6)
    assert (dt, memory.state.tolist()) == (0.2, [1.0, 1.0])
    third = seen(second, 0.01, positions=lost)
    local, _, dt = memory.update(third)
    np.testing.assert_allclose(local, STANDING - STANDING[0], atol=1e-6)
    assert dt == 1 / 30
    local, before, dt = memory.update(seen(third, 1.0))
    np.testing.assert_array_equal(local, before)
    assert (dt, memory.state.tolist()) == (1 / 30, [0.0, 0.0])


def test_the_networks_velocity_is_turned_to_the_world_with_its_error_on_cameras(monkeypatch) -> None:
    class Net:
        config = SimpleNamespace(hidden=2, sigma_scale=(1.5, 3.0), correlation_s=(0.8, 0.2))

        def __call__(self, features: np.ndarray, state: np.ndarray) -> NewestMotion:
            velocity = np.tile([0.6, 0.8, 0.3], (len(features), 1))
            return NewestMotion(velocity, np.log(np.tile([0.1, 0.2, 0.4], (len(features), 1))), state + 1)

    monkeypatch.setattr(LiveRootVelocity, "load", lambda weights: Net())
    network = VelocityNetwork("any")
    np.testing.assert_allclose(network.memory_s, [0.4, 0.4, 0.3])
    memories = [network.memory(), network.memory()]
    turned = np.tile(Rotation.from_euler("z", 90, degrees=True).as_quat(), (22, 1))
    ahead, left = network.update(memories, [seen(), seen(rotations=turned)])
    np.testing.assert_allclose(ahead.velocity, [0.6, 0.8, 0.3])
    np.testing.assert_allclose(left.velocity, [-0.8, 0.6, 0.3])
    level = np.sqrt((0.1**2 + 0.2**2) / 2)
    np.testing.assert_allclose(ahead.sigma, np.hypot(0.35, [3.0 * level, 3.0 * level, 6.0 * 0.4]))
    assert [memory.state.tolist() for memory in memories] == [[1.0, 1.0]] * 2
    assert network.update([], []) == []


def test_contacts_are_read_from_two_frames_above_the_ground_under_each_foot(monkeypatch) -> None:
    """The features of a net that returns them: rest at the ground's height, and a flag of whether it is known."""
    read: list[np.ndarray] = []

    class Net:
        hidden = 1

        def __call__(self, features: np.ndarray, state: np.ndarray) -> Contacts:
            read.append(features)
            return Contacts(features[:, :8], features[:, :8], state + 1)

    monkeypatch.setattr(LiveContacts, "load", lambda weights: Net())
    network = ContactNetwork("any")
    state, floor = network.memory(), Floor(calibrated=True)
    for _ in range(30):
        floor.observe(np.array([*STANDING[FEET[0], :2], 0.15]), 0.02, 1 / 30)
    positions = STANDING.copy()
    positions[[FEET[0], FEET[2]], 2] += 0.15
    first = seen(positions=positions)
    second = seen(first, 0.1, positions=positions + [0.05, 0.0, 0.0])
    gone = seen(second, 1.0, positions=positions)
    hidden = replace(seen(gone, 0.1, positions=positions), root_sigma=np.inf)
    for before, now in itertools.pairwise((first, first, second, gone, hidden)):
        state = network.update([state], [before], [now], floor)[0].state
    joints = np.array(read)[:, 0, :-2].reshape(4, 8, 12)
    known = np.array(read)[:, 0, -2:]
    np.testing.assert_array_equal(known, [[1, 1], [1, 1], [1, 1], [0, 0]])
    np.testing.assert_allclose(joints[:3, :, 7], np.tile([[0.0], [0.5], [0.0]], (1, 8)), atol=1e-5)
    # knees and hands are above the ground of the lower foot
    joint = list(CONTACT_JOINTS)
    raised = np.where(np.isin(joint, FEET), STANDING[joint, 2], positions[joint, 2])
    expected = np.clip(raised - REST_HEIGHT, -0.6, 0.6)
    np.testing.assert_allclose(0.1 * joints[:3, :, 6], np.tile(expected, (3, 1)), atol=1e-3)
    assert state.tolist() == [2.0], "begun anew after a gap"
    assert network.update([], [], [], floor) == []


DT = 1 / 30


def frame(*joints: str, dt: float = DT) -> Any:
    """An observation of these joints."""
    return SimpleNamespace(observed=np.isin(np.arange(22), [J[name] for name in joints]), dt=dt)


def guessed(memory: LegMemory, *joints: str, dt: float = DT) -> set[str]:
    """The names of the joints that are guesses when these are observed."""
    return {name for name, is_guess in zip(CONTACTS, memory.update(frame(*joints, dt=dt)), strict=False) if is_guess}


LEGS = set(CONTACTS[:6])


def test_feet_are_where_they_are_said_to_be() -> None:
    assert [J[name] for name in CONTACTS[observe.LEG_CONTACTS][observe.FEET_OF_LEGS]] == list(FEET)
    assert {name for name in CONTACTS if "wrist" not in name} == LEGS


def test_what_was_never_observed_is_a_guess_from_the_first_frame() -> None:
    assert guessed(LegMemory(), "left_hip", "right_hip", dt=0.0) == LEGS
    assert guessed(LegMemory(), *LEGS, dt=0.0) == set()


@pytest.mark.parametrize("part", ["ankle", "foot"])
def test_an_ankle_or_toes_are_a_foot_with_its_knee_and_a_knee_is_none(part: str) -> None:
    for side in ("left", "right"):
        assert guessed(LegMemory(), f"{side}_{part}") == {name for name in LEGS if not name.startswith(side)}
    assert guessed(LegMemory(), "right_knee") == LEGS - {"right_knee"}


def test_what_is_hidden_is_a_guess_after_a_while_and_none_when_it_is_observed_again() -> None:
    memory = LegMemory()
    guessed(memory, *LEGS, dt=0.0)
    times = []
    for _ in range(100):
        times.append(guessed(memory, "left_knee", "left_ankle"))
    hidden = LEGS - {"left_knee", "left_ankle", "left_foot"}
    first = next(k for k, names in enumerate(times, 1) if names)
    assert first * DT == pytest.approx(GUESSED_S, abs=DT)
    assert all(names == hidden for names in times[first:])
    assert hidden == {"right_knee", "right_ankle", "right_foot"}
    assert guessed(memory, "right_knee") == {"right_ankle", "right_foot"}
    assert guessed(memory, "right_foot") == set()
