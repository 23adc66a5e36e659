"""Files of `calibrate`: images, read and drawn with the estimated floor, and the launch file that is written."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomlkit
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.nodes.commands.output import unfinished
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.recording import VIDEOS
from steadypose.nodes.sources.registry import InputSettings
from steadypose.nodes.sources.webcam_device import stamped_images
from steadypose.prior.arrays import Floats
from steadypose.prior.camera.calibration import CalibrationError, Intrinsics

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_STEP_NS = 500_000_000  # between the images taken from a video: nearer ones show the same again
MAX_IMAGES = 60
AXIS_PX = 4
REACH_M = 6.0  # half the side of the grid that is drawn
Image = NDArray[np.uint8]


def read_images(paths: Sequence[Path]) -> Iterator[tuple[str, Image]]:
    """Images by name, from files, folders and videos. Raises CalibrationError if there are none, or one is damaged."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGES)
        elif path.is_file():
            files.append(path)
        else:
            raise CalibrationError(f"{path} does not exist: expected an image, a folder of images, or a video")
    if not files:
        where = f" in {', '.join(map(str, paths))}" if paths else ""
        raise CalibrationError(f"expected images ({', '.join(IMAGES)}), folders of them, or videos; got none{where}")
    if len(files) > MAX_IMAGES:
        print(f"of {len(files)} images the first {MAX_IMAGES} are taken")
    for file in track(files[:MAX_IMAGES], "reading", disable=len(files) < 2):
        if file.suffix.lower() in VIDEOS:
            yield from _frames(file)
            continue
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CalibrationError(f"{file}: expected an image that OpenCV reads, such as .png or .jpg")
        yield file.name, np.asarray(image, np.uint8)


def _frames(file: Path) -> Iterator[tuple[str, Image]]:
    taken = next_ns = 0
    for stamp_ns, image in stamped_images(cv2.VideoCapture(str(file))):
        if taken == MAX_IMAGES:
            break
        if image is not None and stamp_ns >= next_ns:
            taken, next_ns = taken + 1, stamp_ns + VIDEO_STEP_NS
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield f"{file.name} at {stamp_ns / 1e9:.1f} s", np.asarray(grey, np.uint8)
    if not taken:
        raise CalibrationError(f"{file}: expected a video that OpenCV reads, got no frame of it")


def read_depth(file: Path) -> NDArray[np.integer]:
    if not file.is_file():
        raise CalibrationError(f"{file} does not exist: expected a depth image, .png of 16 bits or .npy")
    try:
        depth = np.load(file) if file.suffix == ".npy" else cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    except Exception as error:  # of damaged bytes numpy's parser raises several kinds
        raise CalibrationError(f"{file}: cannot be read as .npy: {error}") from error
    if not isinstance(depth, np.ndarray) or depth.ndim != 2 or depth.dtype.kind not in "iu" or depth.dtype.itemsize < 2:
        shape = f"{depth.dtype} of shape {depth.shape}" if isinstance(depth, np.ndarray) else "nothing that can be read"
        raise CalibrationError(f"{file}: expected (H, W) integers of 16 bits, millimetres of depth, got {shape}")
    return np.asarray(depth, np.int64)


