from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import clean_body, waving, world_body

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JointState, Message, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.prior.body.kinematics import rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS, J
from steadypose.prior.fit import bodies, windows
from steadypose.prior.fit.bodies import Fit, bodies_seen, fit_body, fit_stream, noise_of, rewritten, track_of
from steadypose.prior.fit.energy import Smooth, energy
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.fit.observations import SeenJoints, SurfacePoints
from steadypose.prior.fit.solve import DISCREPANCY, FitSettings, Start, _explains, _stages, fit_window
from steadypose.prior.fit.windows import FittedTrack, _fingerprint, _grounded, _joined, load_of, window_bounds

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
    plane = bodies.ground_plane(np.array([0.2, 0.05, -0.03]))
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
    assert bodies.lowest_floor(positions) == pytest.approx(0.3 + 0.05)


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
    assert bodies.stands_elsewhere(positions, 0.0) == elsewhere


def track(joints: np.ndarray, load: float = 0.5) -> FittedTrack:
    """A fit of joints (T, 22, 3), turned about x, of two windows on a floor at 10 and 30 cm."""
    rotations = np.tile(np.eye(3), (len(joints), 22, 1, 1))
    rotations[:, 0] = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    offsets = np.zeros((2, 22, 3))
    offsets[0, 1], offsets[1, 1] = [0.1, 0.0, 0.0], [0.3, 0.0, 0.0]
    ground = np.array([[0.1, 0.0, 0.02], [0.3, 0.0, 0.04]])
    return FittedTrack(
        joints, rotations, offsets, ground, np.full((len(joints), 8), load), np.zeros((1, len(joints), 22)),
        np.zeros((2, 3)), np.array([True, False]),
    )  # fmt: skip


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
    began: list[bodies.Seen] = []
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
        pair, floor = [body, replace(body, id=8)], np.array([0.0, 0.0, 1.0, 0.0])
        told.append((POSE_WORLD, PoseWorld(START_NS + round(t * FRAME_NS), "world", "test", floor, pair)))
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
        np.testing.assert_allclose(message.ground_plane, bodies.ground_plane(np.array([0.2, 0.0, 0.03])), atol=1e-6)
        assert (other.id, other.root_position.any()) == (8, False)


def test_a_fit_that_fails_leaves_clean_and_is_flagged() -> None:
    told = messages(still())
    out = rewritten(told, [Fit(bodies_seen(told, 8)[0], None, np.zeros((12, 22)))])
    for (_, before), (_, after) in zip(told, out, strict=True):
        assert isinstance(after, PoseClean)
        np.testing.assert_array_equal(after.bodies[0].positions, before.bodies[0].positions)
        assert after.bodies[0].anomaly_flag


def window(value: float, turned: float, frames: int = 6) -> dict[str, Any]:
    rotations = np.tile(yaw_matrix(np.array(turned)), (frames, 22, 1, 1))
    return {
        "joints": np.full((frames, 22, 3), value), "rotations": rotations, "load": np.full((frames, 8), value),
        "misfit": np.full((2, frames, 22), value), "offsets": np.full((22, 3), value), "ground": np.full(3, value),
        "energies": np.full(3, value), "kept": np.array(value > 0.5),
    }  # fmt: skip


def test_windows_are_faded_over_where_they_overlap() -> None:
    found = _joined([window(0.0, 0.0), window(1.0, 1.0), window(2.0, 2.0)], [(0, 6), (3, 9), (7, 13)])
    line = [0, 0, 0, 0.25, 0.5, 0.75, 1, 1 + 1 / 3, 1 + 2 / 3, 2, 2, 2, 2]
    for values in (found.joints[:, 4, 1], found.load[:, 3], found.misfit[1, :, 5]):
        np.testing.assert_allclose(values, line)
    turns = Rotation.from_matrix(found.rotations[:, 7]).as_rotvec()
    np.testing.assert_allclose(turns, np.outer(line, [0.0, 0.0, 1.0]), atol=1e-12)
    for values in (found.offsets[:, 3, 1], found.ground[:, 2], found.energies[:, 0]):
        assert values.tolist() == [0.0, 1.0, 2.0]
    assert found.kept.tolist() == [False, True, True]


def test_windows_follow_each_other_every_two_and_a_half_seconds() -> None:
    assert window_bounds(90) == [(0, 90)]
    assert window_bounds(91) == [(0, 90), (1, 91)]
    assert window_bounds(165) == [(0, 90), (75, 165)]
    assert window_bounds(200) == [(0, 90), (75, 165), (110, 200)]


