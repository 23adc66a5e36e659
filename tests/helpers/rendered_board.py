"""Pictures of the board that `steadypose calibrate board` prints, and depth of a room, whose camera is known.

Perspective and lens distortion by following every pixel's ray, four rays a pixel; then blur, uneven light and noise.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.prior.arrays import Floats
from steadypose.prior.camera.calibration import Board, Intrinsics

LENS = Intrinsics((1280, 720), (860.0, 855.0), (645.0, 352.0), (0.05, -0.12, 0.0008, -0.0005, 0.03))
"""Lens of an OAK's colour camera, about; the distortion is stronger."""
BOARD = Board()
_PIXELS_PER_SQUARE = 200


def rays(lens: Intrinsics, finer: int = 1) -> Floats:
    """(H, W, 3) where each pixel looks, optical frame, for a picture ``finer`` times as large along each side."""
    width, height = lens.size[0] * finer, lens.size[1] * finer
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    pixels = (np.stack([x, y], axis=-1).reshape(-1, 1, 2) + 0.5) / finer - 0.5
    exact = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-9)
    plane = np.float64(cv2.undistortPoints(pixels, lens.matrix, lens.coefficients, criteria=exact))
    return np.concatenate([plane.reshape(height, width, 2), np.ones((height, width, 1))], axis=-1)


def look_at(position: Floats, target: Floats, roll: float = 0.0) -> Pose:
    """The pose of an optical frame at a place (3,) that looks at another, z up."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward], axis=-1)
    return Pose(position, (Rotation.from_matrix(turn) * Rotation.from_euler("z", roll)).as_quat())


def picture(pose: Pose, lens: Intrinsics, looks: Floats, rng: np.random.Generator, blur: float, noise: float) -> Any:
    """The board flat on a grey floor, (H, W) uint8.

    Args:
        pose: of the camera.
        lens: of the camera.
        looks: `rays` of the lens, twice as fine.
        rng: of light and noise.
        blur: pixels, standard deviation.
        noise: grey levels, standard deviation.
    """
    turned = looks @ Rotation.from_quat(pose.orientation).as_matrix().T
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(turned[..., 2] < 0, -pose.position[2] / turned[..., 2], np.nan)
    floor = pose.position[:2] + turned[..., :2] * reach[..., None]
    margin = _PIXELS_PER_SQUARE // 2
    paper = np.pad(BOARD.image(_PIXELS_PER_SQUARE), margin, constant_values=255)
    per_metre = _PIXELS_PER_SQUARE / BOARD.square
    x = floor[..., 0] * per_metre + margin - 0.5
    y = (BOARD.size[1] - floor[..., 1]) * per_metre + margin - 0.5
    # the texture at the scale at which it is seen, as a camera's pixel averages over what it covers
    scale = max(1.0, per_metre * float(np.nanmedian(np.where(np.isfinite(reach), reach, np.nan))) / lens.focal[0] / 2)
    paper = cv2.GaussianBlur(paper, (0, 0), 0.5 * scale)
    seen = cv2.remap(
        paper.astype(np.float32), np.nan_to_num(x, nan=-1e6).astype(np.float32),
        np.nan_to_num(y, nan=-1e6).astype(np.float32), cv2.INTER_LINEAR, borderValue=110.0,
    )  # fmt: skip
    seen = cv2.resize(seen, lens.size, interpolation=cv2.INTER_AREA)
    slope = rng.uniform(-0.25, 0.25, 2)
    light = 0.8 + np.add.outer(np.linspace(-1, 1, lens.size[1]) * slope[1], np.linspace(-1, 1, lens.size[0]) * slope[0])
    seen = cv2.GaussianBlur(seen * np.clip(light, 0.4, 1.0), (0, 0), blur) + rng.normal(0.0, noise, seen.shape)
    return np.clip(np.round(seen), 0, 255).astype(np.uint8)


def held_poses(rng: np.random.Generator) -> Iterator[Pose]:
    """Camera poses as if the board were held in front of it: near, tilted, in all parts of the picture."""
    middle = np.array([*BOARD.size, 0.0]) / 2
    while True:
        away, tilt, around = rng.uniform(0.35, 0.9), rng.uniform(0.0, 0.8), rng.uniform(0.0, 2 * np.pi)
        side = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
        target = middle + np.array([*rng.uniform(-0.35, 0.35, 2) * away, 0.0])
        yield look_at(target + away * side, target, rng.uniform(-np.pi, np.pi))


def floor_poses(rng: np.random.Generator) -> Iterator[Pose]:
    """Cameras on tripods and shelves that look into the room, the board on the floor before them."""
    middle = np.array([*BOARD.size, 0.0]) / 2
    while True:
        around, away = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.8, 1.6)
        place = middle + np.array([away * np.cos(around), away * np.sin(around), rng.uniform(0.9, 1.6)])
        beyond = middle - rng.uniform(-0.2, 0.5) * (place - middle) * [1.0, 1.0, 0.0]
        yield look_at(place, beyond, rng.uniform(-0.1, 0.1))


def error(pose: Pose, truth: Pose) -> tuple[float, float]:
    turn = Rotation.from_quat(pose.orientation).inv() * Rotation.from_quat(truth.orientation)
    return 1e3 * float(np.linalg.norm(pose.position - truth.position)), float(np.degrees(turn.magnitude()))


def depth_points(pose: Pose, rng: np.random.Generator) -> Floats:
    """(N, 3) metres, optical frame: floor, back wall and a table, as stereo sees them: quantised, noisy, with holes."""
    small = Intrinsics((320, 200), (215.0, 215.0), (159.5, 99.5))
    looks = rays(small).reshape(-1, 3)
    turned = looks @ Rotation.from_quat(pose.orientation).as_matrix().T
    ahead = np.array([*(turned[len(turned) // 2, :2]), 0.0])
    ahead /= np.linalg.norm(ahead)
    with np.errstate(divide="ignore"):
        floor = np.where(turned[:, 2] < 0, -pose.position[2] / turned[:, 2], np.inf)
        table = np.where(turned[:, 2] < 0, (0.7 - pose.position[2]) / turned[:, 2], np.inf)
        wall = np.where(turned @ ahead > 0, 4.0 / (turned @ ahead), np.inf)
    place = pose.position + turned * np.where(np.isfinite(table), table, 0.0)[:, None]
    sideways = (place - pose.position) @ np.cross([0.0, 0.0, 1.0], ahead)
    forward = (place - pose.position) @ ahead
    table[~((sideways > 0.3) & (sideways < 1.3) & (forward > 1.5) & (forward < 2.2))] = np.inf
    depth = np.minimum(np.minimum(floor, wall), np.where(table > 0, table, np.inf))
    disparity = 0.075 * 430.0 / depth + rng.normal(0.0, 0.15, depth.shape)  # pixels at half of VGA, 75 mm apart
    depth = 0.075 * 430.0 / (np.round(disparity * 8) / 8)
    keep = (depth > 0.4) & (depth < 8.0) & (rng.random(depth.shape) > 0.15)
    return (looks * depth[:, None])[keep]


def write_video(path: Path, size: tuple[int, int], colours: Sequence[int | tuple[int, int, int]]) -> Path:
    """A video at 30 Hz of images of one colour each, blue first; returns ``path``."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, size)
    for colour in colours:
        writer.write(np.full((size[1], size[0], 3), colour, np.uint8))
    writer.release()
    return path
