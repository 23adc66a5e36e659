"""``steadypose calibrate``: a camera's lens, and where it stands in the world, into its launch file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.nodes.commands import calibrate_files as files
from steadypose.nodes.commands.calibrate_sensor import CalibrateSensor
from steadypose.nodes.commands.output import File, check_folder
from steadypose.nodes.sources.registry import InputSettings
from steadypose.prior.camera.calibration import (
    MIN_CORNERS,
    Board,
    CalibrationError,
    Intrinsics,
    calibrate_lens,
    camera_pose,
    find_corners,
    floor_pose,
    points_of_depth,
)

PAPERS_MM = {"a4": (297.0, 210.0), "a3": (420.0, 297.0), "letter": (279.4, 215.9)}
GOOD_SIGMA_M = 0.005  # a place less sure than this is worth another try
DPI = 300
LaunchFile = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAUNCH")]
Images = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="IMAGE ...")]
_MARGIN_MM = 8.0
_INCH_MM = 25.4


@dataclass(frozen=True)
class PrintBoard:
    """Write the calibration board: a PDF or PNG to print at its true size.

    Print it at 100 % ("actual size", not "fit to page"), glue it to something flat and stiff, and measure a square. All
    other steps take its side in metres as --square. With A3 the camera can stand farther away than with A4.

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
    paper: Annotated[str, tyro.conf.arg(metavar="NAME")] = "a3"
    columns: int = Board.columns
    rows: int = Board.rows

    def run(self) -> None:
        if self.paper not in PAPERS_MM:
            raise CalibrationError(f"--paper: expected one of {', '.join(PAPERS_MM)}, got {self.paper!r}")
        if self.out.suffix not in (".pdf", ".png"):
            raise CalibrationError(f"expected a .pdf or .png to write, got {self.out}")
        check_folder(self.out)
        width, height = PAPERS_MM[self.paper]
        most = min((width - 2 * _MARGIN_MM) / self.columns, (height - 2 * _MARGIN_MM) / self.rows)
        square = np.floor(2 * most) / 2  # half millimetres
        board = Board(self.columns, self.rows, square / 1000)
        across, up = (1000 * side for side in board.size)
        left, bottom = (width - across) / 2, (height - up) / 2
        with matplotlib.rc_context({"pdf.fonttype": 42}):
            page = Figure(figsize=(width / _INCH_MM, height / _INCH_MM), facecolor="white")
            axes = page.add_axes((left / width, bottom / height, across / width, up / height))
            axes.imshow(board.image(100), cmap="gray", interpolation="none", aspect="auto")
            axes.set_axis_off()
            words = f"world (0, 0)   x →   {board.columns} x {board.rows}, print at 100 %: a square is {square:g} mm"
            page.text(left / width, 0.3 * bottom / height, words, fontsize=7, family="monospace", color="0.4")
            page.savefig(self.out, dpi=DPI)
        print(f"{self.out}: {self.paper.upper()}, {board.columns} x {board.rows} squares of {square:g} mm")
        print("Print at 100 %, measure a square, and give its side in metres as --square.")


@dataclass(frozen=True)
class _OfBoard:
    """What the steps with images of the board take.

    Args:
        launch: your launch file of this camera; the result is written to its [input.calibration].
        images: image files, folders of them, or videos, of which two images per second are used.
        square: side of a square in metres, measured on the print.
        columns: squares along the lower edge.
        rows: squares along the left edge.
    """

    launch: LaunchFile
    images: Images
    square: float = Board.square
    columns: int = Board.columns
    rows: int = Board.rows

    @property
    def board(self) -> Board:
        return Board(self.columns, self.rows, self.square)


