"""Camera calibration: intrinsics from images of a ChArUco board, extrinsics from the board or a view of the floor.

The camera's frame is the optical frame: x right, y down, z forward. The world is z up with the floor at z = 0. If a
board lies flat, the world's origin is the lower left corner of the pattern as one reads it, with x along the lower edge
and y along the left edge.

Lens: Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, as in OpenCV. Plane: RANSAC
(Fischler and Bolles, CACM 24(6), 1981), then least squares over its inliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.prior.arrays import Floats
from steadypose.prior.camera.gravity import level_pose

Image = NDArray[np.uint8]

MIN_CORNERS, MIN_VIEWS = 6, 8  # least number of the board's corners in an image, and least number of such images

MIN_TILT = np.radians(20.0)
"""Least angle between the board's planes in two images, radians; parallel planes do not determine the focal length."""

MAX_FOCAL_SIGMA = 0.01  # largest relative standard deviation of a focal length that is accepted

OUTLIER_RATIO = 3.0
"""Ratio of an image's error to the median above which it is rejected, because the board was bent or moved."""

CORNER_SIGMA_PX, CORNER_SCALE_PX, CORNER_QUANTILE = 0.05, 0.3, 0.8
"""Standard deviation of a clearly visible corner, and scale of the robust loss, pixels; quantile of the corners'
reprojection errors that decides whether a pose is accepted."""

MAX_RMS_PX = 2.0  # largest root mean square reprojection error of a result that is accepted, pixels

FLOOR_SLACK, FLOOR_SHARE, FLOOR_TILT = 0.02, 0.1, np.radians(10.0)
"""Largest distance of an inlier from the floor, metres; least share of inliers; largest angle between the floor's
normal and the assumed up direction, radians."""


class CalibrationError(ValueError):
    """The input does not determine the calibration; the message says what was expected, found, and what to do."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares."""

    columns: int = 7  # numbers of squares
    rows: int = 5
    square: float = 0.056  # metres, side of a square, measured on the print
    marker: float = 0.75  # side of a marker as a share of a square's side

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 20 and 3 <= self.rows <= 20 and 0.005 <= self.square <= 1.0):
            raise CalibrationError(
                "board: expected 3 to 20 columns and rows and squares of 0.005 to 1 metres, "
                f"got {self.columns} x {self.rows} of {self.square:g}"
            )

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern, metres."""
        return self.columns * self.square, self.rows * self.square

    @cached_property
    def pattern(self) -> cv2.aruco.CharucoBoard:
        """The board as an OpenCV object, with 4x4 markers, which are recognised from the largest distance."""
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker * self.square, dictionary)

    def image(self, pixels_per_square: int) -> Image:
        """Return the pattern for printing, (rows * pixels, columns * pixels), without a margin."""
        return np.asarray(
            self.pattern.generateImage((self.columns * pixels_per_square, self.rows * pixels_per_square)), np.uint8
        )


@dataclass(frozen=True)
class Corners:
    """The board's corners in an image."""

    board: Floats  # (N, 3) metres, in the world of a board that lies flat
    image: Floats  # (N, 2) pixels


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera, in OpenCV's convention."""

    size: tuple[int, int]  # pixels, width and height of the images
    focal: tuple[float, float]  # (fx, fy) pixels
    centre: tuple[float, float]  # (cx, cy) pixels
    distortion: tuple[float, ...] = ()  # k1, k2, p1, p2, k3 of the Brown-Conrady model; empty for none
    error_px: float = field(default=0.0, compare=False)  # root mean square reprojection error

    @property
    def matrix(self) -> Floats:
        """(3, 3)."""
        return np.array([[self.focal[0], 0.0, self.centre[0]], [0.0, self.focal[1], self.centre[1]], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Floats:
        """(5,) of distortion."""
        return np.array([*self.distortion, *[0.0] * (5 - len(self.distortion))])


def find_corners(grey: Image, board: Board) -> Corners | None:
    """Detect the board's corners in an image (H, W) or (H, W, 3); None if too few are visible."""
    detector = cv2.aruco.CharucoDetector(board.pattern)
    points, image = np.zeros((0, 3)), np.zeros((0, 2))
    for finer in (1, 2):  # enlarging helps to read small markers; large corners are detected better without it
        enlarged = cv2.resize(grey, None, fx=finer, fy=finer, interpolation=cv2.INTER_CUBIC)
        corners, ids, _, _ = detector.detectBoard(enlarged)
        if ids is not None and len(ids) > len(points):
            on_board, on_image = board.pattern.matchImagePoints(corners, ids)  # pyright: ignore
            points = np.asarray(on_board, np.float64).reshape(-1, 3)
            image = (np.asarray(on_image, np.float64).reshape(-1, 2) + 0.5) / finer - 0.5
        if len(points) == (board.columns - 1) * (board.rows - 1):
            break
    if len(points) < MIN_CORNERS:
        return None
    if len(np.unique(points[:, 0])) < 2 or len(np.unique(points[:, 1])) < 2:
        return None  # collinear corners do not determine the board's plane
    # OpenCV counts from the upper left corner, y down and z into the board
    flat = np.array([0.0, board.size[1], 0.0]) + points * [1.0, -1.0, -1.0]
    return Corners(flat, image)


def calibrate_lens(views: Sequence[Corners], size: tuple[int, int]) -> Intrinsics:
    """Estimate the intrinsics from images of one board in many positions.

    Args:
        views: corners in images of the same size.
        size: pixels, width and height of the images.

    Raises:
        CalibrationError: there are too few images, they do not agree, or they are too similar.
    """
    kept = [view for view in views if len(view.image) >= MIN_CORNERS]
    while True:
        if len(kept) < MIN_VIEWS:
            raise CalibrationError(
                f"expected {MIN_VIEWS} images or more that show the board well, got {len(kept)}: take 15 to 25, "
                "the board near and far, tilted to all sides, in the middle and in every corner of the image"
            )
        error, matrix, distortion, turns, _, sigma, _, errors = cv2.calibrateCameraExtended(
            [view.board.astype(np.float32) for view in kept],
            [view.image.astype(np.float32) for view in kept],
            size,
            np.eye(3),
            np.zeros(5),
        )
        errors = np.ravel(errors)
        bad = errors > max(OUTLIER_RATIO * float(np.median(errors)), 0.5)
        if not bad.any():
            break
        kept = [view for view, out in zip(kept, bad, strict=True) if not out]
    if not error < MAX_RMS_PX:
        raise CalibrationError(
            f"expected corners within {MAX_RMS_PX:g} pixels of where the lens puts them, got {error:.1f}: is the "
            "board flat, the number of squares as printed, and every image from the same camera and resolution?"
        )
    focal = matrix[[0, 1], [0, 1]]
    unsure = float((np.ravel(sigma)[:2] / focal).max())
    normals = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()[:, :, 2]
    tilt = float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0).min()))
    if tilt < MIN_TILT or not unsure < MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"expected images that determine the focal length to {MAX_FOCAL_SIGMA:.0%}, with the board tilted by "
            f"{np.degrees(MIN_TILT):.0f} degrees or more from one to another, got {unsure:.1%} and "
            f"{np.degrees(tilt):.0f} degrees: they are too much alike; tilt the board to all sides, near and far"
        )
    return Intrinsics(
        size=(int(size[0]), int(size[1])),
        focal=(float(focal[0]), float(focal[1])),
        centre=(float(matrix[0, 2]), float(matrix[1, 2])),
        distortion=tuple(np.ravel(distortion).tolist()[:5]),
        error_px=float(error),
    )


