"""The OAK camera's part on this machine, driven by real depthai pipelines without a camera: skeletons, and an image for
its calibration."""

import itertools
import threading
import time
from collections.abc import Callable
from contextlib import closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import depthai as dai
import numpy as np
import pytest
from conftest import VirtualClock, running
from scipy.spatial.transform import Rotation
from tests.helpers import fake_oak
from tests.helpers.fake_oak import CAMERA, Moment, Player, moment, opener, plugged, script

from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import JOINTS, PoseRaw, PoseWorld
from steadypose.nodes.commands.calibrate import CalibrateOak, calibrate
from steadypose.nodes.commands.run import _check
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.prior_node import PriorNode
from steadypose.nodes.graph.trajectory_node import TrajectoryNode
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources import oak_device
from steadypose.nodes.sources.camera import PAUSES_S, CameraSource, open_oak
from steadypose.nodes.sources.image import ImageReader, ImageWriter
from steadypose.nodes.sources.oak_device import FRAME_ID, QUEUE, TIMEOUT_S, Host, Still, capture
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.registry import InputSettings, open_input
from steadypose.nodes.sources.source import CalibrationSettings, CameraError, OakSettings, SourceContext
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.camera.calibration import CalibrationError

CONTEXT = SourceContext(Clock(), CalibrationSettings())
MakeLaunch = Callable[..., Launch]
BODY = [i for i, name in enumerate(COCO17.joints) if name.split("_")[-1] not in ("nose", "eye", "ear")]


@pytest.fixture(scope="module")
def walk() -> list[Moment]:
    return [moment(frame, people=2) for frame in range(4)]


def take(host: Host, frames: int) -> list[PoseRaw]:
    return list(itertools.islice((frame for frame in host.frames() if frame), frames))


def test_people_are_lifted_where_they_stand(walk: list[Moment]) -> None:
    with plugged(script(walk), Clock()) as host:
        frames = take(host, len(walk))
    assert [frame.frame_id for frame in frames] == [FRAME_ID] * len(walk)
    assert {frame.skeleton for frame in frames} == {"coco17"}
    for frame, truth in zip(frames, walk, strict=True):
        assert [body.id for body in frame.bodies] == [0, 1]
        for body, joints in zip(frame.bodies, truth.joints, strict=True):
            seen = body.confidence > 0
            found = CAMERA.project(body.positions[seen].astype(float))
            np.testing.assert_allclose(found, CAMERA.project(joints[seen]), atol=0.6)
            error = np.linalg.norm(body.positions - joints, axis=-1)[BODY]
            assert np.isfinite(error).sum() >= 8
            assert np.nanmedian(error) < 0.04


def test_the_newest_image_is_there_for_the_viewer(walk: list[Moment], tmp_path: Path) -> None:
    messages = script(walk[:1])
    colour = fake_oak.colour_frame(100)
    colour.setTimestamp(messages[0][1].getTimestamp())
    with (
        closing(ImageWriter(tmp_path / "image")) as writer,
        plugged([("colour", colour), *messages], Clock(), writer=writer) as host,
    ):
        (frame,) = take(host, 1)
        reader = ImageReader(tmp_path / "image")
        late = time.monotonic() + 5.0
        while (image := reader.next()) is None and time.monotonic() < late:
            time.sleep(0.01)
        assert image is not None
        assert not host.counts
    assert image.stamp_ns == frame.stamp_ns, "drawn with the skeleton that was found in it"
    scale = image.size[0] / CAMERA.width
    np.testing.assert_allclose(image.intrinsics[:2], CAMERA.intrinsics[:2] * scale)
    assert not (tmp_path / "image").exists(), "the image goes with the camera"


@pytest.mark.parametrize("milliseconds", [0, -15, 12, 16])
def test_stamps_are_of_capture_and_colour_and_depth_need_not_coincide(walk: list[Moment], milliseconds: int) -> None:
    before = time.time_ns()
    messages = script(walk, depth_late=timedelta(milliseconds=milliseconds))
    after = time.time_ns()
    with plugged(messages, Clock()) as host:
        stamps = [frame.stamp_ns for frame in take(host, len(walk) - (milliseconds != 0))]
    if not milliseconds:
        assert before - 5_000_000 < stamps[0] < after + 5_000_000, "wall time at which the first frame was made"
    np.testing.assert_allclose(np.diff(stamps) / 1e9, 1 / 30, atol=1e-5)


def test_the_imu_levels_the_camera_which_is_taken_for_level_without_one(walk: list[Moment]) -> None:
    tilt = Rotation.from_euler("xz", [20, -5], degrees=True)
    up = tilt.apply([0.0, -1.0, 0.0])
    mounted = Rotation.from_euler("y", 90, degrees=True)
    with plugged(script(walk, up=mounted.inv().apply(up).tolist()), Clock(), mounted.as_matrix()) as host:
        frame = take(host, len(walk))[-1]
        measured = host.level.measured
    assert measured
    assert not frame.calibrated
    source = CameraSource(CONTEXT.clock, lambda: opener(lambda _: script(walk))(OakSettings(), CONTEXT.clock))
    frames = source.frames()
    level = next(frame for frame in frames if frame)
    assert source.status()["camera.level"] == "taken for level"
    frames.close()
    for found, upwards in ((frame, up), (level, np.array([0.0, -1.0, 0.0]))):
        turned = Rotation.from_quat(found.sensor_pose.orientation).apply(upwards)
        np.testing.assert_allclose(turned, [0.0, 0.0, 1.0], atol=1e-3)