@dataclass(frozen=True)
class CalibrateLens(_OfBoard):
    """Calibrate the lens from 15 to 25 images of the board.

    Take images of the board near and far, tilted to all sides, in the middle and in every corner of the image. Keep the
    board still each time, and use the resolution that you run with. An OAK camera stores its lens parameters: use the
    step 'oak' instead.

    Try:
      steadypose calibrate lens kitchen.toml images/ --square 0.0561
      steadypose calibrate lens kitchen.toml video.mp4 --square 0.0561
    """

    def run(self) -> None:
        files.read_launch(self.launch)
        views, sizes, images = [], set(), 0
        for name, image in files.read_images(self.images):
            images += 1
            view = find_corners(image, self.board)
            print(f"{name}: {f'{len(view.image)} corners' if view else 'no board'}")
            sizes.add(image.shape[1::-1])
            views += [view] if view else []
        if len(sizes) > 1:
            got = ", ".join(f"{w} x {h}" for w, h in sorted(sizes))
            raise CalibrationError(f"expected images of one size, got {got}")
        lens = calibrate_lens(views, sizes.pop())
        files.save_calibration(self.launch, lens=lens)
        angle = 2 * np.degrees(np.arctan(0.5 * lens.size[0] / lens.focal[0]))
        print(
            f"\nlens from {len(views)} of {images} images, {lens.error_px:.2f} pixels off on average "
            "(0.5 is good); "
            f"{lens.size[0]} x {lens.size[1]}, focal length {lens.focal[0]:.1f} pixels, {angle:.0f} degrees wide"
        )
        print(f"{self.launch}: [input.calibration] written. Next: steadypose calibrate pose")


@dataclass(frozen=True)
class CalibratePose(_OfBoard):
    """Estimate the camera's pose from images of the board on the floor.

    Lay the board flat on the floor, 1 to 2.5 m from the camera, and take a few images; neither may move. The world's
    origin is the lower left corner of the pattern (labelled on the print): x along its lower edge, y along its left
    edge, z up. Cameras that see the board in the same place share one world. Check the image that is written: the grid
    must lie on the floor.

    Try:
      steadypose calibrate pose kitchen.toml floor.jpg --square 0.0561

    Args:
        picture: image to write, with the floor's grid drawn over it. Default: beside the launch file.
    """

    picture: File = None

    def run(self) -> None:
        lens = files.lens_of(self.launch)
        views, last = [], None
        for name, image in files.read_images(self.images):
            if (size := image.shape[1::-1]) != lens.size:
                expected = f"expected {lens.size[0]} x {lens.size[1]} pixels, as of the calibrated lens"
                raise CalibrationError(f"{name}: {expected}, got {size[0]} x {size[1]}")
            view, last = find_corners(image, self.board), image
            print(f"{name}: {f'{len(view.image)} corners' if view else f'fewer than {MIN_CORNERS} corners'}")
            views += [view] if view else []
        camera = camera_pose(views, lens)
        assert last is not None, "without an image there is no pose"
        files.write_floor_grid(self.picture or self.launch.with_suffix(".floor.png"), last, lens, camera.pose)
        files.save_calibration(self.launch, pose=camera.pose)
        print(
            f"\n{_described(camera.pose)}; most corners within {camera.error_px:.2f} pixels; "
            f"sure to {1e3 * camera.sigma_m:.1f} mm and {np.degrees(camera.sigma_rad):.2f} degrees"
        )
        if camera.sigma_m > GOOD_SIGMA_M:
            print("More images, a larger board, or the board nearer to the camera would make it more certain.")
        print(f"{self.launch}: [input.calibration] written; poses of this camera are calibrated now")


