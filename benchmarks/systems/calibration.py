"""How well `prior.camera.calibration` finds a lens and a camera's place, on rendered pictures whose truth is known.

Pictures are of the board that `steadypose calibrate board` prints: perspective and lens distortion by following every
pixel's ray, four rays a pixel; then blur, uneven light and noise.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.msgs.types import Pose
from steadypose.prior.arrays import Floats
from steadypose.prior.camera.calibration import (
    Board,
    Corners,
    Intrinsics,
    calibrate_lens,
    camera_pose,
    find_corners,
    floor_pose,
)

DEPENDS_ON = ()

LENS = Intrinsics((1280, 720), (860.0, 855.0), (645.0, 352.0), (0.05, -0.12, 0.0008, -0.0005, 0.03))
"""of an OAK's colour camera, about; the distortion is stronger"""
BOARD = Board()
_PIXELS_PER_SQUARE = 200


@dataclass(frozen=True)
class Args:
    """Errors of lens and camera pose on rendered pictures."""

    cameras: int = 20
    """places from which the board, or the floor, is looked at"""
    pictures: int = 3
    """of the board on the floor, each with noise of its own"""
    views: int = 20
    """pictures that the lens is calibrated from"""
    out: Path = RESULTS
    """folder for the JSON file"""


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
    paper = np.pad(BOARD.picture(_PIXELS_PER_SQUARE), margin, constant_values=255)
    per_metre = _PIXELS_PER_SQUARE / BOARD.square
    x = floor[..., 0] * per_metre + margin - 0.5
    y = (BOARD.size[1] - floor[..., 1]) * per_metre + margin - 0.5
    # the texture at the scale at which it is seen, as a camera's pixel averages over what it covers
    scale = max(1.0, per_metre * float(np.nanmedian(np.where(np.isfinite(reach), reach, np.nan))) / lens.focal[0] / 2)
    paper = cv2.GaussianBlur(paper, (0, 0), 0.5 * scale)
    seen = cv2.remap(
        paper.astype(np.float32),
        np.nan_to_num(x, nan=-1e6).astype(np.float32),
        np.nan_to_num(y, nan=-1e6).astype(np.float32),
        cv2.INTER_LINEAR,
        borderValue=110.0,
    )
    seen = cv2.resize(seen, lens.size, interpolation=cv2.INTER_AREA)
    slope = rng.uniform(-0.25, 0.25, 2)
    light = 0.8 + np.add.outer(np.linspace(-1, 1, lens.size[1]) * slope[1], np.linspace(-1, 1, lens.size[0]) * slope[0])
    seen = cv2.GaussianBlur(seen * np.clip(light, 0.4, 1.0), (0, 0), blur) + rng.normal(0.0, noise, seen.shape)
    return np.clip(np.round(seen), 0, 255).astype(np.uint8)


def corners_of(pose: Pose, looks: Floats, rng: np.random.Generator) -> Corners | None:
    """What is found of the board in a picture with the blur and noise of an ordinary room."""
    return find_corners(picture(pose, LENS, looks, rng, blur=rng.uniform(0.6, 1.1), noise=rng.uniform(2.0, 5.0)), BOARD)


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
    """Millimetres and degrees between two poses."""
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


def main(args: Args) -> None:
    """Measure, print, write."""
    require_committed(args.out)
    console, rng = Console(), np.random.default_rng(1)
    looks = rays(LENS, finer=2)
    views = [corners_of(pose, looks, rng) for pose, _ in zip(held_poses(rng), range(args.views), strict=False)]
    lens = calibrate_lens([view for view in views if view], LENS.size)
    found: dict[str, list[tuple[float, float]]] = {"board, lens calibrated": [], "board, lens known": [], "floor": []}
    missed = 0
    for pose, _ in track(zip(floor_poses(rng), range(args.cameras), strict=False), "cameras", total=args.cameras):
        seen = [view for view in (corners_of(pose, looks, rng) for _ in range(args.pictures)) if view]
        missed += not seen
        if seen:
            found["board, lens calibrated"].append(error(camera_pose(seen, lens).pose, pose))
            found["board, lens known"].append(error(camera_pose(seen, LENS).pose, pose))
        # gravity as an IMU of a degree tells it; the floor knows no heading and no place on it
        up = Rotation.from_rotvec(rng.normal(0.0, np.radians(1.0), 3)).apply(
            Rotation.from_quat(pose.orientation).inv().apply([0.0, 0.0, 1.0])
        )
        level = floor_pose(depth_points(pose, rng), up)[0]
        true_up = Rotation.from_quat(pose.orientation).inv().apply([0.0, 0.0, 1.0])
        tilt = np.arccos(np.clip(true_up @ Rotation.from_quat(level.orientation).inv().apply([0.0, 0.0, 1.0]), -1, 1))
        found["floor"].append((1e3 * abs(level.position[2] - pose.position[2]), float(np.degrees(tilt))))
    data = {
        "lens": {"focal": lens.focal, "centre": lens.centre, "error_px": lens.error_px, "views": args.views},
        "lens_truth": {"focal": LENS.focal, "centre": LENS.centre},
        "cameras_without_the_board": missed,
        "errors_mm_degrees": found,
    }
    table = _table(found, lens, missed)
    show(table, console)
    console.print(f"wrote {save('calibration', sys.argv[1:], [table], data, DEPENDS_ON, args.out)}")


def _table(found: dict[str, list[tuple[float, float]]], lens: Intrinsics, missed: int) -> Table:
    rows = []
    for name, errors in found.items():
        mm, degrees = np.array(errors).T
        rows.append(
            [name, str(len(mm)), *(f"{f(mm):.1f}" for f in (np.median, np.max))]
            + [f"{f(degrees):.2f}" for f in (np.median, np.max)]
        )
    focal = max(abs(a - b) / b for a, b in zip(lens.focal, LENS.focal, strict=True))
    return Table(
        name="calibration",
        title="Camera pose from rendered views, errors",
        columns=["from", "cameras", "mm, median", "mm, worst", "degrees, median", "degrees, worst"],
        rows=rows,
        note=f"1280 x 720; the lens calibrated: focal length {focal:.2%} off. {missed} cameras did not see the board. "
        "Floor: from depth and gravity; mm of height, degrees of tilt.",
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
