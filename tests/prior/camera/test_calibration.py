import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.rendered_board import (
    BOARD,
    LENS,
    depth_points,
    error,
    floor_poses,
    held_poses,
    look_at,
    picture,
    rays,
)

from steadypose.msgs.types import Pose
from steadypose.prior.camera import calibration
from steadypose.prior.camera.calibration import CalibrationError, calibrate_lens, camera_pose, find_corners, floor_pose
from steadypose.prior.camera.gravity import GRAVITY, GravityEstimator, level_pose

INNER = np.array([[x, y, 0.0] for y in range(1, BOARD.rows) for x in range(1, BOARD.columns)]) * BOARD.square
EYE = look_at(np.array([-0.4, -1.0, 1.2]), np.array([0.2, 0.15, 0.0]))


def project(pose: Pose, points: np.ndarray, lens: calibration.Intrinsics = LENS) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) in the world, by the definition of the messages' pose."""
    seen = (points - pose.position) @ Rotation.from_quat(pose.orientation).as_matrix()
    x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
    k1, k2, p1, p2, k3 = lens.coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                     y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)  # fmt: skip
    return bent * lens.focal + lens.centre


def view(pose: Pose, rng: np.random.Generator, noise: float = 0.05) -> calibration.Corners:
    return calibration.Corners(INNER, project(pose, INNER) + rng.normal(0.0, noise, (len(INNER), 2)))


def test_corners_lie_where_the_world_says() -> None:
    """Of the board's world: x along the lower edge of the print, y up its left edge, z out of the paper."""
    seen = find_corners(picture(EYE, LENS, rays(LENS, finer=2), np.random.default_rng(0), blur=0.7, noise=2.0), BOARD)
    assert seen is not None
    assert len(seen.image) == len(INNER)
    assert np.quantile(np.abs(seen.image - project(EYE, seen.board)), 0.8) < 0.1
    assert {tuple(p) for p in np.round(seen.board, 6)} == {tuple(p) for p in np.round(INNER, 6)}


def test_what_shows_no_board_has_no_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300), dtype=np.uint8)
    assert find_corners(noise, BOARD) is None
    board = cv2.copyMakeBorder(BOARD.image(40), 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=(255,))
    assert find_corners(np.asarray(board, np.uint8), BOARD) is not None
    assert find_corners(np.asarray(board[:, ::-1], np.uint8).copy(), BOARD) is None, "a mirror image is no board"


def test_the_lens_is_found_though_in_one_picture_the_board_was_bent() -> None:
    rng = np.random.default_rng(0)
    views = [view(pose, rng) for pose, _ in zip(held_poses(rng), range(20), strict=False)]
    bent = dataclasses.replace(views[3], image=views[3].image + 40.0 * INNER[:, :1] ** 2 * [50.0, 80.0])
    lens = calibrate_lens([*views[:3], bent, *views[4:]], LENS.size)
    assert lens.focal == pytest.approx(LENS.focal, rel=2e-3)
    assert lens.centre == pytest.approx(LENS.centre, abs=3.0)
    assert lens.error_px == pytest.approx(0.05 * np.sqrt(2), rel=0.2)


def test_too_few_pictures_and_pictures_at_odds_are_refused() -> None:
    rng = np.random.default_rng(0)
    views = [view(pose, rng) for pose, _ in zip(held_poses(rng), range(8), strict=False)]
    with pytest.raises(CalibrationError, match="8 images or more"):
        calibrate_lens(views[:7], LENS.size)
    with pytest.raises(CalibrationError, match="of where the lens puts them"):
        calibrate_lens([dataclasses.replace(v, image=rng.uniform(0, 700, v.image.shape)) for v in views], LENS.size)


def test_pictures_that_are_too_much_alike_are_refused_though_their_error_is_small() -> None:
    """Of them a lens is found that is off by a factor of three, or fifty, and fits to a tenth of a pixel."""
    rng, middle = np.random.default_rng(0), np.array([*BOARD.size, 0.0]) / 2
    above = middle + [0.0, -0.1, 0.6]
    for eyes in (
        [above] * 15,
        [middle + [0.2, -0.4, 0.6]] * 15,
        [middle + [*rng.normal(0.0, 0.02, 2), rng.uniform(0.5, 0.9)] for _ in range(15)],
    ):
        with pytest.raises(CalibrationError, match="they are too much alike"):
            calibrate_lens([view(look_at(eye, middle), rng) for eye in eyes], LENS.size)


def test_the_place_is_as_sure_as_it_is_said_to_be() -> None:
    rng = np.random.default_rng(0)
    ratios = []
    for pose, _ in zip(floor_poses(rng), range(25), strict=False):
        found = camera_pose([view(pose, rng, noise=0.15)], LENS)
        millimetres, degrees = error(found.pose, pose)
        ratios.append([millimetres / 1e3 / found.sigma_m, np.radians(degrees) / found.sigma_rad])
    assert (np.quantile(ratios, 0.95, axis=0) < 2.5).all()
    assert (np.median(ratios, axis=0) > 0.3).all()