def test_from_the_camera_to_the_world(make_launch: MakeLaunch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oak_device, "QUEUE", 1000)  # these frames come faster than any camera's
    scene = [moment(frame) for frame in range(24)]
    launch = make_launch(input__source="oak")
    opens, settings = opener(lambda _: script(scene)), launch.settings(InputSettings).oak
    source = CameraSource(CONTEXT.clock, lambda: opens(settings, CONTEXT.clock))
    nodes = [PoseInputNode(launch, Clock(), source), PriorNode(launch), TrajectoryNode(launch)]
    worlds: list[PoseWorld] = []
    with Subscriber(launch.transport.endpoint("trajectory"), POSE_WORLD) as subscriber, running(*nodes):
        end = time.monotonic() + 120
        while len(worlds) < 12 and time.monotonic() < end:
            received = subscriber.receive(1)
            if received and isinstance(received[1], PoseWorld) and received[1].bodies:
                worlds.append(received[1])
        news = nodes[0].diagnostics().values
    assert len(worlds) == 12
    assert (news["camera"], news["state"], news["camera.name"]) == ("streaming", "running", "oak-test")
    assert int(news["timeline.stamp_ns"]) == int(news["timeline.wall_ns"])
    hips = [COCO17.joints.index("left_hip"), COCO17.joints.index("right_hip")]
    path = np.array([one.joints[0][hips].mean(axis=0)[[0, 2]] for one in scene])
    for world in worlds[4:]:
        seen = world.bodies[0].positions[[JOINTS.index("left_hip"), JOINTS.index("right_hip")]].mean(axis=0)
        # a level camera: its x is the world's, its depth the world's y; how high it stands it is not told
        assert np.linalg.norm(path - seen[:2], axis=1).min() < 0.15, "they walk on the spot, which no root does"
        heights = world.bodies[0].positions[:, 2] - seen[2]
        assert np.nanmax(heights) == pytest.approx(0.6, abs=0.25), "upright: the neck, or the head"
        assert np.nanmin(heights) == pytest.approx(-0.9, abs=0.2), "the feet"


def test_frames_end_when_the_camera_is_unplugged(walk: list[Moment]) -> None:
    def pull(pipeline: dai.Pipeline, player: Player) -> None:
        player.done.wait(10)
        taken.wait(10)
        pipeline.stop()

    taken = threading.Event()
    with plugged(script(walk[:2]), Clock(), unplug=pull) as host:
        frames = host.frames()
        for _ in range(2):
            assert next(frame for frame in frames if frame)
        taken.set()
        assert not any(frames)


def test_it_looks_for_a_camera_at_growing_intervals(clock: VirtualClock) -> None:
    tries: list[float] = []

    def connect() -> Any:
        tries.append(clock.now_ns() / 1e9)
        raise RuntimeError("no camera found")

    source = CameraSource(clock, connect)
    frames = source.frames()
    while len(tries) < len(PAUSES_S) + 2:
        assert next(frames) is None
    np.testing.assert_allclose(np.diff(tries), [*PAUSES_S, PAUSES_S[-1]], atol=0.2)
    assert "no camera found; next try in" in source.status()["camera"]
    assert source.status()["state"] == source.status()["camera"], "what `steadypose run` shows of the node"


def test_a_camera_that_falls_silent_is_given_up(clock: VirtualClock, walk: list[Moment]) -> None:
    with plugged(script(walk[:1]), clock) as host:
        frames = host.frames()
        assert next(frame for frame in frames if frame)
        assert next(frames) is None
        clock.set_ns = -7200 * 10**9
        clock.time_ns += round((TIMEOUT_S + 0.1) * 1e9)
        assert list(frames) == []


def test_a_program_that_is_late_gets_the_newest_frames(walk: list[Moment]) -> None:
    moments = [walk[index % len(walk)] for index in range(QUEUE + 3)]
    messages = script(moments)
    with plugged(messages, Clock()) as host:
        end = time.monotonic() + 20
        while host.counts["late"] < 3 and time.monotonic() < end:
            time.sleep(0)  # the pipeline's threads run
        stamps = [frame.stamp_ns for frame in take(host, QUEUE)]
    assert host.counts["late"] == 3
    assert len(stamps) == QUEUE
    assert stamps == sorted(stamps)