def test_whatever_a_fit_depends_on_tells_windows_apart() -> None:
    model = torch.nn.Linear(2, 2)
    start = Start(torch.zeros(3, 3), torch.zeros(3, 22, 3, 3), torch.zeros(22, 3))
    given: list[Any] = [[start], FitSettings(), 3]
    found = [_fingerprint(cast(Any, model), *given)]
    assert found == [_fingerprint(cast(Any, model), *given)]
    for other in (
        [[replace(start, root=start.root + 1e-6)], *given[1:]],
        [[start, start], *given[1:]],
        [[start], replace(FitSettings(), bones_sigma=0.02), 3],
        [*given[:2], 2],
    ):
        found.append(_fingerprint(cast(Any, model), *other))
    model.weight.data += 1e-6
    found.append(_fingerprint(cast(Any, model), *given))
    assert len(set(found)) == 6


def test_load_is_that_of_the_first_logits_and_the_first_frames_have_the_thirds() -> None:
    logits = torch.cat([torch.logit(torch.tensor([[0.2], [0.7]])).expand(2, 8), torch.zeros(2, 8)], dim=1)
    joints = torch.zeros(4, 22, 3)
    found = load_of(cast(Motion, SimpleNamespace(predicted=(None, logits), joints=joints)))
    np.testing.assert_allclose(found, np.tile([[0.2], [0.2], [0.2], [0.7]], (1, 8)), atol=1e-6)
    none = load_of(cast(Motion, SimpleNamespace(predicted=(None, logits[:, :0]), joints=joints)))
    assert none.shape == (4, 8)
    assert np.isnan(none).all()


@pytest.mark.parametrize(("degrees", "lies"), [(55.0, False), (65.0, True), (180.0, True)])
def test_a_pelvis_tilted_by_more_than_sixty_degrees_lies(degrees: float, lies: bool) -> None:
    rotations = torch.eye(3).repeat(5, 22, 1, 1)
    rotations[2, 0] = torch.from_numpy(Rotation.from_euler("y", degrees, degrees=True).as_matrix())
    start = Start(torch.zeros(5, 3), rotations, torch.zeros(22, 3))
    assert _grounded(start).ground_known == lies
    assert _grounded(replace(start, ground_known=True)).ground_known


@pytest.mark.parametrize("known", [False, True])
def test_a_floor_that_is_known_is_no_variable_and_only_the_last_stage_has_latents(known: bool) -> None:
    start = Start(torch.zeros(5, 3), torch.zeros(5, 22, 3, 3), torch.zeros(22, 3), 0.2, known)
    root, poses, motion = _stages(start, [], FitSettings())
    assert root.free == ("root", "orientation")
    assert poses.free == ("root", "orientation", "turns", "bones", *([] if known else ["ground"]))
    assert motion.free == (*poses.free, "latents")
    names = [[type(term).__name__ for term in stage.terms] for stage in (root, poses, motion)]
    ground = [] if known else ["Ground"]
    assert names[0] == ["Smooth"]
    assert names[1] == ["Bones", *ground, "Smooth", "FirstState"]
    assert names[2] == ["Bones", *ground, "Transitions", "FirstState", "Standing", "Smooth"]


def test_each_stage_lowers_the_energy_of_its_terms_and_says_so() -> None:
    torch.manual_seed(0)
    model = HumorNet(HumorConfig(hidden=64, latent=4, components=2)).eval()
    positions = waving(6) + 0.01 * np.random.default_rng(0).standard_normal((6, 22, 3))
    start = Start.of(positions[:, 0] + 0.05, np.tile(np.eye(3), (6, 22, 1, 1)), REST_OFFSETS)
    seen = SeenJoints(torch.from_numpy(positions).float(), torch.full((6, 22), 0.02))
    brief = FitSettings(root_steps=20, pose_steps=20, motion_steps=20, acceleration_share=0.0, discrepancy=torch.inf)
    found = fit_window(model, start, [seen], brief)
    assert len(found.energies) == 3
    assert found.kept
    assert not any(p.requires_grad for p in model.parameters())
    assert not found.motion.variables.root.requires_grad
    before = Variables.initial(start.root, start.rotations, start.offsets, 0.0, 4)
    stages = _stages(start, [seen], brief)
    assert float(energy(found.motion, stages[2].terms)) == pytest.approx(found.energies[2], rel=1e-4)
    for number in (1, 2):
        upto = fit_window(model, start, [seen], brief, stages=number)
        assert upto.energies == pytest.approx(found.energies[:number], rel=1e-3)
        value = float(energy(upto.motion, stages[number - 1].terms))
        assert value == pytest.approx(upto.energies[-1], rel=1e-4)
        assert value < 0.6 * float(energy(Motion(model, before), stages[number - 1].terms))
        changed = {name for name in stages[2].free if getattr(upto.motion.variables, name).any()}
        assert changed == set(stages[number - 1].free)


