"""An image of an OAK for its calibration, from a depthai pipeline without a camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import depthai as dai
import numpy as np
import pytest
from tests.helpers.fake_oak import CAMERA, Player, colour_frame, depth_frame, moment, readings

from steadypose.nodes.commands.calibrate import CalibrateOak, calibrate
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sources import oak_device
from steadypose.nodes.sources.oak_device import Still, capture
from steadypose.nodes.sources.registry import InputSettings
from steadypose.nodes.sources.source import CameraError, OakSettings
from steadypose.prior.camera.calibration import CalibrationError

UP = np.array([0.0, -np.cos(0.2), np.sin(0.2)])


def test_the_image_after_those_in_which_the_camera_settles() -> None:
    scene = moment(0)
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        player = pipeline.create(Player)
        player.script = [("imu", readings(UP.tolist()))]
        start = dai.Clock.now()  # pyright: ignore[reportCallIssue] (static)
        for index in range(2):
            for name, message in (("colour", colour_frame(100 + index)), ("depth", depth_frame(scene))):
                message.setTimestamp(start + index * oak_device.SYNC_THRESHOLD * 2)
                player.script.append((name, message))
        still = capture(
            pipeline, player.outputs["colour"], player.outputs["depth"], (player.outputs["imu"], np.eye(3)), settle=1
        )
    assert still.colour[0, 0].tolist() == [101, 0, 10]
    np.testing.assert_array_equal(still.depth, scene.depth)
    np.testing.assert_allclose(still.intrinsics, CAMERA.intrinsics)
    assert still.up is not None
    np.testing.assert_allclose(still.up, UP, atol=1e-6)


def test_a_camera_that_gives_nothing_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak_device, "PAIR_TIMEOUT_S", 0.01)
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        player = pipeline.create(Player)
        with pytest.raises(CameraError, match="no image with depth"):
            capture(pipeline, player.outputs["depth"], player.outputs["depth"], None)


def test_it_becomes_the_files_and_the_lens_that_the_other_steps_want(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = moment(0)
    colour = np.zeros((*scene.depth.shape, 3), np.uint8)
    monkeypatch.setattr(oak_device, "capture_with_camera", lambda _: Still(colour, scene.depth, CAMERA.intrinsics, UP))
    launch = tmp_path / "kitchen.toml"
    launch.write_text('# mine\n[input]\nsource = "oak"\n')
    calibrate(CalibrateOak(launch, tmp_path / "floor"))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "floor.depth.png"), cv2.IMREAD_UNCHANGED), scene.depth)
    assert (tmp_path / "floor.png").is_file()
    told = Launch.read(launch).settings(InputSettings).calibration
    assert list(told.size) == [CAMERA.width, CAMERA.height]
    assert list(told.focal) == pytest.approx([CAMERA.focal, CAMERA.focal])
    assert launch.read_text().startswith("# mine")
    assert "floor.depth.png --up 0.000 -0.980 0.199" in capsys.readouterr().out


def test_a_folder_that_is_not_there_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = Still(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.uint16), CAMERA.intrinsics, UP)
    monkeypatch.setattr(oak_device, "capture_with_camera", lambda _: still)
    launch = tmp_path / "kitchen.toml"
    launch.write_text("")
    with pytest.raises(CalibrationError, match=r"gone/floor\.png cannot be written"):
        calibrate(CalibrateOak(launch, tmp_path / "gone" / "floor"))
    assert launch.read_text() == ""


def test_without_a_camera_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(settings: OakSettings) -> Still:
        raise CameraError("no camera found")

    monkeypatch.setattr(oak_device, "capture_with_camera", none)
    launch = tmp_path / "kitchen.toml"
    launch.write_text("")
    with pytest.raises(CalibrationError, match="no camera found"):
        calibrate(CalibrateOak(launch, tmp_path / "floor"))
