"""A webcam: real video through OpenCV, with a landmarker in MediaPipe's place that sees a person in every image."""

import dataclasses
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import VirtualClock, raw, until, walk, walking
from scipy.spatial.transform import Rotation
from tests.helpers.rendered_board import write_video

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources import camera, webcam_device
from steadypose.nodes.sources.camera import PAUSES_S, CameraSource, MergeSettings, MergeSource
from steadypose.nodes.sources.image import ImageReader
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.recording import open_recording
from steadypose.nodes.sources.registry import InputSettings
from steadypose.nodes.sources.source import CalibrationSettings, SourceContext, WebcamSettings
from steadypose.nodes.sources.webcam_device import Lens, VideoSource
from steadypose.prior.clean.settings import PriorSettings

SIZE = (320, 240)
NOT_CALIBRATED = CalibrationSettings()
FRAMES = 5


@pytest.fixture
def video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A video of five images, each brighter than the last, in the place of camera 3."""
    path = write_video(tmp_path / "video.avi", SIZE, [(40 * index, 0, 0) for index in range(FRAMES)])
    opened, cameras = cv2.VideoCapture, {3: str(path), str(path): str(path)}
    opens = lambda name: opened(cameras[name]) if name in cameras else opened()  # noqa: E731
    monkeypatch.setattr(webcam_device.cv2, "VideoCapture", opens)
    return path


@pytest.fixture
def model(tmp_path: Path) -> str:
    path = tmp_path / "pose.task"
    path.write_bytes(b"a model")
    return str(path)


class Seen:
    def __init__(self) -> None:
        self.images: list[tuple[np.ndarray, int]] = []

    @contextmanager
    def landmarker(self, settings: WebcamSettings) -> Iterator[webcam_device.Landmarker]:
        yield self.look

    def look(self, image: np.ndarray, milliseconds: int) -> Made:
        self.images.append((image[0, 0], milliseconds))
        body = np.random.default_rng(0).normal(0, 0.3, (33, 3))
        height, width = image.shape[:2]
        focal = width / 2 / np.tan(WebcamSettings.field_of_view / 2)
        x, y, z = (body + [0.1, 0.2, 2.5]).T
        world = [Made(x=x, y=y, z=z, visibility=0.9) for x, y, z in body]
        places = np.column_stack([0.5 + focal * x / z / width, 0.5 + focal * y / z / height])
        return Made(pose_world_landmarks=[world], pose_landmarks=[[Made(x=u, y=v) for u, v in places]])


def open_webcam(settings: WebcamSettings, clock: Clock, seen: Seen) -> CameraSource:
    connect = partial(webcam_device.connect, make_landmarker=seen.landmarker)
    return CameraSource(clock, lambda: connect(settings, NOT_CALIBRATED, clock))


@pytest.mark.parametrize(("name", "published"), [("", "webcam-3"), ("door", "door")])
def test_each_image_gives_the_bodies_in_it(name: str, published: str, video: Path, model: str) -> None:
    seen = Seen()
    source = open_webcam(WebcamSettings(camera=3, model=model, name=name), Clock(), seen)
    frames: list[PoseRaw] = []
    for frame in source.frames():
        if frame is None:
            break  # the video is over: the camera is gone
        frames.append(frame)
        assert source.status()["camera"] in ("streaming", "waiting for the first frame")
    assert len(frames) == FRAMES
    assert source.refused["camera lost"] == 1
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(stamps)
    for frame in frames:
        assert (frame.skeleton, frame.source, len(frame.bodies)) == ("blazepose33", published, 1)
        np.testing.assert_allclose(frame.bodies[0].positions.mean(axis=0), [0.1, 0.2, 2.5], atol=0.2)
    colours, milliseconds = zip(*seen.images, strict=True)
    assert [int(colour[2]) > int(colour[0]) for colour in colours[2:]] == [True] * 3, "RGB, not OpenCV's BGR"
    assert list(milliseconds) == sorted(set(milliseconds)), "MediaPipe wants them to rise"


def test_a_broken_video_gives_the_error_alone(tmp_path: Path) -> None:
    """In a process of its own, because FFmpeg reads its level once."""
    (tmp_path / "broken.mp4").write_bytes(b"\0\0\0 ftypisom\0\0\2\0isomiso2avc1mp41" + bytes(500))
    code = """if True:
        import sys
        from steadypose.nodes.sources.webcam_device import CalibrationSettings, VideoSource, WebcamSettings
        try:
            VideoSource(WebcamSettings(video=sys.argv[1]), CalibrationSettings())
        except ValueError as error:
            print(error)
    """
    command = [sys.executable, "-c", code, str(tmp_path / "broken.mp4")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "expected a video that OpenCV can read" in done.stdout
    assert done.stderr == ""


@pytest.mark.slow
def test_mediapipe_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mediapipe.python.solutions.pose", reason="the extra 'webcam' is not installed, or a newer one")
    with webcam_device.mediapipe_landmarker(WebcamSettings()) as landmarker:
        for milliseconds in (0, 33):
            landmarker(np.zeros((240, 320, 3), np.uint8), milliseconds)
    assert capfd.readouterr().err == ""


def test_an_image_that_fails_is_counted_and_the_next_one_comes(video: Path, model: str) -> None:
    class Stumbles(Seen):
        def look(self, image: np.ndarray, milliseconds: int) -> Made:
            found = super().look(image, milliseconds)
            if len(self.images) == 2:
                found.pose_world_landmarks[0].pop()
            elif len(self.images) == 4:
                cv2.cvtColor(image[:0], cv2.COLOR_BGR2RGB)  # nothing, where an image is expected
            return found

    source = open_webcam(WebcamSettings(camera=3, model=model), Clock(), Stumbles())
    frames = source.frames()
    assert [next(frames) is not None for _ in range(FRAMES)] == [True, False, True, False, True]
    status = source.status()
    assert (status["dropped.camera frame: ValueError"], status["dropped.camera frame: error"]) == ("1", "1")
    assert not source.refused


def test_a_video_gives_every_image_at_its_own_time(video: Path, model: str) -> None:
    seen = Seen()
    source = VideoSource(WebcamSettings(video=str(video), model=model), NOT_CALIBRATED, seen.landmarker)
    assert len(source) == FRAMES
    for _ in range(2):
        frames = [message for _, message in source if isinstance(message, PoseRaw)]
        steps = np.diff([frame.stamp_ns for frame in frames])
        np.testing.assert_allclose(steps, 1e9 / 30, rtol=0.02)
        assert {frame.source for frame in frames} == {"video"}
    colours = [int(colour[2]) for colour, _ in seen.images[:FRAMES]]
    assert colours == sorted(set(colours)), "each image, and each once"
    assert not source.refused


def test_the_newest_image_is_kept_for_the_viewer_and_none_is_left_behind(video: Path, model: str, tmp_path: Path):
    file, shown = tmp_path / "image", []
    reader, settings = ImageReader(file), WebcamSettings(video=str(video), model=model)
    for _ in VideoSource(settings, NOT_CALIBRATED, Seen().landmarker, file):
        shown.append(reader.next())
        assert reader.next() is None, "once"
        assert file.stat().st_mode & 0o077 == 0, "of this user alone"
    assert not list(tmp_path.glob("image*"))
    images = [image for image in shown if image]
    assert 1 < len(images) < FRAMES, "half of the frames of 30 Hz"
    image: Any = cv2.imdecode(np.frombuffer(images[-1].jpeg, np.uint8), cv2.IMREAD_COLOR)
    height, width = image.shape[:2]
    assert images[-1].size == (width, height)
    focal = width / 2 / np.tan(WebcamSettings.field_of_view / 2)
    np.testing.assert_allclose(images[-1].intrinsics[[0, 1], [0, 1]], focal, rtol=0.01)
    assert [image.stamp_ns for image in images] == sorted({image.stamp_ns for image in images})


def test_a_video_is_a_recording_to_clean_with_mediapipes_own_model(video: Path) -> None:
    pytest.importorskip("mediapipe.python.solutions", reason="no MediaPipe with a model of its own")
    source = open_recording(video)
    assert isinstance(source, VideoSource)
    frames = [message for _, message in source if isinstance(message, PoseRaw)]
    assert len(frames) == FRAMES
    assert not any(frame.bodies for frame in frames), "MediaPipe sees nobody in an empty image"


def test_a_lens_that_is_calibrated_is_used_for_images_of_any_size() -> None:
    known = CalibrationSettings([640, 480], [500.0, 510.0], [330.0, 235.0], [-0.3, 0.1, 0.0, 0.0, 0.0])
    guessed, lens, half = (
        Lens(size, 1.05, calibration)
        for size, calibration in (((640, 480), NOT_CALIBRATED), ((640, 480), known), ((320, 240), known))
    )
    assert guessed.intrinsics[0, 0] == pytest.approx(320 / np.tan(0.525))
    points = np.array([[x, y, 2.0] for x in (-1.0, -0.3, 0.5, 1.0) for y in (-0.7, 0.1, 0.6)])
    for one, size in ((lens, (640, 480)), (half, (320, 240))):
        scale = size[0] / 640
        matrix = np.array([[500.0, 0, 330.0], [0, 510.0, 235.0], [0, 0, 1]])
        bent = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(known.distortion))[0].reshape(-1, 2)
        straight = points @ one.intrinsics.T
        straight = straight[:, :2] / straight[:, 2:]
        for (x, y), expected in zip((bent + 0.5) * scale - 0.5, straight, strict=True):
            image = np.zeros((size[1], size[0], 3), np.float32)
            cv2.circle(image, (round(x), round(y)), 3, (1.0, 1.0, 1.0), -1)
            shown = np.argwhere(one.undistort(image)[..., 0] > 0.5)[:, ::-1].mean(axis=0)
            np.testing.assert_allclose(shown, expected, atol=1.0)
    image = np.zeros((480, 640, 3), np.uint8)
    assert guessed.undistort(image) is image
    with pytest.raises(LaunchError, match="expected images of 640 x 480, got 1280 x 720; calibrate it"):
        Lens((1280, 720), 1.05, known)


def test_a_webcam_that_is_not_there_is_looked_for_again(video: Path, model: str, clock: VirtualClock) -> None:
    source = open_webcam(WebcamSettings(camera=4, model=model), clock, Seen())
    frames = source.frames()
    for _ in range(30):
        assert next(frames) is None
    assert "camera 4 cannot be opened" in source.status()["camera"]
    assert sum(clock.slept_ns) > PAUSES_S[0] * 1e9


@pytest.mark.parametrize(("settings", "expected"), [
    (WebcamSettings(bodies=2), r"bodies: MediaPipe's own model finds one, got 2; .* such as https"),
    (WebcamSettings(model="gone.task"), "got 'gone.task'; download one"),
    (WebcamSettings(video="gone.mp4"), "expected a video that OpenCV can read"),
])  # fmt: skip
def test_settings_that_cannot_be_used_say_so(settings: WebcamSettings, expected: str) -> None:
    with pytest.raises(LaunchError, match=expected):
        camera.open_webcam(settings, SourceContext(Clock(), NOT_CALIBRATED))


def test_mediapipe_itself_refuses_a_file_that_is_no_model(model: str) -> None:
    pytest.importorskip("mediapipe")
    with (
        pytest.raises(LaunchError, match=r"MediaPipe cannot use .*pose.task"),
        webcam_device.mediapipe_landmarker(WebcamSettings(model=model)),
    ):
        pass


class Flickering:
    """A camera that gives a frame, drops another, and goes."""

    name = "flickering"

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def frames(self) -> Iterator[PoseRaw | None]:
        yield raw(0, walking(0))
        self.counts["late"] += 1
        yield raw(1, walking(1))

    def status(self) -> dict[str, str]:
        return {}


def test_what_was_dropped_is_counted_over_all_connections(clock: VirtualClock) -> None:
    source, dropped = CameraSource(clock, lambda: nullcontext(Flickering())), []
    for frame in source.frames():
        if frame:
            dropped.append(source.status().get("dropped.camera late"))
        if len(dropped) == 6:
            break
    assert dropped == [None, "1", "1", "2", "2", "3"]
    assert source.refused == {"camera lost": 2}
    assert source.status()["camera.connections"] == "3"


FRAMES_OF_BOTH = 30
PLACES = {
    "left": Pose(np.array([-2.0, 0.0, 1.4]), Rotation.from_euler("xz", [-1.7, -1.2]).as_quat()),
    "right": Pose(np.array([3.0, 1.0, 1.2]), Rotation.from_euler("xz", [-1.8, 1.3]).as_quat()),
}


def filmed(camera: str, hidden: range) -> list[PoseRaw]:
    """Two walkers as a camera at its place has them, without the joints hidden from it."""
    place = PLACES[camera]
    turn = Rotation.from_quat(place.orientation).inv()
    messages = []
    for m in walk(FRAMES_OF_BOTH, bodies=2):
        bodies = [
            RawBody(k, turn.apply(np.asarray(b.positions) - place.position), b.confidence)
            for k, b in enumerate(m.bodies if camera == "left" else m.bodies[::-1])
        ]
        for body in bodies:
            body.positions[hidden] = np.nan
        messages.append(dataclasses.replace(m, source=camera, bodies=bodies, sensor_pose=place, calibrated=True))
    return messages


@contextmanager
def merging(folder: Path, clock: Clock) -> Iterator[tuple[MergeSource, Iterator[PoseRaw | None], list[Publisher]]]:
    addresses = [f"ipc://{folder}/{name}" for name in PLACES]
    source = MergeSource(MergeSettings(addresses), SourceContext(clock, CalibrationSettings()))
    frames = source.frames()
    with Publisher(addresses[0]) as left, Publisher(addresses[1]) as right:
        assert next(frames) is None
        for publisher in (left, right):
            assert publisher.wait_for_subscribers({"merge"}, timeout_s=20)
        yield source, frames, [left, right]
    frames.close()


def test_two_cameras_become_one(folder: Path, clock: VirtualClock) -> None:
    merged: list[PoseRaw] = []
    with merging(folder, clock) as (source, frames, publishers):
        for views in zip(filmed("left", range(18, 20)), filmed("right", range(4, 6)), strict=True):
            for publisher, view in zip(publishers, views, strict=True):
                publisher.publish(POSE_RAW, view)
                count = source._received.total()
                while source._received.total() == count:
                    merged += [frame] if (frame := next(frames)) else []
    assert len(merged) >= FRAMES_OF_BOTH - 3
    assert all(m.source == "merged" and m.frame_id == "world" and m.calibrated for m in merged)
    truth = {m.stamp_ns: [b.positions for b in m.bodies] for m in walk(FRAMES_OF_BOTH, bodies=2)}
    for m in merged[2:]:  # who comes first is not kept waiting for cameras nobody has heard of
        nearest = truth[min(truth, key=lambda stamp: abs(stamp - m.stamp_ns))]
        assert len(m.bodies) == 2
        for positions in nearest:
            away = min(float(np.abs(body.positions - positions).max()) for body in m.bodies)
            assert away < 0.15, "complete, though neither camera saw all, and where the walker is"
    assert source.status()["camera"] == "2 of 2 cameras heard"


def test_what_is_lost_on_the_way_from_a_camera_is_told(folder: Path, clock: VirtualClock) -> None:
    first, *_, last = filmed("left", range(0))
    with merging(folder, clock) as (source, frames, (camera, _)):
        camera.publish(POSE_RAW, first)
        camera.deliveries.sequence[POSE_RAW] += 3  # which nobody heard
        camera.publish(POSE_RAW, last)
        until(lambda: (next(frames), source._received.total())[1] == 2)
    assert source.status()["dropped.lost pose/raw"] == "3"


@pytest.mark.parametrize(("change", "cause", "words"), [
    (lambda it: dataclasses.replace(it, calibrated=False), "camera_uncalibrated", "right: not merged"),
    (lambda it: dataclasses.replace(it, stamp_ns=it.stamp_ns - 300_000_000), "camera_late", "right: hardly merged"),
    (lambda it: dataclasses.replace(it, source="left"), "second_publisher", "give each sensor its own name"),
], ids=["uncalibrated", "a clock behind", "one name"])  # fmt: skip
def test_a_camera_not_merged_is_a_problem(folder: Path, clock: VirtualClock, change, cause: str, words: str):
    with merging(folder, clock) as (source, frames, (left, right)):
        for index, views in enumerate(zip(filmed("left", range(0)), filmed("right", range(0)), strict=True), start=1):
            left.publish(POSE_RAW, views[0])
            right.publish(POSE_RAW, change(views[1]))
            while source._received.total() + source._unread.total() < 2 * index:
                next(frames)
        (problem,) = source.problems()
        assert problem.cause == cause
        assert words in problem.text
        assert not source.problems(), "until it happens again"


@pytest.mark.parametrize("cameras", ["[]", '["tcp://127.0.0.1:7111"]', '["ipc:///a", "ipc:///a"]'])
def test_fewer_than_two_cameras_are_refused(make_launch: Callable[..., Launch], cameras: str) -> None:
    launch = make_launch(input__source="merge", input__merge__cameras=cameras)
    with pytest.raises(LaunchError, match="two input nodes or more"):
        PoseInputNode(launch)


def test_the_launch_files_that_ship_are_of_a_camera_without_download_and_of_two_whose_people_are_told_apart() -> None:
    one, two = Launch.read("webcam"), Launch.read("two_cameras")
    assert one.settings(InputSettings).source == "webcam"
    assert one.settings(InputSettings).webcam == WebcamSettings()
    assert len(two.settings(InputSettings).merge.cameras) == 2
    assert two.settings(PriorSettings).identify.enabled