def test_what_is_no_skeleton_is_counted_and_the_next_frame_comes(walk: list[Moment]) -> None:
    messages = script([walk[0]] * 4)
    bare = dai.ImgFrame()  # no image, and nothing is said of its camera
    few = fake_oak.detections(walk[0])
    few.detections = few.detections[:1]
    points = few.detections[0]
    points.setKeypoints(dai.KeypointsList([dai.Keypoint()] * 5))
    few.detections = [points]
    wild = fake_oak.detections(walk[0])
    people = wild.detections
    keypoints = people[0].getKeypoints()
    for keypoint, x in zip(keypoints, (np.nan, np.inf, -1e30, 1e30), strict=False):
        keypoint.imageCoordinates = dai.Point3f(float(x), 0.5, 0.0)
    people[0].setKeypoints(dai.KeypointsList(keypoints))
    wild.detections = people
    for place, message in ((1, bare), (2, few), (4, wild)):
        name, whole = messages[place]
        message.setTimestamp(whole.getTimestamp())
        message.setSequenceNum(place // 2)
        messages[place] = (name, message)
    with plugged(messages, Clock()) as host:
        frames = take(host, 3)
    counts = host.counts
    assert sum(n for cause, n in counts.items() if cause.startswith("frame: ")) == 1, counts
    assert counts.total() - 1 == counts["person without the 17 key points of COCO"] == 1, counts
    for cause in counts:  # as `diagnostics` reads them while the pipeline counts
        host._skeletons.counts[f"{cause} again"] += 1
    assert [len(frame.bodies) for frame in frames] == [0, 2, 2]
    assert np.isnan(frames[1].bodies[0].positions[:4]).all()
    assert np.isfinite(frames[1].bodies[0].positions[5]).all()


def test_an_archive_that_is_not_there_and_a_camera_that_gives_nothing_say_so(tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(LaunchError, match=r"archive: expected an NN archive"):
        open_oak(OakSettings(archive=str(tmp_path / "none.tar.xz")), CONTEXT)
    monkeypatch.setattr(oak_device, "PAIR_TIMEOUT_S", 0.01)
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        depth = pipeline.create(Player).outputs["depth"]
        with pytest.raises(CameraError, match="no image with depth"):
            capture(pipeline, depth, depth, None)


def test_the_launch_file_can_be_run_without_a_camera_being_there_and_then_says_so(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(oak_device.dai.Device, "getAllAvailableDevices", staticmethod(list))
    launch = Launch.read("oak")
    assert isinstance(open_input(launch), CameraSource)
    _check(launch)
    with pytest.raises(RuntimeError, match="no camera found"), oak_device.connect(OakSettings(), Clock()):
        pass
    (tmp_path / "kitchen.toml").write_text("")
    with pytest.raises(CalibrationError, match="no camera found"):
        calibrate(CalibrateOak(tmp_path / "kitchen.toml", tmp_path / "floor"))


UP = np.array([0.0, -np.cos(0.2), np.sin(0.2)])


def test_the_image_after_those_in_which_the_camera_settles() -> None:
    scene = moment(0)
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        player = pipeline.create(Player)
        player.script = [("imu", fake_oak.readings(UP.tolist()))]
        start = dai.Clock.now()  # pyright: ignore[reportCallIssue] (static)
        for index in range(2):
            for name, message in (
                ("colour", fake_oak.colour_frame(100 + index)),
                ("depth", fake_oak.depth_frame(scene)),
            ):
                message.setTimestamp(start + index * oak_device.SYNC_THRESHOLD * 2)
                player.script.append((name, message))
        out = player.outputs
        still = capture(pipeline, out["colour"], out["depth"], (out["imu"], np.eye(3)), settle=1)
    assert still.colour[0, 0].tolist() == [101, 0, 10]
    np.testing.assert_array_equal(still.depth, scene.depth)
    np.testing.assert_allclose(still.intrinsics, CAMERA.intrinsics)
    assert still.up is not None
    np.testing.assert_allclose(still.up, UP, atol=1e-6)


def test_it_becomes_the_files_and_the_lens_that_the_other_steps_want(tmp_path: Path, monkeypatch, capsys) -> None:
    scene = moment(0)
    colour = np.zeros((*scene.depth.shape, 3), np.uint8)
    monkeypatch.setattr(oak_device, "capture_with_camera", lambda _: Still(colour, scene.depth, CAMERA.intrinsics, UP))
    launch, before = tmp_path / "kitchen.toml", '# mine\n[input]\nsource = "oak"\n'
    launch.write_text(before)
    with pytest.raises(CalibrationError, match=r"gone/floor\.png cannot be written"):
        calibrate(CalibrateOak(launch, tmp_path / "gone" / "floor"))
    assert launch.read_text() == before
    calibrate(CalibrateOak(launch, tmp_path / "floor"))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "floor.depth.png"), cv2.IMREAD_UNCHANGED), scene.depth)
    assert (tmp_path / "floor.png").is_file()
    saved = Launch.read(launch).settings(InputSettings).calibration
    assert list(saved.size) == [CAMERA.width, CAMERA.height]
    assert list(saved.focal) == pytest.approx([CAMERA.focal, CAMERA.focal])
    assert launch.read_text().startswith("# mine")
    assert "floor.depth.png --up 0.000 -0.980 0.199" in capsys.readouterr().out
