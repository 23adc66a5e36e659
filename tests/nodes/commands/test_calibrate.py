from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import VirtualClock, raw, walking
from tests.helpers.rendered_board import BOARD, depth_points, error, held_poses, look_at, picture, rays
from tests.prior.camera.test_calibration import project

from steadypose.msgs.types import Pose, PoseRaw
from steadypose.nodes.cli import main
from steadypose.nodes.commands.calibrate_files import draw_floor
from steadypose.nodes.graph.launch import Launch, bundled
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.recording import RecordingSource
from steadypose.nodes.sources.registry import InputSettings
from steadypose.prior.camera.calibration import Intrinsics, find_corners
from steadypose.prior.clean.settings import PriorSettings

LENS = Intrinsics((640, 360), (520.0, 518.0), (322.0, 177.0), (0.03, -0.05, 0.0, 0.0, 0.0))
EYE = look_at(np.array([-0.1, -0.7, 0.8]), np.array([0.2, 0.1, 0.0]))


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of the board held in ``held/``, and of the board on the floor in ``floor/``."""
    folder, rng, looks = tmp_path_factory.mktemp("pictures"), np.random.default_rng(3), rays(LENS, finer=2)
    for name, poses in (("held", held_poses(rng)), ("floor", iter([EYE, EYE]))):
        (folder / name).mkdir()
        for index, pose in zip(range(10), poses, strict=False):
            drawn = picture(pose, LENS, looks, rng, blur=0.6, noise=2.0)
            cv2.imwrite(str(folder / name / f"{index:02}.png"), drawn)
    return folder


@pytest.mark.slow
def test_board_lens_and_pose_end_in_the_launch_file(pictures: Path, tmp_path: Path, capsys) -> None:
    launch = tmp_path / "kitchen.toml"
    launch.write_text('# our kitchen\n[input]\nsource = "oak" # by the window\n\n[prior]\ndelay = 2\n')
    square = str(BOARD.square)
    assert main(["calibrate", "pose", str(launch), str(pictures / "floor"), "--square", square]) == 2
    assert "first run steadypose calibrate lens" in capsys.readouterr().err
    assert main(["calibrate", "lens", str(launch), str(pictures / "held"), "--square", square]) == 0
    assert main(["calibrate", "pose", str(launch), str(pictures / "floor"), "--square", square]) == 0
    saved = Launch.read(launch).settings(InputSettings).calibration
    assert saved.focal == pytest.approx(LENS.focal, rel=0.01)
    assert saved.pose is not None
    millimetres, degrees = error(saved.pose, EYE)
    assert millimetres < 15.0
    assert degrees < 0.5
    text = launch.read_text()
    assert "# our kitchen" in text
    assert '"oak" # by the window' in text
    assert Launch.read(launch).settings(PriorSettings).delay == 2
    drawn: Any = cv2.imread(str(tmp_path / "kitchen.floor.png"))
    assert drawn.shape == (360, 640, 3)


LENS_TOLD = "[input.calibration]\nsize = [320, 200]\nfocal = [215.0, 215.0]\ncentre = [159.5, 99.5]\n"
UP = ("--up", "0", "-0.7", "-0.7")
"""in the frame of `EYE`, about"""


def floor_depth() -> np.ndarray:
    """(200, 320) millimetres, the floor as that lens sees it from `EYE`."""
    points = depth_points(EYE, np.random.default_rng(0))
    columns, rows = np.round(points[:, :2] / points[:, 2:] * 215.0 + [159.5, 99.5]).astype(int).T
    depth = np.zeros((200, 320), np.uint16)
    depth[rows, columns] = np.round(1000 * points[:, 2])
    return depth


@pytest.mark.slow
def test_the_printed_board_is_the_one_that_is_looked_for_at_its_true_size(tmp_path: Path) -> None:
    assert main(["calibrate", "board", str(tmp_path / "board.png"), "--paper", "a4"]) == 0
    page: Any = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert page.shape == pytest.approx(np.array([210.0, 297.0]) / 25.4 * 300, abs=1)
    corners: Any = find_corners(np.asarray(page, np.uint8), BOARD)
    assert len(corners.image) == 24
    pixels = np.linalg.norm(corners.image - corners.image[0], axis=1)
    squares = np.linalg.norm(corners.board - corners.board[0], axis=1) / BOARD.square
    assert pixels[1:] / squares[1:] == pytest.approx(38.5 / 25.4 * 300, rel=2e-3)
    assert main(["calibrate", "board", str(tmp_path / "board.pdf")]) == 0
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_the_grid_is_drawn_where_the_floor_is_seen() -> None:
    drawn = draw_floor(np.zeros((360, 640), np.uint8), LENS, EYE)
    on_the_grid = [[0.5, 0.5, 0.0], [0.25, 0.5, 0.0], [0.0, 1.0, 0.0], [0.5, 0.2, 0.0]]
    *lines, between = np.round(project(EYE, np.array([*on_the_grid, [0.25, 0.25, 0.0]]), LENS)).astype(int)
    for x, y in lines:
        assert drawn[y - 1 : y + 2, x - 1 : x + 2].any(), (x, y)
    assert not drawn[between[1] - 2 : between[1] + 3, between[0] - 2 : between[0] + 3].any()
    up = draw_floor(np.zeros((360, 640), np.uint8), LENS, look_at(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 3.0])))
    assert not up.any(), "no floor above the horizon"


@pytest.mark.parametrize(("arguments", "complaint"), [
    (["board", "board.txt"], "expected a .pdf or .png"),
    (["board", "board.pdf", "--paper", "b9"], "expected one of a4, a3, letter"),
    (["board", "{folder}/no/board.pdf"], "to exist; make it first"),
    (["lens", "nowhere.toml", "x"], "no launch file at nowhere.toml"),
    (["lens", "{launch}", "{folder}/nothing"], "expected an image, a folder of images, or a video"),
    (["lens", "{launch}", "{launch}"], "expected an image that OpenCV reads"),
    (["floor", "{launch}", "{folder}/no.png"], "has no lens"),
    (["floor", "{lens}", "{folder}/no.npy"], "does not exist"),
    (["floor", "{lens}", "{folder}/bad.npy"], "cannot be read as .npy"),
    (["floor", "{lens}", "{folder}/several.npy"], "got nothing that can be read"),
    (["floor", "{lens}", "{folder}/floor.npy", *UP, "--picture", "grid.txt"], "grid.txt cannot be written"),
    (["floor", "{lens}", "{folder}/floor.npy", *UP, "--picture", "{folder}/no/x.png"], "x.png cannot be written"),
])  # fmt: skip
def test_what_cannot_be_done_is_said(arguments: list[str], complaint: str, tmp_path: Path, capsys) -> None:
    launch, lens = tmp_path / "kitchen.toml", tmp_path / "hall.toml"
    launch.write_text("")
    lens.write_text(LENS_TOLD)
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY\1\0\4\0{'de")
    with (tmp_path / "several.npy").open("wb") as file:
        np.savez(file, depth=np.zeros((2, 2)))
    np.save(tmp_path / "floor.npy", floor_depth())
    filled = [a.format(launch=launch, lens=lens, folder=tmp_path) for a in arguments]
    assert main(["calibrate", *filled]) == 2
    assert complaint in capsys.readouterr().err
    assert (launch.read_text(), lens.read_text()) == ("", LENS_TOLD), "left as they were"


def test_the_floor_in_depth_tells_height_and_tilt_and_the_launch_file_stays_whole(tmp_path: Path, monkeypatch) -> None:
    launch = tmp_path / "kitchen.toml"
    launch.write_text(LENS_TOLD)
    launch.chmod(0o640)
    link = tmp_path / "link.toml"
    link.symlink_to(launch)
    cv2.imwrite(str(tmp_path / "depth.png"), floor_depth())
    arguments = ["calibrate", "floor", str(link), str(tmp_path / "depth.png"), *UP]

    def full(self: Path, text: str, encoding: str) -> None:
        self.write_bytes(text.encode()[:40])
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        assert main(arguments) == 2
    assert launch.read_text() == LENS_TOLD
    assert main(arguments) == 0
    pose: Any = Launch.read(launch).settings(InputSettings).calibration.pose
    assert pose.position == pytest.approx([0.0, 0.0, EYE.position[2]], abs=0.01)
    assert link.is_symlink()
    assert launch.stat().st_mode & 0o777 == 0o640
    assert {file.name for file in tmp_path.iterdir()} == {"kitchen.toml", "link.toml", "depth.png", "link.floor.png"}


def test_a_calibrated_camera_sends_its_place(make_launch: Callable[..., Launch], clock: VirtualClock) -> None:
    half = np.sqrt(0.5)
    saved = {"position": "[1.0, 2.0, 1.5]", "orientation": f"[{-half}, 0.0, 0.0, {half}]"}
    launch = make_launch({f"input.calibration.{key}": value for key, value in saved.items()})
    node = PoseInputNode(launch, clock, RecordingSource(bundled("sim_data", "idle")))
    message = raw(0, walking(0))
    message.calibrated = False
    placed = node._with_pose(message)
    assert isinstance(placed, PoseRaw)
    assert placed.calibrated
    assert placed.sensor_pose == Pose(np.array([1.0, 2.0, 1.5]), np.array([-half, 0.0, 0.0, half]))
    message.calibrated = True
    assert node._with_pose(message) == message, "a source that knows its place keeps it"