@dataclass(frozen=True)
class Placement:
    """Extrinsics of a camera."""

    pose: Pose  # of its optical frame in the world
    error_px: float  # 80th percentile of the corners' reprojection error, pixels
    sigma_m: float  # metres, standard deviation of the position along the worst axis
    sigma_rad: float  # radians, standard deviation of the orientation about the worst axis


def camera_pose(views: Sequence[Corners], lens: Intrinsics) -> Placement:
    """Estimate the extrinsics from images of a board that lies flat on the floor. Neither camera nor board may move.

    Raises:
        CalibrationError: there is no image, or the corners do not fit one pose of the board.
    """
    if not views:
        raise CalibrationError("expected an image that shows the board on the floor, got none with enough corners")
    points = np.concatenate([view.board for view in views])
    image = np.concatenate([view.image for view in views])
    # a distant plane has two poses that look almost the same: take the better one of those above the floor
    _, turns, moves, _ = cv2.solvePnPGeneric(points, image, lens.matrix, lens.coefficients, flags=cv2.SOLVEPNP_IPPE)
    starts = [np.asarray([*turn, *move], np.float64).ravel() for turn, move in zip(turns, moves, strict=True)]
    placed = [_refined(points, image, lens, start) for start in starts]
    above = [placement for placement in placed if placement.pose.position[2] > 0]
    if not above:
        raise CalibrationError(
            "the board is seen from below: lay it face up, and leave it as it is printed (no mirror image)"
        )
    best = min(above, key=lambda placement: placement.error_px)
    if not best.error_px < MAX_RMS_PX:
        raise CalibrationError(
            f"expected the corners within {MAX_RMS_PX:g} pixels of one place of the board, got {best.error_px:.1f}: "
            "camera and board must not move between the images, and the lens must be of this camera and resolution"
        )
    return best


