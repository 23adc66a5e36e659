import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prior.kinematics import (
    CONTACT_JOINTS,
    estimate_offsets,
    forward_kinematics,
    heading,
    label_contacts,
    solve_pose,
    solve_rotations,
    swing,
    yaw_matrix,
)
from prior.skeletons import JOINTS, PARENTS, REST_OFFSETS, J

LEAVES = [J[n] for n in ("left_foot", "right_foot", "head", "left_wrist", "right_wrist")]
UNITS = st.floats(-1, 1, allow_nan=False)


def random_pose(rng: np.random.Generator, frames: int, spread: float = 0.35) -> np.ndarray:
    """Local rotations that the solver can recover: leaves at rest, elbows and knees hinges, limbs well bent."""
    vectors = rng.normal(size=(frames, 22, 3)) * spread
    vectors[:, LEAVES] = 0
    vectors[:, [J["spine1"], J["spine2"], J["spine3"], J["neck"]]] *= 0.2
    for joint, axis in (("left_elbow", (0, 0, -1)), ("right_elbow", (0, 0, 1)), ("left_knee", (0, 1, 0)),
                        ("right_knee", (0, 1, 0))):  # fmt: skip
        vectors[:, J[joint]] = rng.uniform(0.6, 1.8, size=(frames, 1)) * np.array(axis)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 22, 3, 3)


def fk(rotations: np.ndarray, offsets: np.ndarray = REST_OFFSETS) -> np.ndarray:
    return forward_kinematics(torch.from_numpy(rotations), torch.from_numpy(offsets))[0].numpy()


