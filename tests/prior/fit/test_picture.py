import numpy as np
import pytest
import torch

from steadypose.msgs.types import JointState
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.kinematics import heading, rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.camera.key_points import KeyPointRecording
from steadypose.prior.fit import picture
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.observations import KeyPoints, Pinhole, SeenJoints, SurfacePoints
from steadypose.prior.fit.picture import arrays_of_fit, fit_key_points, lift, starts_of_key_points, track_of_key_points
from steadypose.prior.fit.solve import FitSettings, Start
from steadypose.prior.fit.windows import FittedTrack

FRAMES, HEIGHT = 40, 1.3
OPTICAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
TOES = [J["left_foot"], J["right_foot"]]


def camera() -> Pinhole:
    return Pinhole(
        torch.tensor([900.0, 900.0]), torch.tensor([640.0, 360.0]), torch.from_numpy(OPTICAL).float(), torch.zeros(3)
    )


def person(yaw: float, size: float = 1.0) -> np.ndarray:
    """(T, 22, 3) somebody who stands in the rest pose, 4 m away, with both feet on the floor."""
    offsets = REST_OFFSETS * size
    rotations = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    rotations[:, 0] = yaw_matrix(np.full(FRAMES, yaw))
    joints = place_joints(rotations, offsets)
    floor = joints[0, TOES, 2].min() - 0.015
    return joints + np.array([0.1, 4.0, -HEIGHT - floor])


def pixels(joints: np.ndarray) -> np.ndarray:
    return camera().project(torch.from_numpy(joints).float()).double().numpy()


def joints_of(start: Start) -> np.ndarray:
    placed = place_joints(start.rotations.double().numpy(), start.offsets.double().numpy())
    return placed + start.root.double().numpy()[:, None]


def off(start: Start, truth: np.ndarray) -> float:
    """Metres, but for the arms, which start downwards."""
    error = np.linalg.norm(joints_of(start) - truth, axis=-1)
    return float(
        np.delete(error, [J[f"{s}_{p}"] for s in ("left", "right") for p in ("elbow", "wrist")], axis=1).mean()
    )


@pytest.mark.parametrize("yaw", [-1.2, -0.4, 0.3, 1.3, 2.4])
def test_toes_say_which_side_is_the_far_one(yaw: float) -> None:
    truth = person(yaw)
    told = pixels(truth)
    (start,) = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert off(start, truth) < 0.25
    assert np.cos(heading(start.rotations[:, 0].double().numpy()) - yaw).min() > np.cos(0.4)
    told[:, TOES] = np.nan
    starts = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert len(starts) == 2
    assert min(off(start, truth) for start in starts) < 0.25


@pytest.mark.parametrize("yaw", [-np.pi / 2, np.pi / 2])
def test_who_is_wider_than_bones_allow_is_turned_to_the_camera_or_away_from_it(yaw: float) -> None:
    told = pixels(person(yaw))
    wide = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "shoulder")]
    told[:, wide, 0] += 0.4 * (told[:, wide, 0] - told[:, wide, 0].mean(axis=1, keepdims=True))
    for start in starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT):
        assert np.cos(heading(start.rotations[:, 0].double().numpy()) - yaw).min() > np.cos(0.2)


@pytest.mark.parametrize("size", [0.7, 1.0, 1.1])
def test_a_known_floor_says_how_large_somebody_is(size: float) -> None:
    truth = person(0.2, size)
    known, guessed = (
        starts_of_key_points(pixels(truth), camera(), REST_OFFSETS, -HEIGHT, floor_known=known)[0]
        for known in (True, False)
    )
    height = np.abs(known.offsets.numpy()[:, 2]).sum() / np.abs(REST_OFFSETS[:, 2]).sum()
    assert height == pytest.approx(size, rel=0.1)
    assert known.root[:, 1].mean() == pytest.approx(4.0, abs=0.25)
    np.testing.assert_allclose(guessed.offsets.numpy(), REST_OFFSETS, atol=1e-6)


