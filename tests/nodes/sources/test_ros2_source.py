from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Given, VirtualClock, raw, running, until, walking
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.processes import another_python
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.codec import MAX_BODIES
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.ros2.definitions import serialise
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.ros2.messages import tf_message, transform
from steadypose.nodes.sources import ros2 as module
from steadypose.nodes.sources.adapters import from_pose_array
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.registry import InputSettings, open_input
from steadypose.nodes.sources.ros2 import CACHE_NS, TfSettings, TfSource, TransformBuffer, TransformError
from steadypose.prior.body.layouts import CANONICAL, COCO17, SKELETONS

PUBLISHER = """
import sys
import numpy as np, rclpy
from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.time import Time
from visualization_msgs.msg import Marker, MarkerArray

rclpy.init()
node = rclpy.create_node("tracker")
joints = np.load(sys.argv[1]).tolist()
def pose(x, y, z):
    return Pose(position=Point(x=x, y=y, z=z))
if sys.argv[2] == "PoseArray":
    publisher = node.create_publisher(PoseArray, "/skeletons", 10)
    message = PoseArray(poses=[pose(*joint) for body in joints for joint in body])
    headers = [message.header]
    wrong = PoseArray(poses=message.poses[:5])
else:
    publisher = node.create_publisher(MarkerArray, "/skeletons", 10)
    numbered = [(100 * (3 + b) + j, joint) for b, body in enumerate(joints) for j, joint in enumerate(body)]
    message = MarkerArray(markers=[Marker(id=number, pose=pose(*joint)) for number, joint in numbered])
    headers = [marker.header for marker in message.markers]
    wrong = MarkerArray(markers=[Marker(id=99)])
for k in range(1, 1000):
    for header in headers:
        header.stamp = Time(nanoseconds=k * 33_333_333).to_msg()
        header.frame_id = "depth"
    publisher.publish(wrong)
    publisher.publish(message)
    rclpy.spin_once(node, timeout_sec=0.03)
"""


@pytest.mark.usefixtures("ros")
@pytest.mark.parametrize(("kind", "skeleton"), [("PoseArray", "smpl22"), ("MarkerArray", "azure_kinect32")])
def test_a_topic_becomes_pose_raw(make_launch: Callable[..., Launch], tmp_path: Path, kind: str, skeleton: str) -> None:
    joints = np.random.default_rng(0).normal(size=(2, len(SKELETONS[skeleton].joints), 3))
    joints[:, :22] += walker(0.5)[0]
    joints[1, 4] = np.nan
    np.save(tmp_path / "joints.npy", joints)
    launch = make_launch(
        nodes='["pose_input"]', input__source="ros2", input__ros2__topic="/skeletons", input__ros2__type=kind,
        transport__lossless="false",
    )  # fmt: skip
    source = PoseInputNode(launch)
    heard: list[PoseRaw] = []
    with (
        another_python(PUBLISHER, tmp_path, str(tmp_path / "joints.npy"), kind),
        running(source),
        Subscriber(launch.transport.endpoint("pose_input"), POSE_RAW) as subscriber,
    ):

        def enough() -> bool:
            while received := subscriber.receive(0):
                assert isinstance(received[1], PoseRaw)
                heard.append(received[1])
            return len(heard) >= 3 and any("not a" in cause for cause in source.status())

        until(enough, timeout_s=60)
    message = heard[-1]
    assert (message.skeleton, message.frame_id, message.source) == (skeleton, "depth", "/skeletons")
    assert message.stamp_ns % 33_333_333 == 0
    assert [body.id for body in message.bodies] == ([0, 1] if kind == "PoseArray" else [3, 4])
    for body, expected in zip(message.bodies, joints, strict=True):
        np.testing.assert_array_equal(body.positions, expected.astype(np.float32))
    assert message.bodies[1].confidence[4] == 0
    assert source.status()["camera"].startswith("/skeletons, ")


def test_more_bodies_than_a_message_holds_are_refused_and_the_next_frame_comes(make_launch, clock: VirtualClock):
    crowd = from_pose_array(pose_array(22 * (MAX_BODIES + 1)), CANONICAL, "z")
    frames = Given(raw(1, walking(1)), crowd, raw(2, walking(2)))
    source = PoseInputNode(make_launch(transport__lossless="false"), clock, frames)
    with running(source):
        until(lambda: source.health.published[POSE_RAW] == 2)
    assert source.health.counts["refused.ValueError"] == 1
    assert source.timeline
    assert source.timeline.wall(raw(1).stamp_ns) == clock.now_ns(), "captured at another time: it counts from now"


def pose_array(count: int) -> Any:
    points = [SimpleNamespace(position=SimpleNamespace(x=float(k), y=0.0, z=1.0)) for k in range(count)]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=2, nanosec=5), frame_id="world")
    return SimpleNamespace(header=header, poses=points)


def test_pose_arrays_hold_whole_bodies() -> None:
    message = from_pose_array(pose_array(34), COCO17, "y")
    assert (message.stamp_ns, message.skeleton, len(message.bodies)) == (2_000_000_005, "coco17", 2)
    assert message.bodies[1].positions[0, 0] == 17
    assert not from_pose_array(pose_array(0), COCO17, "y").bodies
    with pytest.raises(ValueError, match="multiple of the 17 joints of coco17, got 20"):
        from_pose_array(pose_array(20), COCO17, "y")


FRAME_NS = 33_333_333


def tf_of(stamp_ns: int, parent: str, child: str, place: Any, turned: Rotation) -> Any:
    return tf_message([transform(stamp_ns, parent, child, np.asarray(place, float), turned.as_quat())])


