from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import VirtualClock, another_python, raw, running, until, walking
from tests.helpers.given import Given
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.codec import MAX_BODIES
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sources.adapters import from_pose_array
from steadypose.nodes.sources.pose_input import PoseInputNode
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


def test_more_bodies_than_a_message_holds_are_refused_and_the_next_frame_comes(
    make_launch: Callable[..., Launch], clock: VirtualClock
) -> None:
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
