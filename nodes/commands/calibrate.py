"""``steadypose calibrate``: a camera's lens, and where it stands in the world, into its launch file."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import matplotlib
import numpy as np
import tomlkit
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.progress import track
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.nodes.graph.launch import Launch, LaunchError
from steadypose.prior.camera.calibration import (
    LEAST_CORNERS,
    Board,
    CalibrationError,
    Intrinsics,
    calibrate_lens,
    camera_pose,
    find_corners,
    floor_pose,
    points_of_depth,
)

if TYPE_CHECKING:
    from steadypose.nodes.sources.oak_still import Still

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm")
VIDEO_STEP_S = 0.5
"""between the pictures taken from a video: nearer ones show the same again"""
MOST_PICTURES = 60
PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "letter": (279.4, 215.9)}
SURE_M = 0.005
"""a place less sure than this is worth another try"""
DPI = 300
AXIS_PX = 4
_MARGIN_MM = 8.0
_INCH_MM = 25.4


@dataclass(frozen=True)
class PrintBoard:
    """Make the board to print: a PDF or PNG at its true size.

    Print it at 100 % ("actual size", not "fit to page"), glue it to something flat and stiff, and measure a square: all
    other steps want its side in metres as --square. A3 lets a camera stand farther away than A4.

    Try:
      steadypose calibrate board board.pdf
      steadypose calibrate board board.pdf --paper a4

    Args:
        out: a .pdf or .png.
        paper: a3, a4 or letter, landscape.
        columns: squares along the lower edge.
        rows: squares along the left edge.
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    paper: str = "a3"
    columns: int = Board.columns
    rows: int = Board.rows


@dataclass(frozen=True)
class CalibrateLens:
    """The lens, from 15 to 25 pictures of the board.

    Hold the board in front of the camera, or the camera before the board: near and far, tilted to all sides, in the
    middle and in every corner of the picture; still each time, and the same resolution as in use. An OAK camera knows
    its lens and needs this only for the pictures of 'pose'.

    Try:
      steadypose calibrate lens kitchen.toml pictures/ --square 0.0561
      steadypose calibrate lens kitchen.toml video.mp4 --square 0.0561

    Args:
        launch: the launch file of this camera, your own copy of one; what is found goes into its [input.calibration].
        pictures: picture files, folders of them, or videos, of which two pictures a second are taken.
        square: metres, the side of a square as measured on the print.
        columns: squares along the lower edge.
        rows: squares along the left edge.
    """

    launch: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAUNCH")]
    pictures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PICTURE ...")]
    square: float = Board.square
    columns: int = Board.columns
    rows: int = Board.rows


@dataclass(frozen=True)
class CalibratePose:
    """Where the camera stands, from pictures of the board on the floor.

    Lay the board flat on the floor where the camera sees it well, 1 to 2.5 m away, and take a few pictures; neither may
    move. The world begins at the lower left corner of the pattern (the corner that the print names), x along its lower
    edge, y along its left edge, z up. Several cameras that see the board lying in one place share one world. Look at
    the picture that is written: the grid must lie on the floor.

    Try:
      steadypose calibrate pose kitchen.toml floor.jpg --square 0.0561

    Args:
        launch: the launch file of this camera, with the lens; the pose goes into its [input.calibration].
        pictures: picture files, folders of them, or videos.
        square: metres, the side of a square as measured on the print.
        columns: squares along the lower edge.
        rows: squares along the left edge.
        picture: where to write what the camera sees with the floor's grid; beside the launch file if left out.
    """

    launch: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAUNCH")]
    pictures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PICTURE ...")]
    square: float = Board.square
    columns: int = Board.columns
    rows: int = Board.rows
    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None


@dataclass(frozen=True)
class CalibrateFloor:
    """Where the camera stands above the floor, from a depth image and from where up is; without a board.

    This tells height and tilt. It cannot tell where on the floor the camera stands or which way it looks: the world
    begins under the camera, and the camera looks along +y. Several cameras need the board.

    Try:
      steadypose calibrate floor kitchen.toml depth.png
      steadypose calibrate floor kitchen.toml depth.png --up 0.02 -0.94 -0.34

    Args:
        launch: the launch file of this camera, with the lens; the pose goes into its [input.calibration].
        depth: 16 bit .png in millimetres, or .npy (H, W) in millimetres; 0 where nothing is seen. At the resolution of
            the lens.
        up: where up is in the camera's frame (x right, y down, z forward), as its IMU feels it at rest, to 10 degrees;
            a level camera if left out.
        picture: where to write the depth image with the floor's grid; beside the launch file if left out.
    """

    launch: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAUNCH")]
    depth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DEPTH")]
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    picture: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None


