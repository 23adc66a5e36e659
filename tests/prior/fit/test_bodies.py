from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import clean_body, world_body

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JointState, Message, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.prior.body.kinematics import rotation_matrices
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.fit import bodies
from steadypose.prior.fit.bodies import (
    Fit,
    Seen,
    bodies_seen,
    fit_body,
    fit_stream,
    ground_plane,
    lowest_floor,
    noise_of,
    rewritten,
    stands_elsewhere,
    track_of,
)
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.observations import SeenJoints, SurfacePoints
from steadypose.prior.fit.solve import FitSettings
from steadypose.prior.fit.windows import FittedTrack

FRAME_NS, START_NS = 1e9 / 30, 10**9
FEET = [J[f"{side}_{part}"] for part in ("ankle", "foot") for side in ("left", "right")]
STANDING = REST_POSITIONS - [0.0, 0.0, REST_POSITIONS[10, 2] - 0.015]
SENSOR = Pose(np.array([0.5, -3.0, 1.2]), Rotation.from_euler("xz", [-90, 20], degrees=True).as_quat())
NET = cast(HumorNet, None)


def in_sensor(positions: np.ndarray) -> np.ndarray:
    return (
        Rotation.from_quat(SENSOR.orientation)
        .inv()
        .apply((positions - SENSOR.position).reshape(-1, 3))
        .reshape(positions.shape)
    )


def messages(motion: np.ndarray, raw: np.ndarray | None = None, calibrated: bool = True) -> list[tuple[str, PoseClean]]:
    """A body of which the sensor has seen (T, 22, 3) metres, world, as ``pose/clean`` says it."""
    raw = motion if raw is None else raw
    found = []
    for t, (clean, seen) in enumerate(zip(in_sensor(motion), in_sensor(raw), strict=True)):
        state = np.full(22, JointState.SEEN)
        state[J["head"]] = JointState.IMPUTED
        body = clean_body(clean, id=7, state=state, raw_positions=seen, raw_confidence=np.linspace(0.0, 1.0, 22))
        found.append(
            (POSE_CLEAN, PoseClean(START_NS + round(t * FRAME_NS), "camera", "test", SENSOR, calibrated, 4, [body]))
        )
    return found


def still(frames: int = 12) -> np.ndarray:
    return np.tile(STANDING, (frames, 1, 1))


def test_noise_is_found_in_what_moves() -> None:
    rng = np.random.default_rng(0)
    moving = np.sin(np.arange(90) / 15)[:, None, None] + np.zeros((90, 22, 3))
    assert noise_of(moving + 0.04 * rng.standard_normal((90, 22, 3))) == pytest.approx(0.04, rel=0.1)
    assert noise_of(moving) == noise_of(np.full((90, 22, 3), np.nan)) == 0.01


def test_the_plane_of_the_ground_holds_its_points() -> None:
    plane = ground_plane(np.array([0.2, 0.05, -0.03]))
    tilt = Rotation.from_rotvec([0.05, -0.03, 0.0])
    np.testing.assert_allclose(plane[:3], tilt.apply([0.0, 0.0, 1.0]))
    for point in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]):
        assert plane[:3] @ (tilt.apply(point) + [0.0, 0.0, 0.2]) + plane[3] == pytest.approx(0.0)


def test_a_body_that_was_away_or_not_whole_is_two() -> None:
    told = messages(still(30))
    told[14][1].bodies = []
    assert [len(seen.bodies) for seen in bodies_seen(told, 8)] == [14, 15]
    broken = messages(still(30))
    broken[10][1].bodies[0].positions = np.full((22, 3), np.nan, np.float32)
    assert [len(seen.bodies) for seen in bodies_seen(broken, 19)] == [19]
    assert bodies_seen(broken, 20) == []
    two = messages(still(10))
    for _, message in two:
        message.bodies.append(replace(message.bodies[0], id=3))
    assert [(seen.id, len(seen.bodies), seen.calibrated) for seen in bodies_seen(two, 8)] == [
        (7, 10, True),
        (3, 10, True),
    ]
    np.testing.assert_array_equal(bodies_seen(two, 8)[0].stamps_ns, START_NS + np.round(np.arange(10) * FRAME_NS))


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_track_starts_from_clean_in_the_world_and_is_to_meet_what_was_seen(calibrated: bool) -> None:
    raw, motion = still(30), still(30) + [0.3, 0.0, 0.2]
    raw += [0.3, 0.0, 0.2]
    raw += 0.02 * np.random.default_rng(0).standard_normal(raw.shape)
    raw[3, 20] = motion[3, 20] + [0.0, 0.24, 0.0]
    raw[4, 20] = motion[4, 20] + [0.0, 0.16, 0.0]
    (seen,) = bodies_seen(messages(motion, raw, calibrated), 8)
    points = np.random.default_rng(1).normal(size=(30, 5, 3))
    track = track_of(seen, points)
    (start,) = track.starts
    np.testing.assert_allclose(start.root.numpy(), motion[:, 0], atol=1e-5)
    published = Rotation.from_quat(seen.bodies[0].rotations).as_matrix()
    published[0] = Rotation.from_quat(SENSOR.orientation).as_matrix() @ published[0]
    np.testing.assert_allclose(start.rotations[0].numpy(), published, atol=1e-5)
    assert start.ground_known == calibrated
    assert start.ground == pytest.approx(0.0 if calibrated else 0.2, abs=1e-5)
    joints, surface = track.observed
    assert isinstance(joints, SeenJoints)
    hidden = ~np.isfinite(joints.positions.numpy()).all(axis=-1)
    assert np.argwhere(hidden).tolist() == [[3, 20]], "farther than 10 cm and five deviations"
    np.testing.assert_allclose(joints.positions.numpy()[~hidden], raw[~hidden], atol=1e-5)
    deviation = noise_of(raw) / np.sqrt(np.clip(np.linspace(0.0, 1.0, 22), 0.05, 1.0))
    np.testing.assert_allclose(joints.sigma.numpy(), np.tile(deviation, (30, 1)), rtol=1e-3)
    assert isinstance(surface, SurfacePoints)
    np.testing.assert_allclose(surface.points.numpy(), points, atol=1e-6)
    np.testing.assert_allclose(surface.camera.numpy(), np.tile(SENSOR.position, (30, 1)), atol=1e-6)
    assert surface.weight == 0.03
    assert len(track_of(seen, None).observed) == 1