def test_a_motion_model_that_contradicts_the_observations_is_left_out() -> None:
    torch.manual_seed(0)
    model = HumorNet(HumorConfig(hidden=64, latent=4, components=2)).eval()  # not trained
    positions = waving(6)
    start = Start.of(positions[:, 0], np.tile(np.eye(3), (6, 22, 1, 1)), REST_OFFSETS)
    seen = SeenJoints(torch.from_numpy(positions).float(), torch.full((6, 22), 0.01))
    settings = FitSettings(root_steps=20, pose_steps=20, motion_steps=20)
    found, before = fit_window(model, start, [seen], settings), fit_window(model, start, [seen], settings, stages=2)
    assert not found.kept
    assert len(found.energies) == 3
    torch.testing.assert_close(found.motion.joints, before.motion.joints)
    assert before.kept


@pytest.mark.parametrize(
    ("before", "after", "kept"), [(50.0, 53.9, True), (50.0, 54.1, False), (1.0, 9.9, True), (1.0, 10.1, False)]
)
def test_the_last_stage_may_explain_a_little_less_or_all_below_the_noise(before: float, after: float, kept: bool):
    def of(nats: float) -> Motion:
        return cast(Motion, torch.full((200,), (nats / 100.0) ** 0.5))  # 200 residuals; 100 nats are their noise's

    term = cast(Any, SimpleNamespace(residual=lambda values: values, kernel=lambda square: square))
    assert _explains(of(after), of(before), [term], DISCREPANCY) == kept


def test_smoothness_yields_to_what_a_joint_does_and_not_to_a_jump() -> None:
    root = torch.zeros(30, 3)
    root[:, 0] = 0.5 * 6.0 * (torch.arange(30) / 30.0) ** 2
    root[20:, 1] += 0.3
    start = Start(root, torch.eye(3).repeat(30, 22, 1, 1), torch.zeros(22, 3))
    (smooth,) = _stages(start, [], FitSettings(smooth_sigma=4.0, acceleration_share=2.0))[0].terms
    assert isinstance(smooth, Smooth)
    assert isinstance(smooth.sigma, torch.Tensor)
    expected = torch.full((28, 22), (4.0**2 + 2.0**2 * 6.0**2 / 3.0) ** 0.5)
    torch.testing.assert_close(smooth.sigma, expected, rtol=1e-3, atol=0.0)


def test_bodies_are_fitted_where_the_window_before_has_ended(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(windows, "FRAMES", 8)
    monkeypatch.setattr(windows, "OVERLAP", 2)
    given: list[tuple[Start, Any, Any]] = []

    def fit(model: Any, start: Start, seen: Any, settings: Any, *, anchor: Any) -> Any:
        given.append((start, seen[0], anchor))
        return SimpleNamespace(energies=(9.0, float(start.root[0, 0])), frames=len(start.root), number=len(given))

    def arrays(fitted: Any, seen: Any) -> dict[str, Any]:
        return {**window(fitted.number, 0.0, fitted.frames), "misfit": np.zeros((1, fitted.frames, 22))}

    monkeypatch.setattr(windows, "fit_window", fit)
    monkeypatch.setattr(windows, "_arrays", arrays)
    roots = np.arange(42.0).reshape(14, 3)
    starts = [Start.of(roots + off, np.tile(np.eye(3), (14, 22, 1, 1)), REST_OFFSETS) for off in (5.0, 0.0)]
    seen = SeenJoints(torch.arange(14 * 66).reshape(14, 22, 3).float(), torch.ones(14, 22))
    told: list[int] = []
    settings, model = FitSettings(), cast(Any, torch.nn.Linear(1, 1))
    track = windows.Track(starts, [seen])
    windows.fit_track(model, track, settings, tmp_path, advanced=lambda: told.append(len(given)))
    assert told == [2, 3], "the second window only from the better start"
    start, joints, anchor = given[2]
    np.testing.assert_array_equal(start.root.numpy(), roots[6:14])
    np.testing.assert_array_equal(joints.positions.numpy(), seen.positions[6:14].numpy())
    assert (start.offsets == 2.0).all()
    assert start.ground == 2.0
    np.testing.assert_array_equal(anchor.joints.numpy(), np.full((2, 22, 3), 2.0))
    assert given[0][2] is given[1][2] is None
    windows.fit_track(model, track, settings, tmp_path)
    assert len(given) == 3, "an interrupted fit resumes from the start that was the better one"