@dataclass(frozen=True)
class CalibrateOak:
    """A picture and a depth image of an OAK camera for the other steps, and its lens, which it knows.

    Try:
      steadypose calibrate oak kitchen.toml floor
      steadypose calibrate pose kitchen.toml floor.png --square 0.0561

    Args:
        launch: the launch file of this camera; the lens goes into its [input.calibration].
        out: name of the files to write, without ending: NAME.png and NAME.depth.png.
    """

    launch: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAUNCH")]
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]


def calibrate(
    step: Annotated[
        Annotated[PrintBoard, tyro.conf.subcommand("board")]
        | Annotated[CalibrateOak, tyro.conf.subcommand("oak")]
        | Annotated[CalibrateLens, tyro.conf.subcommand("lens")]
        | Annotated[CalibratePose, tyro.conf.subcommand("pose")]
        | Annotated[CalibrateFloor, tyro.conf.subcommand("floor")],
        tyro.conf.arg(name=""),
    ],
) -> None:
    """Tell a camera its lens and its place, so that bodies stand on the floor of one world.

    In order: 'board' makes the board to print, 'lens' takes pictures of it, 'pose' takes pictures of it on the floor.
    A camera with depth can do with 'floor' in place of 'pose'. What is found goes into the launch file, which keeps its
    comments; from then on poses are sent as calibrated. docs/calibrate.md shows it step by step.
    """
    if isinstance(step, PrintBoard):
        _print_board(step)
    elif isinstance(step, CalibrateLens):
        _calibrate_lens(step)
    elif isinstance(step, CalibratePose):
        _calibrate_pose(step)
    elif isinstance(step, CalibrateOak):
        _calibrate_oak(step)
    else:
        _calibrate_floor(step)


def _print_board(step: PrintBoard) -> None:
    if step.paper not in PAPERS_MM:
        raise CalibrationError(f"--paper: expected one of {', '.join(PAPERS_MM)}, got {step.paper!r}")
    if step.out.suffix not in (".pdf", ".png"):
        raise CalibrationError(f"expected a .pdf or .png to write, got {step.out}")
    width, height = PAPERS_MM[step.paper]
    square = (
        np.floor(2 * min((width - 2 * _MARGIN_MM) / step.columns, (height - 2 * _MARGIN_MM) / step.rows)) / 2
    )  # half millimetres
    board = Board(step.columns, step.rows, square / 1000)
    across, up = (1000 * side for side in board.size)
    left, bottom = (width - across) / 2, (height - up) / 2
    with matplotlib.rc_context({"pdf.fonttype": 42}):
        page = Figure(figsize=(width / _INCH_MM, height / _INCH_MM), facecolor="white")
        axes = page.add_axes((left / width, bottom / height, across / width, up / height))
        axes.imshow(board.picture(100), cmap="gray", interpolation="none", aspect="auto")
        axes.set_axis_off()
        words = f"world (0, 0)   x →   {board.columns} x {board.rows}, print at 100 %: a square is {square:g} mm"
        page.text(left / width, 0.3 * bottom / height, words, fontsize=7, family="monospace", color="0.4")
        page.savefig(step.out, dpi=DPI)
    print(f"{step.out}: {step.paper.upper()}, {board.columns} x {board.rows} squares of {square:g} mm")
    print("Print at 100 %, measure a square, and give its side in metres as --square.")


def _calibrate_lens(step: CalibrateLens) -> None:
    _check_launch(step.launch)
    board = Board(step.columns, step.rows, step.square)
    views, sizes, looked_at = [], set(), 0
    for name, picture in _pictures(step.pictures):
        looked_at += 1
        view = find_corners(picture, board)
        print(f"{name}: {f'{len(view.image)} corners' if view else 'no board'}")
        sizes.add(picture.shape[1::-1])
        views += [view] if view else []
    if len(sizes) > 1:
        raise CalibrationError(
            f"expected pictures of one size, got {', '.join(f'{w} x {h}' for w, h in sorted(sizes))}"
        )
    lens = calibrate_lens(views, sizes.pop())
    _save(step.launch, lens=lens)
    angle = 2 * np.degrees(np.arctan(0.5 * lens.size[0] / lens.focal[0]))
    print(
        f"\nlens from {len(views)} of {looked_at} pictures, {lens.error_px:.2f} pixels off on average (0.5 is good); "
        f"{lens.size[0]} x {lens.size[1]}, focal length {lens.focal[0]:.1f} pixels, {angle:.0f} degrees wide"
    )
    print(f"{step.launch}: [input.calibration] written. Next: steadypose calibrate pose")