def test_an_unknown_floor_is_where_the_lower_toes_are_in_the_lowest_frames() -> None:
    positions = still(101) + 0.3
    positions[:, J["left_foot"], 2] += 1.0
    positions[:, J["right_foot"], 2] += np.linspace(0.0, 1.0, 101)
    assert lowest_floor(positions) == pytest.approx(0.3 + 0.05)


@pytest.mark.parametrize(
    ("height", "share", "speed", "elsewhere"),
    [
        (0.3, 0.5, 0.0, True), (0.3, 0.3, 0.0, False), (0.09, 1.0, 0.0, False), (-0.3, 0.5, 0.0, True),
        (0.3, 0.5, 0.4, False),
    ],
)  # fmt: skip
def test_who_stands_elsewhere_for_long_stands_on_no_floor(height: float, share: float, speed: float, elsewhere: bool):
    frames = np.arange(100)
    positions = still(100)
    above = frames >= 100 * (1 - share)
    positions[:, FEET, 2] += height * above[:, None]
    positions[..., 0] += speed * np.where(above, frames / 30, 0.0)[:, None]
    assert stands_elsewhere(positions, 0.0) == elsewhere


def track(joints: np.ndarray, load: float = 0.5) -> FittedTrack:
    """A fit of joints (T, 22, 3), turned about x, of two windows on a floor at 10 and 30 cm."""
    rotations = np.tile(np.eye(3), (len(joints), 22, 1, 1))
    rotations[:, 0] = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    offsets = np.zeros((2, 22, 3))
    offsets[0, 1], offsets[1, 1] = [0.1, 0.0, 0.0], [0.3, 0.0, 0.0]
    ground = np.array([[0.1, 0.0, 0.02], [0.3, 0.0, 0.04]])
    return FittedTrack(
        joints,
        rotations,
        offsets,
        ground,
        np.full((len(joints), 8), load),
        np.zeros((1, len(joints), 22)),
        np.zeros((2, 3)),
        np.array([True, False]),
    )


@pytest.mark.parametrize(
    ("off", "before", "kept"), [(0.03, 0.01, True), (0.05, 0.01, False), (0.05, 0.02, True), (np.nan, 0.01, False)]
)
def test_a_fit_much_worse_than_clean_has_failed(off: float, before: float, kept: bool, monkeypatch: pytest.MonkeyPatch):
    raw = still()
    raw[:, J["head"]] = np.nan
    monkeypatch.setattr(bodies, "fit_track", lambda *_, **__: track(still() + [0.0, off, 0.0]))
    (seen,) = bodies_seen(messages(still() + [before, 0.0, 0.0], raw), 8)
    found = fit_body(NET, seen, None, FitSettings(), None)
    assert (found.track is not None) == kept
    expected = np.where(np.arange(22) == J["head"], np.nan, off if kept else before)
    np.testing.assert_allclose(found.misfit, np.tile(expected, (12, 1)), atol=1e-5)


def test_who_stands_on_stairs_is_not_fitted() -> None:
    climbing = still(40)
    climbing[20:] += [0.0, 0.0, 0.4]
    for calibrated in (True, False):
        (seen,) = bodies_seen(messages(climbing, climbing + 0.01, calibrated), 8)
        found = fit_body(NET, seen, None, FitSettings(), None)
        assert found.track is None
        np.testing.assert_allclose(found.misfit, 0.01 * np.sqrt(3), atol=1e-5)