@pytest.mark.parametrize("floor", [-0.4, -4.0, 0.5])
def test_a_floor_on_which_nobody_can_stand_is_not_believed(floor: float) -> None:
    told = pixels(person(0.2))
    (start,) = starts_of_key_points(told, camera(), REST_OFFSETS, floor, floor_known=True)
    np.testing.assert_allclose(start.offsets.numpy(), REST_OFFSETS, atol=1e-6)


def test_without_feet_bones_say_how_far_somebody_is() -> None:
    truth = person(0.2)
    told = pixels(truth)
    told[:, [J[f"{side}_{part}"] for side in ("left", "right") for part in ("ankle", "foot")]] = np.nan
    starts = starts_of_key_points(told, camera(), REST_OFFSETS, -HEIGHT, floor_known=True)
    assert min(off(start, truth) for start in starts) < 0.4


def test_key_points_are_as_deep_as_the_surface_about_them() -> None:
    truth = person(0.2)
    rng = np.random.default_rng(0)
    points = np.repeat(truth, 4, axis=1) + 0.01 * rng.standard_normal((FRAMES, 88, 3)) - [0.0, 0.05, 0.0]
    points[:, ::3] = np.nan
    points[0] = np.nan
    told = pixels(truth)
    told[5, 4] = np.nan
    found = lift(told, camera(), points)
    assert np.isnan(found[0]).all()
    assert np.isnan(found[5, 4]).all()
    error = np.linalg.norm(found - truth, axis=-1)
    assert np.isfinite(error[1:]).mean() > 0.95
    assert np.nanpercentile(error, 90) < 0.1


def test_points_behind_the_camera_or_beside_the_body_say_nothing() -> None:
    truth = person(0.2)
    behind, beside = -truth[:, :3], truth[:, :3] + [1.5, 0.0, 0.0]
    for points in (np.concatenate([behind, beside], axis=1), np.empty((FRAMES, 0, 3))):
        assert np.isnan(lift(pixels(truth), camera(), points)).all()


def recording(joints: np.ndarray, points: np.ndarray | None = None, height: float | None = HEIGHT) -> KeyPointRecording:
    """Of joints and points (T, N, 3) metres, world, as `camera` has them."""
    return KeyPointRecording(
        np.arange(FRAMES), pixels(joints), np.full((FRAMES, 22), 0.5), camera().focal.numpy(), camera().centre.numpy(),
        OPTICAL, height, None if points is None else points @ OPTICAL,
    )  # fmt: skip


def test_depth_is_observed_too_and_half_of_the_frames_cleaned_are_a_start() -> None:
    joints = person(0.2) + 0.01 * np.arange(FRAMES, dtype=np.float64)[:, None, None]
    points = np.repeat(joints, 4, axis=1) - np.array([0.0, 0.05, 0.0])

    def track(known: list[int]) -> picture.Track:
        cleaned = np.full_like(joints, np.nan)
        cleaned[known] = joints[known]
        return track_of_key_points(recording(joints, points), lambda lifted: cleaned)

    known = [*range(10, 20), *range(25, 35)]
    (start,) = (found := track(known)).starts
    nearest = [10] * 10 + [*range(10, 20)] + [19] * 3 + [25] * 2 + [*range(25, 35)] + [34] * 5
    np.testing.assert_allclose(start.root.numpy(), joints[nearest, 0], atol=1e-5)
    np.testing.assert_allclose(joints_of(start), joints[nearest], atol=0.01)
    assert start.ground == -HEIGHT
    flat = track_of_key_points(recording(joints), lambda lifted: joints)
    for fewer in (flat, track(known[1:])):
        torch.testing.assert_close(
            fewer.starts[0].root,
            starts_of_key_points(pixels(joints), camera(), REST_OFFSETS, -HEIGHT, floor_known=True)[0].root,
        )
    keys, surface, deep = found.observed
    assert isinstance(keys, KeyPoints)
    assert keys.sigma == 9.0, "a hundredth of the focal length"
    assert isinstance(surface, SurfacePoints)
    assert isinstance(deep, SeenJoints)
    np.testing.assert_allclose(surface.points.numpy(), points, atol=1e-5)
    np.testing.assert_allclose(deep.positions.numpy(), lift(pixels(joints), camera(), points), atol=1e-4)
    assert (deep.sigma == 0.08).all()
    assert [type(one) for one in flat.observed] == [KeyPoints]