def test_a_board_or_camera_that_moved_is_refused() -> None:
    rng = np.random.default_rng(0)
    moved = dataclasses.replace(EYE, position=EYE.position + [0.1, 0.0, 0.0])
    with pytest.raises(CalibrationError, match="must not move"):
        camera_pose([view(EYE, rng), view(moved, rng)], LENS)
    with pytest.raises(CalibrationError, match="got none"):
        camera_pose([], LENS)


def test_the_floor_in_a_depth_image_tells_height_and_tilt_beside_a_table_and_a_wall() -> None:
    rng = np.random.default_rng(0)
    for pose, _ in zip(floor_poses(rng), range(4), strict=False):
        up = Rotation.from_quat(pose.orientation).inv().apply([0.0, 0.0, 1.0])
        felt = Rotation.from_rotvec([0.05, 0.0, 0.05]).apply(up)
        found, share = floor_pose(depth_points(pose, rng), felt)
        assert found.position == pytest.approx([0.0, 0.0, pose.position[2]], abs=0.01)
        told = Rotation.from_quat(found.orientation).inv().apply([0.0, 0.0, 1.0])
        assert np.degrees(np.arccos(told @ up)) < 0.3
        assert share > 0.2
        forward = Rotation.from_quat(found.orientation).apply([0.0, 0.0, 1.0])
        assert forward[0] == pytest.approx(0.0, abs=1e-9)
        assert forward[1] > 0, "looks along +y"


def test_a_view_without_a_floor_is_refused() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (5000, 2)), np.full(5000, 2.0)])
    with pytest.raises(CalibrationError, match="to be floor"):
        floor_pose(wall, np.array([0.0, -1.0, 0.0]))
    with pytest.raises(CalibrationError, match="100 points"):
        floor_pose(np.full((500, 3), np.nan), np.array([0.0, -1.0, 0.0]))
    with pytest.raises(CalibrationError, match="got 0"):
        floor_pose(calibration.points_of_depth(np.zeros((720, 1280), np.uint16), LENS), np.array([0.0, -1.0, 0.0]))
    down = Rotation.from_quat(EYE.orientation).inv().apply([0.0, 0.0, -1.0])
    with pytest.raises(CalibrationError, match=r"a plane 1\.20 m above it: is the direction upwards"):
        floor_pose(depth_points(EYE, rng), down)


def test_points_of_depth_lie_on_their_pixels_rays() -> None:
    lens = calibration.Intrinsics((64, 48), (50.0, 52.0), (31.0, 24.5), LENS.distortion)
    depth = np.zeros((48, 64), np.uint16)
    depth[10, 20], depth[40, 5] = 1500, 2500
    points = calibration.points_of_depth(depth, lens)
    assert points[:, 2] == pytest.approx([1.5, 2.5])
    assert project(Pose.identity(), points, lens) == pytest.approx(np.array([[20.0, 10.0], [5.0, 40.0]]), abs=1e-2)
    with pytest.raises(CalibrationError, match="64 x 48"):
        calibration.points_of_depth(depth.T, lens)


@pytest.mark.parametrize("board", [{"columns": 2}, {"square": 0.0}, {"square": float("nan")}])
def test_a_board_that_cannot_be_is_refused(board: dict) -> None:
    with pytest.raises(CalibrationError, match="3 to 20"):
        calibration.Board(**board)


SECOND_NS = 1_000_000_000


def turned(level: GravityEstimator, vector: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(level.pose.orientation).apply(vector)


@pytest.mark.parametrize("seed", range(5))
def test_up_points_up_and_the_camera_looks_along_y(seed: int) -> None:
    up = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_quat(level_pose(up).orientation)
    np.testing.assert_allclose(rotation.apply(up / np.linalg.norm(up)), [0, 0, 1], atol=1e-9)
    forward = rotation.apply([0.0, 0.0, 1.0])
    assert forward[0] == pytest.approx(0.0, abs=1e-9)
    assert forward[1] > 0


@pytest.mark.parametrize("up", [np.zeros(3), np.full(3, np.nan), np.ones(2)])
def test_what_is_no_direction_is_refused(up: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected a direction"):
        level_pose(up)


def test_noise_does_not_shake_the_world_and_turning_the_camera_turns_it() -> None:
    level, rng = GravityEstimator(), np.random.default_rng(0)
    assert not level.measured
    told = set()
    for n in range(500):
        level.update(GRAVITY * np.array([0, -1, 0]) + rng.normal(0, 0.1, 3), n * SECOND_NS // 100)
        told.add(tuple(level.pose.orientation))
    assert level.measured
    assert len(told) <= 3
    np.testing.assert_allclose(turned(level, np.array([0, -1, 0])), [0, 0, 1], atol=0.03)
    up = np.array([0.0, -np.cos(0.3), np.sin(0.3)])
    for n in range(500, 1100):
        level.update(GRAVITY * up + rng.normal(0, 0.1, 3), n * SECOND_NS // 100)
    np.testing.assert_allclose(turned(level, up), [0, 0, 1], atol=0.03)


def test_a_camera_that_is_shaken_keeps_its_level() -> None:
    level = GravityEstimator()
    level.update(np.array([0.0, -GRAVITY, 0.0]), 0)
    before = level.pose
    for n in range(1, 100):
        level.update(np.array([12.0, -GRAVITY, 5.0]), n * SECOND_NS // 100)
        level.update(np.full(3, np.nan), n * SECOND_NS // 100)
    assert level.pose is before
