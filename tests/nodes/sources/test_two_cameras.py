import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import VirtualClock, until, walk
from scipy.spatial.transform import Rotation

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.camera import MergeSettings, MergeSource
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.registry import InputSettings
from steadypose.nodes.sources.source import CalibrationSettings, SourceContext
from steadypose.prior.clean.settings import PriorSettings

FRAMES = 30
PLACES = {
    "left": Pose(np.array([-2.0, 0.0, 1.4]), Rotation.from_euler("xz", [-1.7, -1.2]).as_quat()),
    "right": Pose(np.array([3.0, 1.0, 1.2]), Rotation.from_euler("xz", [-1.8, 1.3]).as_quat()),
}


def filmed(camera: str, hidden: range) -> list[PoseRaw]:
    """Two walkers as a camera at its place has them, without the joints hidden from it."""
    place = PLACES[camera]
    turn = Rotation.from_quat(place.orientation).inv()
    messages = []
    for m in walk(FRAMES, bodies=2):
        bodies = [
            RawBody(k, turn.apply(np.asarray(b.positions) - place.position), b.confidence)
            for k, b in enumerate(m.bodies if camera == "left" else m.bodies[::-1])
        ]
        for body in bodies:
            body.positions[hidden] = np.nan
        messages.append(dataclasses.replace(m, source=camera, bodies=bodies, sensor_pose=place, calibrated=True))
    return messages


def test_two_cameras_become_one(folder: Path, clock: VirtualClock) -> None:
    addresses = [f"ipc://{folder}/{name}" for name in PLACES]
    source = MergeSource(MergeSettings(addresses), SourceContext(clock, CalibrationSettings()))
    frames, merged = source.frames(), []
    with Publisher(addresses[0]) as left, Publisher(addresses[1]) as right:
        assert next(frames) is None
        for publisher in (left, right):
            assert publisher.wait_for_subscribers({"merge"}, timeout_s=20)
        for views in zip(filmed("left", range(18, 20)), filmed("right", range(4, 6)), strict=True):
            for publisher, view in zip((left, right), views, strict=True):
                publisher.publish(POSE_RAW, view)
                count = source._received.total()
                while source._received.total() == count:
                    merged += [frame] if (frame := next(frames)) else []
    frames.close()
    assert len(merged) >= FRAMES - 3
    assert all(m.source == "merged" and m.frame_id == "world" and m.calibrated for m in merged)
    truth = {m.stamp_ns: [b.positions for b in m.bodies] for m in walk(FRAMES, bodies=2)}
    for m in merged[2:]:  # who comes first is not kept waiting for cameras nobody has heard of
        nearest = truth[min(truth, key=lambda stamp: abs(stamp - m.stamp_ns))]
        assert len(m.bodies) == 2
        for positions in nearest:
            away = min(float(np.abs(body.positions - positions).max()) for body in m.bodies)
            assert away < 0.15, "complete, though neither camera saw all, and where the walker is"
    assert source.status()["camera"] == "2 of 2 cameras heard"


def test_what_is_lost_on_the_way_from_a_camera_is_told(folder: Path) -> None:
    addresses = [f"ipc://{folder}/{name}" for name in PLACES]
    source = MergeSource(MergeSettings(addresses), SourceContext(VirtualClock(), CalibrationSettings()))
    frames, (first, *_, last) = source.frames(), filmed("left", range(0))
    with Publisher(addresses[0]) as camera:
        assert next(frames) is None
        assert camera.wait_for_subscribers({"merge"}, timeout_s=20)
        camera.publish(POSE_RAW, first)
        camera.deliveries.sequence[POSE_RAW] += 3  # which nobody heard
        camera.publish(POSE_RAW, last)
        until(lambda: (next(frames), source._received.total())[1] == 2)
    assert source.status()["dropped.lost pose/raw"] == "3"
    frames.close()


@pytest.mark.parametrize(
    ("change", "cause", "words"),
    [
        (lambda it: dataclasses.replace(it, calibrated=False), "camera_uncalibrated", "right: not merged"),
        (lambda it: dataclasses.replace(it, stamp_ns=it.stamp_ns - 300_000_000), "camera_late", "right: hardly merged"),
        (lambda it: dataclasses.replace(it, source="left"), "second_publisher", "give each sensor its own name"),
    ],
    ids=["uncalibrated", "a clock behind", "one name"],
)
def test_a_camera_that_is_not_merged_is_a_problem(
    folder: Path, clock: VirtualClock, change: Callable[[PoseRaw], PoseRaw], cause: str, words: str
) -> None:
    addresses = [f"ipc://{folder}/{name}" for name in PLACES]
    source = MergeSource(MergeSettings(addresses), SourceContext(clock, CalibrationSettings()))
    frames = source.frames()
    with Publisher(addresses[0]) as left, Publisher(addresses[1]) as right:
        assert next(frames) is None
        for publisher in (left, right):
            assert publisher.wait_for_subscribers({"merge"}, timeout_s=20)
        for index, views in enumerate(zip(filmed("left", range(0)), filmed("right", range(0)), strict=True), start=1):
            left.publish(POSE_RAW, views[0])
            right.publish(POSE_RAW, change(views[1]))
            while source._received.total() + source._unread.total() < 2 * index:
                next(frames)
        (problem,) = source.problems()
        assert problem.cause == cause
        assert words in problem.text
        assert not source.problems(), "until it happens again"
    frames.close()


@pytest.mark.parametrize("cameras", ["[]", '["tcp://127.0.0.1:7111"]', '["ipc:///a", "ipc:///a"]'])
def test_fewer_than_two_cameras_are_refused(make_launch: Callable[..., Launch], cameras: str) -> None:
    launch = make_launch(input__source="merge", input__merge__cameras=cameras)
    with pytest.raises(LaunchError, match="two input nodes or more"):
        PoseInputNode(launch)


def test_the_launch_file_that_ships_reads() -> None:
    launch = Launch.read("two_cameras")
    assert len(launch.settings(InputSettings).merge.cameras) == 2
    assert not launch.transport.lossless
    assert launch.settings(PriorSettings).identify.enabled