def test_each_body_of_a_stream_is_fitted_to_the_points_of_its_own_frames(tmp_path: Path, monkeypatch) -> None:
    given: list[tuple[Any, ...]] = []
    monkeypatch.setattr(bodies, "fit_body", lambda *arguments: given.append(arguments) or len(given))
    told: list[tuple[str, Message]] = [*messages(still(20))]
    told[10] = (POSE_CLEAN, replace(messages(still(20))[10][1], bodies=[]))
    for t in range(-2, 20):  # the sensor has begun earlier
        told.append(
            (POSE_RAW, PoseRaw(START_NS + round(t * FRAME_NS) + 5, "camera", "test", "smpl22", SENSOR, True, []))
        )
    told.append((POSE_RAW, PoseRaw(10**12, "camera", "test", "smpl22", SENSOR, True, [], end_of_stream=True)))
    cloud = np.random.default_rng(0).normal(size=(22, 4, 3))
    began: list[Seen] = []
    assert fit_stream(told, in_sensor(cloud), NET, tmp_path, began.extend) == [1, 2]
    assert [len(seen.bodies) for seen in began] == [10, 9]
    for number, (rows, (_, seen, points, settings, folder, _)) in enumerate(
        zip((slice(2, 12), slice(13, 22)), given, strict=True)
    ):
        assert seen is began[number]
        np.testing.assert_allclose(points, cloud[rows], atol=1e-9)
        assert (settings, folder, folder.is_dir()) == (FitSettings(), tmp_path / f"000{number}", True)
    given.clear()
    fit_stream(told, None, NET)
    assert [(points, folder) for _, _, points, _, folder, _ in given] == [(None, None)] * 2


@pytest.mark.parametrize("load", [0.5, np.nan])
def test_fitted_poses_are_in_the_messages_of_their_body_and_time(load: float) -> None:
    told: list[tuple[str, Message]] = [*messages(still())]
    for t in range(12):
        known = np.where(np.arange(8) == 2, np.nan, 0.25)
        body = world_body(still()[t], id=7, root_position=np.zeros(3), contacts=known)
        bodies, floor = [body, replace(body, id=8)], np.array([0.0, 0.0, 1.0, 0.0])
        told.append((POSE_WORLD, PoseWorld(START_NS + round(t * FRAME_NS), "world", "test", floor, bodies)))
    (seen,) = bodies_seen(told, 8)
    joints = still() + np.arange(12)[:, None, None] ** 2 * np.array([0.01, 0.0, 0.0])
    fitted = track(joints, load)
    out = rewritten(told, [Fit(seen, fitted, np.zeros((12, 22)))])
    assert [topic for topic, _ in out] == [topic for topic, _ in told]
    velocity = np.gradient(joints[:, 0], 1 / 30, axis=0)
    for row, (_, message) in enumerate(out[:12]):
        assert isinstance(message, PoseClean)
        (body,) = message.bodies
        np.testing.assert_allclose(body.positions, in_sensor(joints)[row], atol=1e-6)
        own = Rotation.from_quat(SENSOR.orientation).inv() * Rotation.from_euler("x", 30, degrees=True)
        np.testing.assert_allclose(rotation_matrices(body.rotations.astype(float))[0], own.as_matrix(), atol=1e-6)
        assert body.bone_lengths[1] == pytest.approx(0.2)
        assert [JointState(s).name for s in body.state[[0, J["head"]]]] == ["REFINED", "IMPUTED"]
    for row, (_, message) in enumerate(out[12:]):
        assert isinstance(message, PoseWorld)
        body, other = message.bodies
        np.testing.assert_allclose(body.positions, joints[row], atol=1e-6)
        np.testing.assert_allclose(body.root_position, joints[row, 0], atol=1e-6)
        np.testing.assert_allclose(body.root_velocity, velocity[row], atol=1e-6)
        np.testing.assert_allclose(body.root_orientation, body.rotations[0], atol=1e-6)
        assert np.isnan(body.contacts[2]), "a foot that nobody sees"
        np.testing.assert_allclose(np.delete(body.contacts, 2), 0.25 if np.isnan(load) else load)
        np.testing.assert_allclose(message.ground_plane, ground_plane(np.array([0.2, 0.0, 0.03])), atol=1e-6)
        assert (other.id, other.root_position.any()) == (8, False)


def test_a_fit_that_fails_leaves_clean_and_is_flagged() -> None:
    told = messages(still())
    out = rewritten(told, [Fit(bodies_seen(told, 8)[0], None, np.zeros((12, 22)))])
    for (_, before), (_, after) in zip(told, out, strict=True):
        assert isinstance(after, PoseClean)
        np.testing.assert_array_equal(after.bodies[0].positions, before.bodies[0].positions)
        assert after.bodies[0].anomaly_flag