def naive_fk(rotations: np.ndarray, offsets: np.ndarray, root: np.ndarray) -> np.ndarray:
    positions, world = np.zeros((22, 3)), np.zeros((22, 3, 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            positions[joint], world[joint] = root, rotations[joint]
        else:
            positions[joint] = positions[parent] + world[parent] @ offsets[joint]
            world[joint] = world[parent] @ rotations[joint]
    return positions


def test_forward_kinematics_agrees_with_a_walk_down_the_tree() -> None:
    rng = np.random.default_rng(0)
    rotations = Rotation.random(6 * 22, rng=rng).as_matrix().reshape(2, 3, 22, 3, 3)
    offsets = rng.normal(size=(2, 3, 22, 3))
    root = rng.normal(size=(2, 3, 3))
    got, _ = forward_kinematics(*(torch.from_numpy(a) for a in (rotations, offsets, root)))
    for index in np.ndindex(2, 3):
        assert np.allclose(got[index], naive_fk(rotations[index], offsets[index], root[index]))


def test_forward_kinematics_is_differentiable() -> None:
    rotations = torch.eye(3, dtype=torch.float64).repeat(1, 22, 1, 1).requires_grad_()
    offsets = torch.from_numpy(REST_OFFSETS).requires_grad_()
    assert torch.autograd.gradcheck(lambda r, o: forward_kinematics(r, o)[0], (rotations, offsets))


def test_the_rest_pose_stands_in_a_t_and_faces_x() -> None:
    rest = fk(np.broadcast_to(np.eye(3), (22, 3, 3)).copy())
    assert rest[J["left_wrist"], 1] > 0.5
    assert rest[J["right_wrist"], 1] < -0.5
    assert rest[J["head"], 2] > 0.5 > -0.8 > rest[J["left_ankle"], 2]
    assert rest[J["left_foot"], 0] > rest[J["left_ankle"], 0] + 0.1


def test_solving_then_placing_gives_the_positions_back() -> None:
    positions = fk(random_pose(np.random.default_rng(1), 200))
    error = np.linalg.norm(fk(solve_rotations(positions, REST_OFFSETS)) - positions, axis=-1)
    assert np.median(error) < 0.005
    assert error[:, [J["left_ankle"], J["right_wrist"]]].mean() < 0.01


def test_twist_comes_from_the_bend_of_elbows_and_knees() -> None:
    rotations = random_pose(np.random.default_rng(2), 200)
    rotations[:, [J["spine1"], J["spine2"], J["spine3"], J["neck"]]] = np.eye(3)  # nothing the solver must share out
    rotations[:, [J["left_collar"], J["right_collar"]]] = np.eye(3)
    solved = solve_rotations(fk(rotations), REST_OFFSETS)
    for name in ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "left_elbow", "right_knee", "pelvis"):
        difference = Rotation.from_matrix(rotations[:, J[name]]).inv() * Rotation.from_matrix(solved[:, J[name]])
        assert np.median(difference.magnitude()) < 1e-6, name


def test_solve_pose_returns_where_its_rotations_put_the_joints() -> None:
    rng = np.random.default_rng(3)
    positions = fk(random_pose(rng, 20)) + rng.normal(size=(20, 22, 3)) * 0.03
    rotations, placed = solve_pose(positions, REST_OFFSETS)
    assert np.allclose(placed, fk(rotations) + positions[:, :1])
    assert np.allclose(np.linalg.norm(np.diff(placed[:, [1, 4]], axis=1), axis=-1), np.linalg.norm(REST_OFFSETS[4]))
    assert np.allclose(rotations @ rotations.swapaxes(-1, -2), np.eye(3), atol=1e-9)


@given(st.floats(-3.1, 3.1), st.tuples(UNITS, UNITS, UNITS))
@settings(max_examples=30, deadline=None)
def test_turning_the_world_turns_only_the_root(angle: float, shift: tuple[float, float, float]) -> None:
    positions = fk(random_pose(np.random.default_rng(4), 3))
    turned = positions @ yaw_matrix(angle).T + np.array(shift)
    a, b = solve_rotations(positions, REST_OFFSETS), solve_rotations(turned, REST_OFFSETS)
    assert np.allclose(a[:, 1:], b[:, 1:], atol=1e-7)
    assert np.allclose(yaw_matrix(angle) @ a[:, 0], b[:, 0], atol=1e-7)
    change = heading(b[:, 0]) - heading(a[:, 0]) - angle
    assert np.allclose(np.cos(change), 1.0, atol=1e-9)


@given(st.tuples(UNITS, UNITS, UNITS), st.tuples(UNITS, UNITS, UNITS))
@settings(max_examples=200, deadline=None)
def test_swing_turns_one_direction_into_the_other(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    a_, b_ = np.array(a), np.array(b)
    if min(np.linalg.norm(a_), np.linalg.norm(b_)) < 1e-3:
        return
    rotation = swing(a_, b_)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(rotation @ a_ / np.linalg.norm(a_), b_ / np.linalg.norm(b_), atol=1e-3)


def test_swing_of_opposite_directions_is_a_half_turn() -> None:
    for axis in np.eye(3):
        rotation = swing(axis, -axis)
        assert np.allclose(rotation @ axis, -axis)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_missing_joints_keep_the_fallback_and_the_rest_is_solved() -> None:
    positions = fk(random_pose(np.random.default_rng(5), 10))
    whole = solve_rotations(positions, REST_OFFSETS)
    hidden = positions.copy()
    hidden[:, [J["left_elbow"], J["left_wrist"]]] = np.nan
    solved = solve_rotations(hidden, REST_OFFSETS, fallback=whole)
    assert np.isfinite(solved).all()
    assert np.allclose(solved[:, J["left_shoulder"]], whole[:, J["left_shoulder"]])
    assert np.allclose(solved[:, J["right_shoulder"]], whole[:, J["right_shoulder"]])


def test_with_the_legs_hidden_the_body_still_faces_where_its_shoulders_do() -> None:
    rest = fk(np.broadcast_to(np.eye(3), (1, 22, 3, 3)).copy())
    turned = rest @ yaw_matrix(1.0).T + [0, 0, 1.0]
    legs = [j for j, n in enumerate(JOINTS) if n.split("_")[-1] in ("hip", "knee", "ankle", "foot", "pelvis")]
    turned[:, legs] = np.nan
    rotations, placed = solve_pose(turned, REST_OFFSETS)
    assert heading(rotations[:, 0])[0] == pytest.approx(1.0, abs=0.05)
    assert np.abs(placed[0, J["left_wrist"]] - turned[0, J["left_wrist"]]).max() < 0.03


def test_nothing_seen_gives_the_fallback() -> None:
    assert np.allclose(solve_rotations(np.full((2, 22, 3), np.nan), REST_OFFSETS), np.eye(3))


def test_bones_are_recovered_from_noisy_poses() -> None:
    rng = np.random.default_rng(6)
    bones = REST_OFFSETS * rng.uniform(0.8, 1.2, size=(22, 1))
    positions = fk(random_pose(rng, 300, spread=0.2), bones) + rng.normal(size=(300, 22, 3)) * 0.015
    positions[:20] += rng.normal(size=(20, 22, 3)) * 0.5  # outliers
    estimate = estimate_offsets(positions)
    error = np.linalg.norm(estimate, axis=-1) - np.linalg.norm(bones, axis=-1)
    assert np.abs(error[1:]).max() < 0.012


def test_bones_between_joints_that_are_never_seen_span_the_gap() -> None:
    bones = REST_OFFSETS * 1.1
    positions = fk(random_pose(np.random.default_rng(7), 50, spread=0.1), bones)
    unseen = [J["spine1"], J["spine2"], J["left_collar"], J["right_collar"]]
    positions[:, unseen] = np.nan
    estimate = estimate_offsets(positions)
    chain = [J["spine1"], J["spine2"], J["spine3"]]
    assert np.linalg.norm(estimate[chain].sum(axis=0)) == pytest.approx(
        np.linalg.norm(bones[chain].sum(axis=0)), rel=0.02
    )
    placed = solve_pose(positions, estimate)[1]
    assert np.nanmedian(np.linalg.norm(placed - positions, axis=-1)[:, J["left_shoulder"]]) < 0.01


def test_contacts_do_not_depend_on_the_frame_rate() -> None:
    heel = CONTACT_JOINTS.index(J["left_ankle"])
    for fps in (30.0, 60.0, 120.0):
        time = np.arange(0, 2, 1 / fps)
        positions = np.tile(fk(np.broadcast_to(np.eye(3), (22, 3, 3)).copy()), (len(time), 1, 1)) + [0, 0, 0.96]
        positions[:, J["left_ankle"], 0] += np.where(time > 1, (time - 1) * 0.3, 0)  # slides at 0.3 m/s after 1 s
        contacts = label_contacts(positions, fps)
        assert contacts[time < 0.9, heel].all()
        assert not contacts[time > 1.1, heel].any()
    assert not label_contacts(positions + [0, 0, 0.2], fps).any()
    assert label_contacts(positions[:1], fps).shape == (1, 8)