def _calibrate_pose(step: CalibratePose) -> None:
    lens = _lens(step.launch)
    board = Board(step.columns, step.rows, step.square)
    views, last = [], None
    for name, picture in _pictures(step.pictures):
        if picture.shape[1::-1] != lens.size:
            raise CalibrationError(
                f"{name}: expected {lens.size[0]} x {lens.size[1]} pixels, as the lens was calibrated for, got "
                f"{picture.shape[1]} x {picture.shape[0]}"
            )
        view, last = find_corners(picture, board), picture
        print(f"{name}: {f'{len(view.image)} corners' if view else f'fewer than {LEAST_CORNERS} corners'}")
        views += [view] if view else []
    found = camera_pose(views, lens)
    assert last is not None, "without a picture there is no pose"
    _write_grid(step.picture or step.launch.with_suffix(".floor.png"), last, lens, found.pose)
    _save(step.launch, pose=found.pose)
    print(
        f"\n{_described(found.pose)}; most corners within {found.error_px:.2f} pixels; "
        f"sure to {1e3 * found.sigma_m:.1f} mm and {np.degrees(found.sigma_rad):.2f} degrees"
    )
    if found.sigma_m > SURE_M:
        print("More pictures, a larger board, or the board nearer to the camera would make it surer.")
    print(f"{step.launch}: [input.calibration] written; poses of this camera are calibrated now")


def _calibrate_floor(step: CalibrateFloor) -> None:
    lens = _lens(step.launch)
    depth = _depth(step.depth)
    if not np.isfinite(step.up).all() or not np.linalg.norm(step.up) > 0:
        raise CalibrationError(f"--up: expected a direction, got {step.up}")
    pose, share = floor_pose(points_of_depth(depth, lens), np.array(step.up))
    _write_grid(step.picture or step.launch.with_suffix(".floor.png"), depth_picture(depth), lens, pose)
    _save(step.launch, pose=pose)
    print(f"{_described(pose)}; {share:.0%} of what it sees is floor")
    print(f"{step.launch}: [input.calibration] written; poses of this camera are calibrated now")


def _calibrate_oak(step: CalibrateOak) -> None:
    launch = _check_launch(step.launch)
    from steadypose.nodes.sources.oak_still import take_with_camera  # brings depthai

    try:
        still = take_with_camera(launch.input.oak)
    except RuntimeError as error:
        raise CalibrationError(str(error)) from error
    _write_still(step, still)


def _write_still(step: CalibrateOak, still: Still) -> None:
    picture, depth = step.out.with_name(f"{step.out.name}.png"), step.out.with_name(f"{step.out.name}.depth.png")
    _write_picture(picture, still.colour)
    _write_picture(depth, still.depth)
    height, width = still.depth.shape
    focal, centre = still.intrinsics[[0, 1], [0, 1]], still.intrinsics[:2, 2]
    lens = Intrinsics((width, height), (float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1])))
    _save(step.launch, lens=lens)
    up = "" if still.up is None else " --up " + " ".join(f"{value:.3f}" for value in still.up)
    print(f"{step.launch}: [input.calibration] has the camera's lens now. With the board on the floor:")
    print(f"  steadypose calibrate pose {step.launch} {picture} --square METRES")
    print(f"without it:\n  steadypose calibrate floor {step.launch} {depth}{up}")


def _described(pose: Pose) -> str:
    forward = Rotation.from_quat(pose.orientation).apply([0.0, 0.0, 1.0])
    x, y, z = pose.position
    return (
        f"camera at x {x:.3f}, y {y:.3f} m, {z:.3f} m above the floor, "
        f"looking {np.degrees(np.arcsin(-forward[2])):.1f} degrees down"
    )


# ---------------------------------------------------------------------------------------------------------------
# Pictures