@dataclass(frozen=True)
class CalibrateFloor:
    """Estimate the camera's height and tilt from a depth image and the direction of gravity, without a board.

    Position and heading on the floor cannot be estimated: the world's origin is below the camera, which looks along
    +y. For several cameras, use the board.

    Try:
      steadypose calibrate floor kitchen.toml depth.png
      steadypose calibrate floor kitchen.toml depth.png --up 0.02 -0.94 -0.34

    Args:
        launch: your launch file of this camera, with the lens; the pose is written to its [input.calibration].
        depth: depth image in millimetres, 16 bit .png or .npy (H, W), 0 where unknown, at the resolution of the lens.
        up: upward direction in the camera's frame (x right, y down, z forward), within 10 degrees, as its IMU measures
            it at rest. Default: a level camera.
        picture: image to write, with the floor's grid drawn over it. Default: beside the launch file.
    """

    launch: LaunchFile
    depth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DEPTH")]
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    picture: File = None

    def run(self) -> None:
        lens = files.lens_of(self.launch)
        depth = files.read_depth(self.depth)
        if not np.isfinite(self.up).all() or not np.linalg.norm(self.up) > 0:
            raise CalibrationError(f"--up: expected a direction, got {self.up}")
        pose, share = floor_pose(points_of_depth(depth, lens), np.array(self.up))
        out = self.picture or self.launch.with_suffix(".floor.png")
        files.write_floor_grid(out, files.depth_image(depth), lens, pose)
        files.save_calibration(self.launch, pose=pose)
        print(f"{_described(pose)}; {share:.0%} of what it sees is floor")
        print(f"{self.launch}: [input.calibration] written; poses of this camera are calibrated now")


@dataclass(frozen=True)
class CalibrateOak:
    """Write the lens parameters of an OAK camera, and take an image and a depth image for the other steps.

    Try:
      steadypose calibrate oak kitchen.toml floor
      steadypose calibrate pose kitchen.toml floor.png --square 0.0561

    Args:
        launch: your launch file of this camera; the lens is written to its [input.calibration].
        out: name of the files to write, without ending: NAME.png and NAME.depth.png.
    """

    launch: LaunchFile
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]

    def run(self) -> None:
        launch = files.read_launch(self.launch)
        from steadypose.nodes.sources.oak_device import capture_with_camera  # brings depthai

        try:
            still = capture_with_camera(launch.settings(InputSettings).oak)
        except RuntimeError as error:
            raise CalibrationError(str(error)) from error
        image, depth = self.out.with_name(f"{self.out.name}.png"), self.out.with_name(f"{self.out.name}.depth.png")
        files.write_image(image, still.colour)
        files.write_image(depth, still.depth)
        height, width = still.depth.shape
        focal, centre = still.intrinsics[[0, 1], [0, 1]], still.intrinsics[:2, 2]
        lens = Intrinsics((width, height), (float(focal[0]), float(focal[1])), (float(centre[0]), float(centre[1])))
        files.save_calibration(self.launch, lens=lens)
        up = "" if still.up is None else " --up " + " ".join(f"{value:.3f}" for value in still.up)
        print(f"{self.launch}: [input.calibration] has the camera's lens now. With the board on the floor:")
        print(f"  steadypose calibrate pose {self.launch} {image} --square METRES")
        print(f"without it:\n  steadypose calibrate floor {self.launch} {depth}{up}")


def calibrate(
    step: Annotated[
        Annotated[PrintBoard, tyro.conf.subcommand("board")]
        | Annotated[CalibrateOak, tyro.conf.subcommand("oak")]
        | Annotated[CalibrateLens, tyro.conf.subcommand("lens")]
        | Annotated[CalibratePose, tyro.conf.subcommand("pose")]
        | Annotated[CalibrateFloor, tyro.conf.subcommand("floor")]
        | Annotated[CalibrateSensor, tyro.conf.subcommand("sensor")],
        tyro.conf.arg(name=""),
    ],
) -> None:
    """Calibrate a camera's lens and pose, so that bodies stand on the floor of one world frame.

    The steps in order: 'board' writes a board to print, 'lens' uses images of it, and 'pose' uses images of it on the
    floor. With a depth camera, 'floor' can replace 'pose'. Each step writes its result to the launch file, whose
    comments are kept. Separately, 'sensor' trains a correction of a sensor's own error. See docs/calibrate.md.

    Try:
      steadypose calibrate board board.pdf
      steadypose calibrate pose --help
    """
    step.run()


def _described(pose: Pose) -> str:
    forward = Rotation.from_quat(pose.orientation).apply([0.0, 0.0, 1.0])
    x, y, z = pose.position
    return (
        f"camera at x {x:.3f}, y {y:.3f} m, {z:.3f} m above the floor, "
        f"looking {np.degrees(np.arcsin(-forward[2])):.1f} degrees down"
    )