def draw_floor(image: Image, lens: Intrinsics, pose: Pose) -> Image:
    """A grey image (H, W) as BGR (H, W, 3), with the floor's grid, every metre bolder, and the world's axes.

    The grid lies around the point that the camera looks at, or stands above.
    """
    drawn = np.ascontiguousarray(np.repeat(image[:, :, None], 3, axis=2))
    turn = Rotation.from_quat(pose.orientation)
    forward = turn.apply([0.0, 0.0, 1.0])
    away = min(pose.position[2] / -forward[2], REACH_M) if forward[2] < 0 else REACH_M
    middle = np.round((pose.position + away * forward)[:2])
    ticks = np.arange(-REACH_M, REACH_M + 0.25, 0.5)
    along = np.linspace(-REACH_M, REACH_M, 400)
    lines: list[tuple[Floats, tuple[int, int, int], int]] = []
    for tick in ticks:
        for axis in (0, 1):
            line = np.zeros((len(along), 3))
            line[:, axis], line[:, 1 - axis] = middle[axis] + along, middle[1 - axis] + tick
            bold = abs(line[0, 1 - axis] % 1.0) < 1e-9
            lines.append((line, (200, 255, 120) if bold else (140, 180, 90), 2 if bold else 1))
    for axis, colour in enumerate(((60, 60, 255), (60, 220, 60), (255, 120, 60))):
        lines.append((np.linspace(0.0, 0.5, 50)[:, None] * np.eye(3)[axis], colour, AXIS_PX))
    back = turn.inv()
    half = 0.75 * np.array(lens.size) / lens.focal  # beyond, the distortion's polynomial means nothing
    for line, colour, thickness in lines:
        seen = back.apply(line - pose.position)
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = (seen[:, 2] > 0.1) & (np.abs(seen[:, :2] / seen[:, 2:]) < half).all(axis=1)
        pixels = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), lens.matrix, lens.coefficients)[0].reshape(-1, 2)
        for run in np.split(np.arange(len(line)), np.flatnonzero(~inside)):
            run = run[inside[run]]
            if len(run) > 1:
                points = np.round(pixels[run] * 16).astype(np.int32)[:, None]
                cv2.polylines(drawn, [points], False, colour, thickness, cv2.LINE_AA, shift=4)
        if thickness == AXIS_PX and inside[-1]:
            x, y = np.round(pixels[-1]).astype(int).tolist()
            name = "xyz"[int(np.argmax(line[-1]))]
            cv2.putText(drawn, name, (x + 6, y - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
    return drawn


def depth_image(depth: NDArray[np.integer]) -> Image:
    """Depth (H, W) in millimetres as grey, near light and far dark, as inverse depth is seen; black in holes."""
    near = np.percentile(depth[depth > 0], 1) if depth.any() else 1.0
    return (255 * np.clip(near / np.where(depth > 0, depth, np.inf), 0.0, 1.0)).astype(np.uint8)


def write_image(out: Path, image: NDArray[Any]) -> None:
    try:
        written = cv2.imwrite(str(out), image)
    except cv2.error:  # an ending it does not know
        written = False
    if not written:
        raise CalibrationError(f"{out} cannot be written: expected an image such as .png in a folder that exists")


def write_floor_grid(out: Path, image: Image, lens: Intrinsics, pose: Pose) -> None:
    write_image(out, draw_floor(image, lens, pose))
    print(f"{out}: the floor's grid, half a metre a square; it must lie on the floor, its axes where the world begins")


def read_launch(path: Path) -> Launch:
    if not path.is_file():
        raise LaunchError(f"no launch file at {path}: expected the camera's own; copy one of launch/ such as oak.toml")
    return Launch.read(path)


def lens_of(path: Path) -> Intrinsics:
    """The lens in a launch file's ``[input.calibration]``."""
    calibration = read_launch(path).settings(InputSettings).calibration
    if not calibration.size:
        raise CalibrationError(f"{path} has no lens in [input.calibration]: first run steadypose calibrate lens")
    width, height = calibration.size
    fx, fy = calibration.focal
    cx, cy = calibration.centre
    return Intrinsics((width, height), (fx, fy), (cx, cy), tuple(calibration.distortion))


def save_calibration(path: Path, *, lens: Intrinsics | None = None, pose: Pose | None = None) -> None:
    """Write a lens or a pose to ``[input.calibration]`` of a launch file, whose other content stays."""
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    section = document.setdefault("input", tomlkit.table()).setdefault("calibration", tomlkit.table())
    if lens:
        section["size"] = list(lens.size)
        for name in ("focal", "centre", "distortion"):
            section[name] = [round(value, 6) for value in getattr(lens, name)]
    if pose:
        section["position"] = [round(float(value), 5) for value in pose.position]
        section["orientation"] = [round(float(value), 7) for value in pose.orientation]
    with unfinished(path.resolve()) as part:  # the user's own file
        part.write_text(tomlkit.dumps(document), encoding="utf-8")
        shutil.copymode(path, part)
        Launch.read(part)