def _pictures(paths: Sequence[Path]) -> Iterator[tuple[str, Image]]:
    """Pictures by name, from files, folders and videos.

    Raises:
        CalibrationError: there are none, or one cannot be read.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(file for file in path.iterdir() if file.suffix.lower() in PICTURES)
        elif path.is_file():
            files.append(path)
        else:
            raise CalibrationError(f"{path} does not exist: expected a picture, a folder of pictures, or a video")
    if not files:
        where = f" in {', '.join(map(str, paths))}" if paths else ""
        raise CalibrationError(
            f"expected pictures ({', '.join(PICTURES)}), folders of them, or videos; got none{where}"
        )
    if len(files) > MOST_PICTURES:
        print(f"of {len(files)} pictures the first {MOST_PICTURES} are taken")
    for file in track(files[:MOST_PICTURES], "reading", disable=len(files) < 2):
        if file.suffix.lower() in VIDEOS:
            yield from _frames(file)
            continue
        picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            raise CalibrationError(f"{file}: expected a picture that OpenCV reads, such as .png or .jpg")
        yield file.name, np.asarray(picture, np.uint8)


def _frames(file: Path) -> Iterator[tuple[str, Image]]:
    video = cv2.VideoCapture(str(file))
    fps = video.get(cv2.CAP_PROP_FPS)
    fps = fps if 1.0 <= fps <= 1000.0 else 30.0  # some files do not tell, or tell their time base
    step, taken, index = max(round(VIDEO_STEP_S * fps), 1), 0, 0
    while taken < MOST_PICTURES and video.grab():
        if index % step == 0:
            good, frame = video.retrieve()
            if good:
                taken += 1
                yield (
                    f"{file.name} at {index / fps:.1f} s",
                    np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8),
                )
        index += 1
    video.release()
    if not taken:
        raise CalibrationError(f"{file}: expected a video that OpenCV reads, got no frame of it")


def _depth(file: Path) -> NDArray[np.integer]:
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


def draw_floor(picture: Image, lens: Intrinsics, pose: Pose, reach: float = 6.0, step: float = 0.5) -> Image:
    """A picture (H, W) as colours (H, W, 3), BGR, with the floor's grid, every metre bolder, and the world's axes.

    Args:
        picture: grey.
        lens: of the camera.
        pose: of the camera in the world.
        reach: metres of grid around the point that the camera looks at, or stands above.
        step: metres between lines.
    """
    drawn = np.ascontiguousarray(np.repeat(picture[:, :, None], 3, axis=2))
    turn = Rotation.from_quat(pose.orientation)
    forward = turn.apply([0.0, 0.0, 1.0])
    away = min(pose.position[2] / -forward[2], reach) if forward[2] < 0 else reach
    middle = np.round((pose.position + away * forward)[:2])
    ticks = np.arange(-reach, reach + step / 2, step)
    along = np.linspace(-reach, reach, 400)
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


def depth_picture(depth: NDArray[np.integer]) -> Image:
    """Depth (H, W) in millimetres as grey, near light and far dark, as inverse depth is seen; black in holes."""
    near = np.percentile(depth[depth > 0], 1) if depth.any() else 1.0
    return (255 * np.clip(near / np.where(depth > 0, depth, np.inf), 0.0, 1.0)).astype(np.uint8)


def _write_picture(out: Path, picture: NDArray[Any]) -> None:
    try:
        written = cv2.imwrite(str(out), picture)
    except cv2.error:  # an ending it does not know
        written = False
    if not written:
        raise CalibrationError(
            f"{out} cannot be written: expected a picture such as .png or .jpg in a folder that exists"
        )


def _write_grid(out: Path, picture: Image, lens: Intrinsics, pose: Pose) -> None:
    _write_picture(out, draw_floor(picture, lens, pose))
    print(f"{out}: the floor's grid, half a metre a square; it must lie on the floor, its axes where the world begins")


# ---------------------------------------------------------------------------------------------------------------
# The launch file


def _check_launch(path: Path) -> Launch:
    if not path.is_file():
        raise LaunchError(
            f"no launch file at {path}: expected the camera's own; start from a copy of one in launch/ such as oak.toml"
        )
    return Launch.read(path)


def _lens(path: Path) -> Intrinsics:
    """The lens that a launch file tells."""
    told = _check_launch(path).input.calibration
    if not told.size:
        raise CalibrationError(f"{path} tells no lens in [input.calibration]: first run steadypose calibrate lens")
    width, height = told.size
    fx, fy = told.focal
    cx, cy = told.centre
    return Intrinsics((width, height), (fx, fy), (cx, cy), tuple(told.distortion))


def _save(path: Path, *, lens: Intrinsics | None = None, pose: Pose | None = None) -> None:
    """Write what was found to ``[input.calibration]`` of a launch file, which is left as it is otherwise."""
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    section = document.setdefault("input", tomlkit.table()).setdefault("calibration", tomlkit.table())
    if lens:
        section["size"] = list(lens.size)
        for name in ("focal", "centre", "distortion"):
            section[name] = [round(value, 6) for value in getattr(lens, name)]
    if pose:
        section["position"] = [round(float(value), 5) for value in pose.position]
        section["orientation"] = [round(float(value), 7) for value in pose.orientation]
    # the user's own file: whole, as it was or as it becomes, whatever happens in between
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(tomlkit.dumps(document), encoding="utf-8")
        shutil.copymode(path, part)
        Launch.read(part)
        part.replace(path.resolve())
    finally:
        part.unlink(missing_ok=True)