def matrix(place: Any, turned: Rotation) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turned.as_matrix(), place
    return whole


@given(st.integers(0, 2**32 - 1), st.sampled_from(["map", "odom", "base", "camera", "arm", "tool"]), st.data())
def test_any_frame_in_any_other_is_the_product_of_matrices(seed: int, target: str, data: st.DataObject) -> None:
    tree = {"odom": "map", "base": "odom", "camera": "base", "arm": "base", "tool": "arm"}
    rng, buffer, world = np.random.default_rng(seed), TransformBuffer(), {"map": np.eye(4)}
    for child, parent in tree.items():
        place, turned = rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
        buffer.add(tf_of(10, parent, child, place, turned), static=child in ("camera", "tool"))
        world[child] = world[parent] @ matrix(place, turned)
    source = data.draw(st.sampled_from(sorted(world)))
    place, quaternion = buffer.lookup(target, source, 10)
    expected = np.linalg.inv(world[target]) @ world[source]
    np.testing.assert_allclose(matrix(place, Rotation.from_quat(quaternion)), expected, atol=1e-9)


def test_between_two_stamps_it_is_interpolated_beyond_them_unknown_and_what_is_old_forgotten() -> None:
    buffer = TransformBuffer()
    for step in range(3):
        turned = Rotation.from_euler("z", 40 * step, degrees=True)
        buffer.add(tf_of(1000 + 100 * step, "odom", "base", [2.0 * step, 0, 0], turned), static=False)
    place, quaternion = buffer.lookup("odom", "base", 1150)
    np.testing.assert_allclose(place, [3.0, 0, 0])
    assert Rotation.from_quat(quaternion).as_euler("zyx", degrees=True)[0] == pytest.approx(60)
    for at_ns, words in ((999, "older than the oldest"), (1201, "newer than the newest")):
        with pytest.raises(TransformError, match=words):
            buffer.lookup("odom", "base", at_ns)
    with pytest.raises(TransformError, match=r"no path from 'camera' to 'odom'.*frames: base, odom"):
        buffer.lookup("odom", "camera", 1100)
    buffer, none = TransformBuffer(), Rotation.identity()
    for stamp_ns in (CACHE_NS, CACHE_NS * 3 // 2, CACHE_NS * 5 // 2):
        buffer.add(tf_of(stamp_ns, "odom", "base", [stamp_ns / 1e9, 0, 0], none), static=False)
    with pytest.raises(TransformError):
        buffer.lookup("odom", "base", CACHE_NS)
    buffer.add(tf_of(5, "odom", "base", [7.0, 0, 0], none), static=False)
    assert buffer.lookup("odom", "base", 5)[0][0] == 7.0
    buffer.add(tf_message([transform(6, "odom", "base", np.full(3, np.nan), none.as_quat())]), static=False)
    assert buffer.lookup("odom", "base", 5)[0][0] == 7.0


class Robot:
    """In the place of ROS: says what the test tells it to, when it is listened to."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[bytes], None]] = {}
        self.queue: list[tuple[str, Any]] = []

    def subscribe(self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched=False, depth=10) -> None:
        self.heard[topic] = heard

    def spin(self, timeout_s: float) -> None:
        for topic, message in self.queue:
            self.heard[topic](serialise(message))
        self.queue.clear()

    def close(self) -> None:
        self.heard.clear()


def test_a_message_waits_for_the_transform_of_its_stamp(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "check_ros", lambda: None)
    robot, frame = Robot(), raw(0, walking(0), stamp_ns=2_000)
    settings = TfSettings(fixed_frame="odom", sensor_frame="eye")
    source = TfSource(Given(frame, None, None), settings, clock, lambda _: robot)  # type: ignore[arg-type, return-value]
    frames = source.frames()
    robot.queue = [("tf_static", tf_of(0, "base", "eye", [0, 0, 1.5], Rotation.from_euler("z", 90, degrees=True)))]
    robot.queue.append(("tf", tf_of(1_000, "odom", "base", [0, 0, 0], Rotation.identity())))
    assert next(frames) is None, "not yet: the robot has only sent where it was before"
    robot.queue = [("tf", tf_of(3_000, "odom", "base", [4, 0, 0], Rotation.identity()))]
    found: Any = next(frames)
    assert found.calibrated
    np.testing.assert_allclose(found.sensor_pose.position, [2.0, 0, 1.5])
    turned = Rotation.from_quat(found.sensor_pose.orientation).as_euler("zyx", degrees=True)
    np.testing.assert_allclose(turned, [90, 0, 0], atol=1e-9)
    assert not source.problems()


def test_one_that_waits_in_vain_is_dropped_and_told(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "check_ros", lambda: None)
    settings = TfSettings(fixed_frame="odom")
    source = TfSource(Given(raw(0, walking(0)), None), settings, clock, lambda _: Robot())  # type: ignore[arg-type]
    frames = source.frames()
    assert next(frames) is None
    clock.set_ns = -7200 * 10**9
    clock.time_ns += 300_000_000
    assert next(frames) is None
    assert source.refused["without a transform"] == 1
    (problem,) = source.problems()
    assert "no path from 'camera' to 'odom'" in problem.text
    assert "ROS_DOMAIN_ID" in problem.text


def test_a_recording_is_not_asked_of_tf(tmp_path: Any) -> None:
    np.savez(tmp_path / "x.npz", positions=np.zeros((3, 22, 3)), skeleton="smpl22", fps=30.0)
    settings = InputSettings(recording=str(tmp_path / "x.npz"), tf=TfSettings(fixed_frame="odom"))
    with pytest.raises(LaunchError, match="for live sources"):
        open_input(Launch(sections={"input": settings}))
