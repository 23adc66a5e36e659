import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, random_pose

from steadypose.prior.body.inverse_kinematics import RIGID, fit_lengths, solve_pose, solve_rotations, write_swing
from steadypose.prior.body.kinematics import heading, yaw_matrix
from steadypose.prior.body.skeleton import JOINTS, REST_OFFSETS, REST_POSITIONS, J

UNITS = st.floats(-1, 1, allow_nan=False)


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
@settings(max_examples=30)
def test_turning_the_world_turns_only_the_root(angle: float, shift: tuple[float, float, float]) -> None:
    positions = fk(random_pose(np.random.default_rng(4), 3))
    turned = positions @ yaw_matrix(angle).T + np.array(shift)
    a, b = solve_rotations(positions, REST_OFFSETS), solve_rotations(turned, REST_OFFSETS)
    assert np.allclose(a[:, 1:], b[:, 1:], atol=1e-7)
    assert np.allclose(yaw_matrix(angle) @ a[:, 0], b[:, 0], atol=1e-7)
    change = heading(b[:, 0]) - heading(a[:, 0]) - angle
    assert np.allclose(np.cos(change), 1.0, atol=1e-9)


@given(st.tuples(UNITS, UNITS, UNITS), st.tuples(UNITS, UNITS, UNITS))
@example((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
@example((0.0, 0.5, 0.0), (0.0, -1.0, 0.0))
@example((0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
@settings(max_examples=60)
def test_swing_turns_one_direction_into_the_other(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    a_, b_ = np.array(a), np.array(b)
    if min(np.linalg.norm(a_), np.linalg.norm(b_)) < 1e-3:
        return
    rotation = np.empty((3, 3))
    write_swing(a_, b_, rotation)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(rotation @ a_ / np.linalg.norm(a_), b_ / np.linalg.norm(b_), atol=1e-3)


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
    turned = REST_POSITIONS[None] @ yaw_matrix(1.0).T + [0, 0, 1.0]
    legs = [j for j, n in enumerate(JOINTS) if n.split("_")[-1] in ("hip", "knee", "ankle", "foot", "pelvis")]
    turned[:, legs] = np.nan
    rotations, placed = solve_pose(turned, REST_OFFSETS)
    assert heading(rotations[:, 0])[0] == pytest.approx(1.0, abs=0.05)
    assert np.abs(placed[0, J["left_wrist"]] - turned[0, J["left_wrist"]]).max() < 0.03


def test_nothing_seen_gives_the_fallback() -> None:
    assert np.allclose(solve_rotations(np.full((2, 22, 3), np.nan), REST_OFFSETS), np.eye(3))


def rigid_lengths(positions: np.ndarray) -> np.ndarray:
    return np.linalg.norm(positions[..., RIGID[:, 0], :] - positions[..., RIGID[:, 1], :], axis=-1)


def test_a_pose_on_the_bones_is_its_own_fit() -> None:
    positions = fk(random_pose(np.random.default_rng(8), 20))
    assert np.allclose(fit_lengths(positions, REST_OFFSETS, np.ones(22)), positions, atol=1e-9)


def test_the_fit_lies_on_the_bones_and_nearer_to_the_truth_than_what_was_measured() -> None:
    rng = np.random.default_rng(9)
    truth = fk(random_pose(rng, 200))
    measured = truth + rng.normal(size=truth.shape) * 0.02
    placed = fit_lengths(measured, REST_OFFSETS, np.ones(22))
    assert np.abs(rigid_lengths(placed) - rigid_lengths(truth)).max() < 0.005

    def error(p: np.ndarray) -> float:
        return float(np.linalg.norm(p - truth, axis=-1).mean())

    assert error(placed) < 0.8 * error(measured)
    assert error(placed) < 0.8 * error(solve_pose(measured, REST_OFFSETS)[1])


def test_the_fit_moves_the_joints_that_yield() -> None:
    rng = np.random.default_rng(10)
    truth = fk(random_pose(rng, 100))
    wrist = J["left_wrist"]
    off = truth.copy()
    off[:, wrist] += rng.normal(size=(100, 3)) * 0.1
    mobility = np.where(np.arange(22) == wrist, 1.0, 1e-3)
    placed = fit_lengths(off, REST_OFFSETS, mobility)
    assert np.abs(np.delete(placed - truth, wrist, axis=1)).max() < 0.01


def test_a_bone_of_uncertain_length_gives_way_by_its_share_of_the_variance() -> None:
    """A forearm seen a tenth too long: bone and joints yield as two estimates of one length do."""
    truth = fk(random_pose(np.random.default_rng(11), 50))
    elbow, wrist = J["left_elbow"], J["left_wrist"]
    off = truth.copy()
    off[:, wrist] += 0.1 * (truth[:, wrist] - truth[:, elbow])
    mobility = np.where(np.isin(np.arange(22), [elbow, wrist]), 1.0, 1e-6)
    mobility[elbow] = 1e-6
    variance = np.where((RIGID[:, 0] == wrist) & (RIGID[:, 1] == elbow), 1.0, 0.0)
    placed = fit_lengths(off, REST_OFFSETS, mobility, variance)
    length = np.linalg.norm(REST_OFFSETS[wrist])
    np.testing.assert_allclose(np.linalg.norm(placed[:, wrist] - placed[:, elbow], axis=-1), 1.05 * length, rtol=1e-4)
    assert np.abs(np.delete(placed - truth, wrist, axis=1)).max() < 1e-5