def _refined(points: Floats, image: Floats, lens: Intrinsics, start: Floats) -> Placement:
    """Refine an initial pose (6,), rotation vector and translation.

    Errors have the Cauchy loss, so a corner detected wrongly (under glare or a crease) has no influence.
    """

    def away(pose: Floats) -> Floats:
        projected = cv2.projectPoints(points, pose[:3], pose[3:], lens.matrix, lens.coefficients)[0]
        return (projected.reshape(-1, 2) - image).ravel()

    fit = least_squares(away, start, loss="cauchy", f_scale=CORNER_SCALE_PX, x_scale="jac")
    turn, move = fit.x[:3], fit.x[3:]
    error = float(np.quantile(np.linalg.norm(away(fit.x).reshape(-1, 2), axis=1), CORNER_QUANTILE))
    to_world = Rotation.from_rotvec(turn).inv()
    # by the Gauss-Markov theorem; the camera's position is -R^T t, so both errors affect it
    covariance = max(error, CORNER_SIGMA_PX) ** 2 * np.linalg.inv(fit.jac.T @ fit.jac)
    nudged = Rotation.from_rotvec(turn + 1e-6 * np.eye(3)).inv().apply(move)
    place = np.column_stack([(to_world.apply(move) - nudged).T / 1e-6, -to_world.as_matrix()])
    return Placement(
        pose=Pose(-to_world.apply(move), to_world.as_quat()),
        error_px=error,
        sigma_m=float(np.sqrt(np.linalg.eigvalsh(place @ covariance @ place.T)[-1])),
        sigma_rad=float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
    )


def points_of_depth(depth: NDArray[np.integer], lens: Intrinsics) -> Floats:
    """Convert a depth image (H, W) in millimetres, 0 where invalid, to points (N, 3) metres, optical frame.

    Raises:
        CalibrationError: the image does not have the size of the intrinsics.
    """
    height, width = depth.shape
    if (width, height) != lens.size:
        raise CalibrationError(
            f"expected a depth image of {lens.size[0]} x {lens.size[1]} pixels, as the lens was calibrated for, "
            f"got {width} x {height}"
        )
    rows, columns = np.nonzero(depth)
    if not len(rows):  # which OpenCV does not undistort
        return np.zeros((0, 3))
    z = depth[rows, columns].astype(np.float64) / 1000.0
    pixels = np.stack([columns, rows], axis=-1).astype(np.float64)
    rays = cv2.undistortPoints(pixels[:, None], lens.matrix, lens.coefficients).reshape(-1, 2)
    return np.column_stack([rays * z[:, None], z])


def floor_pose(points: Floats, up: Floats) -> tuple[Pose, float]:
    """Estimate the extrinsics of a camera that sees the floor, and the share of points on it. It is above the world's
    origin and looks along +y.

    The floor is the lowest of the large, approximately level planes of points (N, 3) metres, optical frame; ``up`` (3,)
    is within `FLOOR_TILT` of upwards. Raises CalibrationError if no floor is visible.
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise CalibrationError(f"expected a depth image with 100 points or more, got {len(points)}")
    rng = np.random.default_rng(0)
    sample = points[rng.choice(len(points), min(len(points), 4000), replace=False)]
    a, b, c = sample[rng.integers(len(sample), size=(1000, 3))].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals *= (np.sign(normals @ up) / np.maximum(length, 1e-6))[:, None]
    level = (length >= 1e-6) & (normals @ up >= np.cos(FLOOR_TILT))
    normals, heights = normals[level], (normals[level] * a[level]).sum(axis=1)
    off = sample @ normals.T - heights
    counts = (np.abs(off) < FLOOR_SLACK).sum(axis=0)
    # a table is a plane too: if points lie below a plane, it is not the floor
    counts[(off < -3 * FLOOR_SLACK).sum(axis=0) >= 0.3 * counts] = 0
    if not counts.any() or counts.max() < FLOOR_SHARE * len(sample):
        raise CalibrationError(
            f"expected {FLOOR_SHARE:.0%} of what the camera sees to be floor, level to {np.degrees(FLOOR_TILT):.0f} "
            "degrees; turn the camera down, clear the floor, or use the board"
        )
    normal, height = normals[counts.argmax()], heights[counts.argmax()]
    for slack in (2 * FLOOR_SLACK, FLOOR_SLACK):
        on_floor = points[np.abs(points @ normal - height) < slack]
        middle = on_floor.mean(axis=0)
        axes = np.linalg.eigh(np.cov((on_floor - middle).T))[1]
        normal = axes[:, 0] * np.sign(axes[:, 0] @ up)
        height = float(normal @ middle)
    if height > 0:
        raise CalibrationError(
            f"expected the floor below the camera, got a plane {height:.2f} m above it: is the direction upwards? That "
            "of gravity is downwards: negate it"
        )
    share = float((np.abs(points @ normal - height) < FLOOR_SLACK).mean())
    return Pose(np.array([0.0, 0.0, -height]), level_pose(normal).orientation), share
