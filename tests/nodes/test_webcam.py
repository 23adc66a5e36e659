"""A webcam: real video through OpenCV, with a landmarker in MediaPipe's place that sees a person in every picture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace as Made

import cv2
import numpy as np
import pytest
from conftest import VirtualClock

from msgs.types import PoseRaw
from nodes import webcam
from nodes.launch import Launch, LaunchError, WebcamSettings
from nodes.live import PAUSES_S
from nodes.runtime import SystemClock
from nodes.webcam import WebcamSource, require_mediapipe

SIZE = (320, 240)
FRAMES = 5


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A film of five pictures, each brighter than the last, in the place of camera 3."""
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    for index in range(FRAMES):
        writer.write(np.full((SIZE[1], SIZE[0], 3), (40 * index, 0, 0), np.uint8))
    writer.release()
    opened = cv2.VideoCapture
    monkeypatch.setattr(webcam.cv2, "VideoCapture", lambda number: opened(str(path)) if number == 3 else opened())
    return path


@pytest.fixture
def model(tmp_path: Path) -> str:
    path = tmp_path / "pose.task"
    path.write_bytes(b"a model")
    return str(path)


class Seen:
    """Sees one body two metres ahead, and notes the pictures."""

    def __init__(self) -> None:
        self.pictures: list[tuple[np.ndarray, int]] = []

    @contextmanager
    def landmarker(self, settings: WebcamSettings) -> Iterator[webcam.Landmarker]:
        yield self.look

    def look(self, image: np.ndarray, milliseconds: int) -> Made:
        self.pictures.append((image[0, 0], milliseconds))
        body = np.random.default_rng(0).normal(0, 0.3, (33, 3))
        height, width = image.shape[:2]
        focal = width / 2 / np.tan(WebcamSettings.field_of_view / 2)
        x, y, z = (body + [0.1, 0.2, 2.5]).T
        world = [Made(x=x, y=y, z=z, visibility=0.9) for x, y, z in body]
        places = np.column_stack([0.5 + focal * x / z / width, 0.5 + focal * y / z / height])
        return Made(pose_world_landmarks=[world], pose_landmarks=[[Made(x=u, y=v) for u, v in places]])


def test_each_picture_gives_the_bodies_in_it(video: Path, model: str) -> None:
    seen = Seen()
    source = WebcamSource(WebcamSettings(camera=3, model=model), SystemClock(), seen.landmarker)
    frames: list[PoseRaw] = []
    for frame in source.frames():
        if frame is None:
            break  # the film is over: the camera is gone
        frames.append(frame)
        assert source.status()["camera"] in ("streaming", "waiting for the first frame")
    assert len(frames) == FRAMES
    assert source.refused["camera lost"] == 1
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(stamps)
    for frame in frames:
        assert (frame.skeleton, frame.source, len(frame.bodies)) == ("blazepose33", "webcam-3", 1)
        np.testing.assert_allclose(frame.bodies[0].positions.mean(axis=0), [0.1, 0.2, 2.5], atol=0.2)
    colours, milliseconds = zip(*seen.pictures, strict=True)
    assert [int(colour[2]) > int(colour[0]) for colour in colours[2:]] == [True] * 3, "RGB, not OpenCV's BGR"
    assert list(milliseconds) == sorted(set(milliseconds)), "MediaPipe wants them to rise"


def test_a_picture_that_fails_is_counted_and_the_next_one_comes(video: Path, model: str) -> None:
    class Stumbles(Seen):
        def look(self, image: np.ndarray, milliseconds: int) -> Made:
            found = super().look(image, milliseconds)
            if len(self.pictures) == 2:
                found.pose_world_landmarks[0].pop()
            elif len(self.pictures) == 4:
                cv2.cvtColor(image[:0], cv2.COLOR_BGR2RGB)  # nothing, where a picture is expected
            return found

    source = WebcamSource(WebcamSettings(camera=3, model=model), SystemClock(), Stumbles().landmarker)
    frames = source.frames()
    assert [next(frames) is not None for _ in range(FRAMES)] == [True, False, True, False, True]
    status = source.status()
    assert (status["dropped.camera frame: ValueError"], status["dropped.camera frame: error"]) == ("1", "1")
    assert not source.refused


def test_a_webcam_that_is_not_there_is_looked_for_again(video: Path, model: str, clock: VirtualClock) -> None:
    source = WebcamSource(WebcamSettings(camera=4, model=model), clock, Seen().landmarker)
    frames = source.frames()
    for _ in range(30):
        assert next(frames) is None
    assert "camera 4 cannot be opened" in source.status()["camera"]
    assert sum(clock.slept_ns) > PAUSES_S[0] * 1e9


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (WebcamSettings(bodies=0), "bodies of 1 or more"),
        (WebcamSettings(camera=-1), "camera of 0 or more"),
        (WebcamSettings(field_of_view=60.0), "field_of_view in radians"),
        (WebcamSettings(), r"a \.task file, got ''; download one, such as https"),
        (WebcamSettings(model="gone.task"), "got 'gone.task'; download one"),
    ],
)
def test_settings_that_cannot_be_used_say_so(settings: WebcamSettings, expected: str) -> None:
    with pytest.raises(LaunchError, match=expected):
        WebcamSource(settings, SystemClock(), Seen().landmarker)


def test_without_mediapipe_it_says_what_to_install(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webcam, "find_spec", lambda name: None)
    with pytest.raises(LaunchError, match="--extra webcam"):
        WebcamSource(WebcamSettings(model=model), SystemClock())


def test_the_launch_file_names_what_to_download() -> None:
    launch = Launch.read("webcam")
    assert launch.input.source == "webcam"
    assert not launch.transport.lossless
    assert launch.input.webcam.model.endswith("launch/pose_landmarker_full.task")


def test_mediapipe_itself_refuses_a_file_that_is_no_model(model: str) -> None:
    pytest.importorskip("mediapipe")
    require_mediapipe()
    with (
        pytest.raises(LaunchError, match=r"MediaPipe cannot use .* as a pose landmarker"),
        webcam.landmarker(WebcamSettings(model=model)),
    ):
        pass