def test_a_camera_whose_height_nobody_states_is_guessed_and_its_floor_may_move(monkeypatch: pytest.MonkeyPatch) -> None:
    joints, given = person(0.2, 1.1), []
    model = HumorNet(HumorConfig(hidden=64, latent=2))
    monkeypatch.setattr(picture, "fit_track", lambda model, track, settings, *_, **__: given.append((track, settings)))
    for height in (None, 1.0):
        fit_key_points(model, recording(joints, height=height), FitSettings(), None, lambda lifted: lifted)
    (guessed, loose), (stated, firm) = given
    assert (guessed.starts[0].ground, loose.ground_height_sigma) == (-1.3, 0.3)
    assert (stated.starts[0].ground, firm.ground_height_sigma) == (-1.0, FitSettings().ground_height_sigma)
    np.testing.assert_allclose(guessed.starts[0].offsets.numpy(), REST_OFFSETS, atol=1e-6)


def test_what_is_written_is_in_the_cameras_frame() -> None:
    told = recording(joints := person(0.7))
    told.pixels[3, 4] = np.nan
    moving = joints + np.arange(FRAMES, dtype=np.float64)[:, None, None] * np.array([0.02, 0.0, 0.01])
    rotations = np.tile(np.eye(3), (FRAMES, 22, 1, 1))
    rotations[:, 0] = yaw_matrix(np.full(FRAMES, 0.7))
    load = np.random.default_rng(0).uniform(size=(FRAMES, 8))
    none = np.zeros((1, 3))
    kept = rotations.copy()
    found = arrays_of_fit(
        told, FittedTrack(moving, rotations, REST_OFFSETS[None], none, load, none, none, np.array([True]))
    )
    np.testing.assert_array_equal(rotations, kept)
    placed = place_joints(rotation_matrices(found["rotations"].astype(float)), REST_OFFSETS)
    np.testing.assert_allclose(placed + found["positions"][:, :1], found["positions"], atol=1e-5)
    np.testing.assert_allclose(found["positions"] @ OPTICAL.T, moving, atol=1e-5)
    np.testing.assert_allclose(found["root_velocity"], np.tile([0.6, 0.0, 0.3], (FRAMES, 1)), atol=1e-9)
    np.testing.assert_allclose(found["contacts"], load, atol=1e-6)
    assert np.argwhere(found["state"] == JointState.IMPUTED).tolist() == [[3, 4]]
    assert (found["state"] == JointState.REFINED).sum() == FRAMES * 22 - 1
    assert np.isnan(found["sigma"]).all()
    assert not found["anomaly_flag"].any()


def test_a_camera_that_stands_elsewhere_sees_the_same_there() -> None:
    told, away = pixels(person(0.2, 1.1)), np.array([0.5, -0.3, 0.8])
    moved = Pinhole(camera().focal, camera().centre, camera().rotation, torch.from_numpy(away).float())
    here, there = (
        starts_of_key_points(told, taken, REST_OFFSETS, ground, floor_known=True)[0]
        for taken, ground in ((camera(), -HEIGHT), (moved, away[2] - HEIGHT))
    )
    np.testing.assert_allclose(joints_of(there), joints_of(here) + away, atol=1e-4)
    surface = np.repeat(person(0.2, 1.1), 4, axis=1) - [0.0, 0.05, 0.0]
    lifted = lift(told, moved, surface + away)
    np.testing.assert_allclose(lifted, lift(told, camera(), surface) + away, atol=1e-4)
