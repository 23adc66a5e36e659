"""The ROS 2 bridge against a real ROS 2 node in another process, over DDS."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import another_python, running, until
from scipy.spatial.transform import Rotation
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.topics import DIAGNOSTICS, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Diagnostics, Level, PoseWorld, Tracking
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.ros2.bridge import Ros2BridgeNode, check_ros2
from steadypose.nodes.sinks.ros2.rep155 import JOINTS, LINKS, frames

LISTENER = """
import json, sys
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from steadypose.nodes.ros2_dds import LOCALHOST, QOS, IdsList, TFMessage

rclpy.init()
node = rclpy.create_node("listener")
heard = {}
def note(name, convert):
    return lambda message: heard.setdefault(name, convert(message))
def stamp(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(MarkerArray, "/steadypose/markers", note("markers", lambda m: [
    {"ns": k.ns, "stamp": stamp(k.header), "frame": k.header.frame_id, "type": k.type, "text": k.text,
     "points": [[p.x, p.y, p.z] for p in k.points], "colours": len(k.colors)} for k in m.markers]), 10)
node.create_subscription(PoseArray, "/steadypose/poses", note("poses", lambda m: {"stamp": stamp(m.header), "poses": [
    [p.position.x, p.position.y, p.position.z, p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w]
    for p in m.poses]}), 10)
node.create_subscription(JointState, "/humans/bodies/b1/joint_states", note("angles", lambda m: dict(
    zip(m.name, m.position))), 10)
node.create_subscription(String, "/humans/bodies/b1/urdf", note("urdf", lambda m: m.data), latched)
node.create_subscription(DiagnosticArray, "/diagnostics", note("diagnostics", lambda m: {
    "name": m.status[0].name,
    "level": m.status[0].level[0], "values": {v.key: v.value for v in m.status[0].values}}), 10)
domain = node.context.get_domain_id()
configured = Domain(domain, LOCALHOST)
participant = DomainParticipant(domain)
readers = {"tf": DataReader(participant, Topic(participant, "rt/tf", TFMessage), qos=QOS),
           "tracked": DataReader(participant, Topic(participant, "rt/humans/bodies/tracked", IdsList), qos=QOS)}
def plain(value):
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value
while len(heard) < 7:
    rclpy.spin_once(node, timeout_sec=0.05)
    for name, reader in readers.items():
        for sample in reader.take(1):
            heard.setdefault(name, plain(sample))
heard["types"] = dict(node.get_topic_names_and_types())
heard["nodes"] = node.get_node_names()
print(json.dumps(heard))
"""


@pytest.fixture
def worlds() -> list[PoseWorld]:
    """A second of two bodies that walk, one of which has an arm hidden."""
    found = [message for topic, message in messages(3.0, bodies=2) if topic == POSE_WORLD]
    return [message for message in found if isinstance(message, PoseWorld)][-20:]


@pytest.mark.usefixtures("ros")
def test_a_ros_node_hears_bodies(make_launch: Callable[..., Launch], tmp_path: Path, worlds: list[PoseWorld]) -> None:
    launch = make_launch(nodes='["trajectory", "ros2_bridge"]', transport__lossless="true")
    news = Diagnostics(1, "prior", Level.WARN, "late", {"dropped.late": "3"})
    bridge = Ros2BridgeNode(launch)
    stream = cycle(worlds)
    with (
        another_python(LISTENER, tmp_path) as listener,
        Publisher(launch.transport.endpoint("trajectory"), reliable={"ros2_bridge"}) as publisher,
        running(bridge),
    ):
        assert publisher.wait_for_subscribers({"ros2_bridge"}, timeout_s=20)

        def told() -> bool:
            publisher.publish(POSE_WORLD, next(stream))
            publisher.publish(DIAGNOSTICS, news)
            return listener.poll() is not None

        until(told, timeout_s=60)
        assert listener.stdout
        heard = json.loads(listener.stdout.read())
    assert not bridge.health.counts

    by_stamp = {message.stamp_ns: message for message in worlds}
    said = by_stamp[heard["poses"]["stamp"]]
    poses = np.array(heard["poses"]["poses"]).reshape(2, 22, 7)
    for body, found in zip(said.bodies, poses, strict=True):
        np.testing.assert_array_equal(found[:, :3], body.positions.astype(float))
        np.testing.assert_allclose((Rotation.from_quat(found[0, 3:]) * Rotation.from_quat(body.rotations[0]).inv())
                                   .magnitude(), 0, atol=1e-6)  # fmt: skip

    marks = {mark["ns"]: mark for mark in heard["markers"]}
    assert set(marks) == {f"{body}/{part}" for body in ("b0", "b1") for part in ("joints", "bones", "name")}
    joints, bones = marks["b1/joints"], marks["b1/bones"]
    assert (joints["frame"], joints["colours"], len(bones["points"]), bones["colours"]) == ("world", 22, 42, 42)
    np.testing.assert_array_equal(joints["points"], by_stamp[joints["stamp"]].bodies[1].positions.astype(float))

    # of one message, all bodies, and of each all links
    transforms = {t["child_frame_id"]: t for t in heard["tf"]["transforms"]}
    assert set(transforms) == {f"{link}_{body}" for link in LINKS for body in ("b0", "b1")}
    stamp = transforms["body_b1"]["header"]["stamp"]
    links = frames(by_stamp[stamp["sec"] * 10**9 + stamp["nanosec"]].bodies[1])
    root = _pose(transforms["body_b1"]["transform"])
    assert transforms["body_b1"]["header"]["frame_id"] == "world"
    assert transforms["l_wrist_b1"]["header"]["frame_id"] == "body_b1"
    wrist = root @ _pose(transforms["l_wrist_b1"]["transform"])
    np.testing.assert_allclose(wrist[:3, 3], links["l_wrist"][0], atol=1e-6)
    np.testing.assert_allclose(wrist[:3, :3], links["l_wrist"][1], atol=1e-6)

    assert heard["tracked"]["ids"] == ["b0", "b1"]
    assert set(heard["angles"]) == {f"{joint}_b1" for joint in JOINTS}
    moving = {joint.get("name") for joint in ElementTree.fromstring(heard["urdf"]).iterfind("joint[@type='revolute']")}
    assert moving == set(heard["angles"])
    assert heard["diagnostics"] == {"name": "steadypose: prior", "level": 1, "values": {"dropped.late": "3"}}
    # ROS 2 itself takes what Cyclone DDS publishes for what it is
    assert heard["types"]["/tf"] == ["tf2_msgs/msg/TFMessage"]
    assert heard["types"]["/humans/bodies/tracked"] == ["hri_msgs/msg/IdsList"]
    assert "steadypose" in heard["nodes"]


def _pose(transform: dict[str, dict[str, float]]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(list(transform["rotation"].values())).as_matrix()
    pose[:3, 3] = list(transform["translation"].values())
    return pose


@pytest.mark.usefixtures("ros")
def test_bodies_that_cannot_be_shown_are_left_out(worlds: list[PoseWorld]) -> None:
    from steadypose.nodes.sinks.ros2.output import RosOutput

    message = worlds[0]
    with RosOutput() as output:
        assert output.publish_bodies(message) == 0
        assert set(output._bodies) == {"b0", "b1"}
        message.bodies[0].positions[3] = np.nan
        message.bodies[1].tracking = Tracking.LOST
        assert output.publish_bodies(message) == 1
        assert not output._bodies, "their topics go with them"
        message.bodies[0].positions[3] = 0.0
        message.bodies[0].rotations[:] = 0.0
        assert output.publish_bodies(message) == 1


def test_without_ros_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steadypose.nodes.graph.extras.find_spec", lambda name: None)
    with pytest.raises(LaunchError, match=r"steadypose\[ros2\]"):
        check_ros2(Launch())
