import dataclasses
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import VirtualClock, running, until
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, world_body
from tests.helpers.processes import another_python
from tests.helpers.ros_output import Kept
from tests.helpers.synthetic_poses import messages_on

from steadypose.msgs.codec import decode
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Diagnostics, Level, Pose, PoseClean, PoseWorld, Tracking, WorldBody
from steadypose.nodes import ros2 as connecting
from steadypose.nodes.commands.doctor import required
from steadypose.nodes.graph.clock import Timeline
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.ros2.definitions import Connection, deserialise, new, serialise, stamp_ns
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.ros2.bridge import SILENT_NS, Ros2BridgeNode, Ros2BridgeSettings, RosOutput, check_ros2
from steadypose.nodes.sinks.ros2.messages import OF_BODY, BodyTopics
from steadypose.nodes.sinks.ros2.rep155 import JOINTS, LINKS, body_name, frames, joint_angles, measures, urdf
from steadypose.nodes.sources.ros2 import TransformBuffer
from steadypose.prior.body.skeleton import REST_OFFSETS, J

LISTENER = """
import importlib, json, sys
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile

rclpy.init()
node = rclpy.create_node("listener")
kinds, heard = json.loads(sys.argv[1]), {}
for topic, kind in kinds.items():
    package, _, name = kind.split("/")
    kept = DurabilityPolicy.TRANSIENT_LOCAL if topic.endswith("urdf") else DurabilityPolicy.VOLATILE
    kind = getattr(importlib.import_module(f"{package}.msg"), name)
    hear = lambda message, topic=topic: heard.setdefault(topic, message)
    node.create_subscription(kind, topic, hear, QoSProfile(depth=10, durability=kept))
print("ready", flush=True)
while len(heard) < len(kinds):
    rclpy.spin_once(node, timeout_sec=0.05)
odom = heard["/humans/bodies/b1/odom"]
stamp, at = odom.header.stamp, odom.pose.pose.position
print(json.dumps({
    "stamp": stamp.sec * 10**9 + stamp.nanosec, "frames": [odom.header.frame_id, odom.child_frame_id],
    "position": [at.x, at.y, at.z], "types": dict(node.get_topic_names_and_types()),
    "hash": str(node.get_publishers_info_by_topic("/humans/bodies/b1/odom")[0].topic_type_hash),
}), flush=True)
"""
KINDS = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/humans/bodies/b1/joint_states": "sensor_msgs/msg/JointState",
    "/humans/bodies/b1/odom": "nav_msgs/msg/Odometry",
    "/humans/bodies/b1/urdf": "std_msgs/msg/String",
    "/steadypose/markers": "visualization_msgs/msg/MarkerArray",
    "/steadypose/poses": "geometry_msgs/msg/PoseArray",
}
Stream = tuple[list[PoseClean], list[PoseWorld]]
NEWS = Diagnostics(1, "prior", Level.WARN, "late", {"dropped.late": "3"})


@pytest.fixture(scope="module")
def stream() -> Stream:
    """A second of two bodies that walk, one of which has an arm hidden."""
    return tuple(messages_on(topic, 3.0, bodies=2)[-20:] for topic in (POSE_CLEAN, POSE_WORLD))  # type: ignore[return-value]


@pytest.mark.slow
@pytest.mark.usefixtures("ros")
def test_a_ros_node_hears_bodies(make_launch: Callable[..., Launch], tmp_path: Path, stream: Stream) -> None:
    worlds = stream[1]
    launch = make_launch(nodes='["trajectory", "ros2_bridge"]', transport__lossless="true", ros2__world_frame="odom")
    bridge = Ros2BridgeNode(launch)
    bridge.timeline = Timeline(worlds[0].stamp_ns, bridge.clock.now_ns(), 1.0)
    turn = cycle(worlds)
    with (
        another_python(LISTENER, tmp_path, json.dumps(KINDS)) as listener,
        Publisher(launch.transport.endpoint("trajectory"), reliable={"ros2_bridge"}) as publisher,
        running(bridge),
    ):
        assert listener.stdout
        lines: list[str] = []
        threading.Thread(target=lambda: lines.extend(listener.stdout or ()), daemon=True).start()

        def received() -> bool:
            publisher.publish(POSE_WORLD, next(turn), timeout_s=1)
            publisher.publish(DIAGNOSTICS, NEWS)
            return len(lines) > 1

        until(received, timeout_s=120)
    heard = json.loads(lines[-1])
    assert not bridge.health.counts
    body = next(message for message in worlds if message.stamp_ns == heard["stamp"]).bodies[1]
    assert (heard["frames"], heard["position"]) == (["odom", "body_b1"], body.root_position.tolist())
    assert heard["types"]["/tf"] == ["tf2_msgs/msg/TFMessage"]
    assert heard["types"]["/humans/bodies/tracked"] == ["hri_msgs/msg/IdsList"]
    assert "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0" in heard["hash"], "as ROS has it"


def test_what_is_said_of_bodies_and_nodes(stream: Stream) -> None:
    kept, world = Kept(), stream[1][-1]
    body = dataclasses.replace(world.bodies[1], covariance=np.diag(np.arange(1, 7) * 1e-4))
    world = dataclasses.replace(world, bodies=[world.bodies[0], body])
    topics = BodyTopics(kept, "odom")
    topics.send(world)
    topics.send(NEWS)
    (poses,), (markers,) = kept.of("steadypose/poses"), kept.of("steadypose/markers")
    placed = np.array([xyz(it.position) for it in poses.poses]).reshape(2, 22, 3)
    for body, found in zip(world.bodies, placed, strict=True):
        np.testing.assert_array_equal(found, body.positions)

    marks = {mark.ns: mark for mark in markers.markers}
    parts = ("joints", "bones", "velocity", "name")
    assert set(marks) == {f"{body}/{part}" for body in ("b0", "b1") for part in parts}
    drawn, bones = marks["b1/joints"], marks["b1/bones"]
    assert (drawn.header.frame_id, len(drawn.colors), len(bones.points), len(bones.colors)) == ("odom", 22, 42, 42)
    np.testing.assert_array_equal([xyz(point) for point in drawn.points], world.bodies[1].positions)

    (odom,) = kept.of("humans/bodies/b1/odom")
    assert (odom.header.frame_id, odom.child_frame_id) == ("odom", "body_b1")
    np.testing.assert_array_equal(xyz(odom.pose.pose.position), body.root_position)
    turned = Rotation.from_quat(body.root_orientation)
    np.testing.assert_allclose(turned.apply(xyz(odom.twist.twist.linear)), body.root_velocity, atol=1e-9)
    covariance = odom.pose.covariance.reshape(6, 6)
    np.testing.assert_array_equal(covariance[:3, :3], body.covariance[:3, :3])
    assert (np.linalg.eigvalsh(covariance[3:, 3:]) > 1e-5).all()  # half a degree, at least
    assert np.trace(covariance[3:, 3:]) < 3.0 * np.pi**2
    twist = turned.as_matrix() @ odom.twist.covariance.reshape(6, 6)[:3, :3] @ turned.as_matrix().T
    np.testing.assert_allclose(twist, body.covariance[3:, 3:], atol=1e-9)

    (state,), (urdf,) = kept.of("humans/bodies/b1/joint_states"), kept.of("humans/bodies/b1/urdf")
    assert set(state.name) == {f"{joint}_b1" for joint in JOINTS}
    revolute = ElementTree.fromstring(urdf.data).iterfind("joint[@type='revolute']")
    assert {joint.get("name") for joint in revolute} == set(state.name)
    (status,) = kept.of("diagnostics")[0].status
    assert (status.name, status.level) == ("steadypose: prior", 1)
    assert [(value.key, value.value) for value in status.values] == [("dropped.late", "3")]


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def test_the_whole_message_goes_out_in_its_own_type_and_transforms_lead_to_every_link(stream: Stream) -> None:
    kept, buffer = Kept(), TransformBuffer()
    topics = BodyTopics(kept, "odom")
    clean, world = stream[0][-1], stream[1][-1]
    topics.send(clean)
    topics.send(world)
    sent = {topic: cdr for topic, _, cdr, _ in kept.sent}
    assert decode(POSE_CLEAN, sent["steadypose/pose_clean"]) == clean
    assert decode(POSE_WORLD, sent["steadypose/pose_world"]) == dataclasses.replace(world, frame_id="odom")
    message = kept.of("tf")[-1]
    buffer.add(message, static=False)
    assert {it.child_frame_id for it in message.transforms} == {f"{link}_{b}" for link in LINKS for b in ("b0", "b1")}
    for name, body in zip(("b0", "b1"), world.bodies, strict=True):
        for link, (place, turned) in frames(body).items():
            at, quaternion = buffer.lookup("odom", f"{link}_{name}", world.stamp_ns)
            np.testing.assert_allclose(at, place, atol=1e-6)
            np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), turned, atol=1e-6)
    (tracked,) = kept.of("humans/bodies/tracked")
    assert (tracked.ids, stamp_ns(tracked.header)) == (["b0", "b1"], world.stamp_ns)


def test_a_sensor_that_stands_is_static_and_one_that_moves_is_not(stream: Stream) -> None:
    kept = Kept()
    topics = BodyTopics(kept, "map")
    pose = Pose(np.array([1.0, 2.0, 1.5]), np.array([0.5, -0.5, 0.5, -0.5]))
    still = dataclasses.replace(stream[0][-1], frame_id="camera", sensor_pose=pose, calibrated=True)
    for _ in range(3):
        topics.send(still)
    (message,) = kept.of("tf_static")
    assert [latched for topic, _, _, latched in kept.sent if topic == "tf_static"] == [True]
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "camera")
    assert transform.transform.translation.y == 2.0
    for step in range(3):
        topics.send(dataclasses.replace(still, sensor_pose=Pose(pose.position + step + 1, pose.orientation)))
    assert [it.transforms[0].transform.translation.x for it in kept.of("tf")] == [2.0, 3.0, 4.0]
    other = dataclasses.replace(still, frame_id="other")
    third = dataclasses.replace(still, frame_id="third")
    topics.send(other)
    topics.send(third)
    topics.send(dataclasses.replace(other, sensor_pose=Pose(pose.position + 1, pose.orientation)))
    held = [{it.child_frame_id for it in message.transforms} for message in kept.of("tf_static")]
    assert held == [{"camera"}, set(), {"other"}, {"other", "third"}, {"third"}], "each has all that stand still"
    silent = Kept()
    for sensor_tf, message in (
        (False, still),
        (True, dataclasses.replace(still, calibrated=False)),
        (True, dataclasses.replace(still, frame_id="world")),
    ):
        BodyTopics(silent, "world", sensor_tf=sensor_tf).send(message)
    assert not silent.of("tf_static")


def test_who_is_gone_loses_its_topics_and_who_is_lost_is_not_published(stream: Stream) -> None:
    kept = Kept()
    topics = BodyTopics(kept, "world")
    world = stream[1][-1]
    topics.send(world)
    lost = dataclasses.replace(world.bodies[1], tracking=Tracking.LOST)
    nowhere = dataclasses.replace(world.bodies[0], positions=np.full((22, 3), np.nan))
    assert topics.send(dataclasses.replace(world, bodies=[world.bodies[0], lost])) == 0
    assert set(kept.dropped) == {f"humans/bodies/b1/{topic}" for topic in ("joint_states", "odom", "urdf")}
    assert topics.send(dataclasses.replace(world, bodies=[nowhere])) == 1
    assert kept.of("humans/bodies/tracked")[-1].ids == []


def test_the_urdf_is_of_mean_lengths_and_changes_with_them_alone(stream: Stream) -> None:
    kept, world, rng = Kept(), stream[1][-1], np.random.default_rng(0)
    topics, counts = BodyTopics(kept, "world"), []
    for size in (1.0, 1.2):
        for _ in range(200):
            body = world.bodies[1]
            positions = (size * body.positions + rng.normal(0.0, 0.015, (22, 3))).astype(np.float32)
            topics.send(dataclasses.replace(world, bodies=[dataclasses.replace(body, positions=positions)]))
        counts.append(len(kept.of("humans/bodies/b1/urdf")))
    assert counts[0] < 10
    assert counts[0] < counts[1] < 20


def test_sources_have_bodies_of_their_own_until_they_fall_silent(make_launch, clock: VirtualClock, stream: Stream):
    """Of a server's clients, each numbers its bodies from 0."""
    kept, node = Kept(), Ros2BridgeNode(make_launch(nodes='["trajectory", "ros2_bridge"]'), clock)
    node._settings = Ros2BridgeSettings()
    node._topics = BodyTopics(kept, "world", several=True)
    here, there = (dataclasses.replace(stream[1][-1], source=source) for source in ("hall", "front door"))
    for world in (here, there, here, there):
        node.handle(POSE_WORLD, world)
    assert not kept.dropped
    ids = {"b0_hall", "b1_hall", "b0_front_door", "b1_front_door"}
    assert {*kept.of("humans/bodies/tracked")[-1].ids} == ids
    assert all(len(kept.of(f"humans/bodies/{name}/odom")) == 2 for name in ids)
    assert all(len(kept.of(f"humans/bodies/{name}/urdf")) == 1 for name in ids)
    for _ in range(11):
        clock.time_ns += SILENT_NS // 10
        node.handle(POSE_WORLD, here)
    gone = {f"humans/bodies/{body}_front_door/{topic}" for body in ("b0", "b1") for topic in OF_BODY}
    assert (set(kept.dropped), len(kept.dropped)) == (gone, len(gone))
    assert kept.of("humans/bodies/tracked")[-1].ids == ["b0_hall", "b1_hall"]


def test_a_type_that_is_not_to_be_had_is_told_and_the_rest_goes_on() -> None:
    class Poor:
        def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Callable[[bytes], None]:
            if kind.startswith("hri"):
                raise LaunchError("sudo apt install ros-$ROS_DISTRO-hri-msgs")
            return sent.append

    sent: list[bytes] = []
    output = RosOutput(Poor())  # type: ignore[arg-type]
    for _ in range(2):
        output.send("humans/bodies/tracked", "hri_msgs/msg/IdsList", b"1")
        output.send("tf", "tf2_msgs/msg/TFMessage", b"2")
    assert sent == [b"2", b"2"]
    assert "apt install" in output.missing["humans/bodies/tracked"]


def test_without_ros_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connecting, "find_spec", lambda name: None)
    with pytest.raises(LaunchError, match="add ros2"):
        check_ros2(Launch())


@pytest.mark.parametrize("has_dds", [True, False])
def test_a_sourced_ros_of_another_python_is_not_used(has_dds: bool, tmp_path: Path, monkeypatch, capsys, ros: None):
    """Such as ROS's own Python 3.12 on the path of a 3.11."""
    monkeypatch.setattr(connecting, "has_sourced_ros", lambda: True)
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "steadypose.nodes.ros2.rclpy_connection", raising=False)
    if has_dds:
        connecting.connect("test").close()
        assert "plain DDS" in capsys.readouterr().out
    else:
        monkeypatch.setattr(connecting, "find_spec", lambda name: None)
        with pytest.raises(LaunchError, match=r"expected the Python that ROS is built for"):
            connecting.connect("test")


FOREIGN = """
import sys
from importlib.metadata import packages_distributions
before = set(sys.modules)
import rclpy, sensor_msgs.msg
owners = packages_distributions()
loaded = {module.partition(".")[0] for module in set(sys.modules) - before}
packages = [{name.lower() for name in owners.get(module, ())} for module in loaded]
print(*set().union(*(names for names in packages if not any(name.startswith("ros-") for name in names))))
"""


@pytest.mark.usefixtures("ros")
def test_a_sourced_rclpy_finds_what_it_imports() -> None:
    """ROS takes yaml from the system's packages, and those a virtual environment does not see."""
    done = subprocess.run([sys.executable, "-c", FOREIGN], capture_output=True, text=True, timeout=60, check=True)
    needed, extras = required()
    brought = {re.split("[^a-z-]", wanted)[0] for wanted in (*needed, *extras["ros2"])}
    assert {"numpy", "pyyaml"} <= set(done.stdout.split()) <= brought


@pytest.fixture(params=["dds.DdsConnection", "rclpy_connection.RclpyConnection"])
def join(request: pytest.FixtureRequest, ros: None) -> Iterator[Callable[[], Connection]]:
    module, _, name = request.param.partition(".")
    given = ("test",) if module.startswith("rclpy") else ()
    with ExitStack() as opened:
        kind = getattr(import_module(f"steadypose.nodes.ros2.{module}"), name)
        yield lambda: opened.enter_context(closing(kind(*given)))


def test_who_joins_late_gets_what_is_latched(join: Callable[[], Connection]) -> None:
    text = serialise(new("std_msgs/msg/String", data="a robot"))
    first = join()
    first.publisher("description", "std_msgs/msg/String", latched=True)(text)
    heard: list[bytes] = []
    late = join()
    late.subscribe("description", "std_msgs/msg/String", heard.append, latched=True)

    def arrived() -> bool:
        first.spin(0.0)
        late.spin(0.05)
        return bool(heard)

    until(arrived, timeout_s=60)
    assert deserialise(heard[0], "std_msgs/msg/String").data == "a robot"


def body(turns: dict[str, Rotation], root: Rotation | None = None) -> WorldBody:
    local = Rotation.concatenate([turns.get(name, Rotation.identity()) for name in J])
    local = Rotation.concatenate([(root or Rotation.identity()) * local[0], local[1:]])
    return world_body(fk(local.as_matrix()), local.as_quat(), id=3)


def forward(description: str, angles: dict[str, float], suffix: str) -> dict[str, np.ndarray]:
    """(4, 4) poses of a URDF's links in the frame of its root, by the textbook."""
    robot = ElementTree.fromstring(description)

    def attribute(joint: ElementTree.Element, part: str, key: str) -> str:
        return next(joint.iter(part)).attrib[key]

    poses = {f"body_{suffix}": np.eye(4)}
    for joint in robot.iter("joint"):  # which comes after the one it hangs from
        here = np.eye(4)
        here[:3, 3] = [float(x) for x in attribute(joint, "origin", "xyz").split()]
        if joint.get("type") == "revolute":
            axis = np.array([float(x) for x in attribute(joint, "axis", "xyz").split()])
            angle = angles[joint.attrib["name"].removesuffix(f"_{suffix}")]
            here[:3, :3] = Rotation.from_rotvec(axis * angle).as_matrix()
        poses[attribute(joint, "child", "link")] = poses[attribute(joint, "parent", "link")] @ here
    return poses


def about(axis: str, angle: float) -> Rotation:
    return Rotation.from_euler(axis, angle)


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_what_the_model_can_say_comes_back(seed: int) -> None:
    """A body that bends only where REP-155's does: its links are where angles and URDF put them."""
    rng = np.random.default_rng(seed)
    bend = rng.uniform(0.1, 2.2, 4)
    stoops = rng.choice([0.0, rng.uniform(-0.2, 1.0)])
    turns = {
        "spine3": about("y", stoops),
        "head": Rotation.from_euler("XZY", rng.uniform(-0.9, 0.9, 3)),
        "left_shoulder": Rotation.random(rng=rng),
        "right_shoulder": Rotation.random(rng=rng),
        # in the T of the canonical skeleton, an arm's hinge is upright
        "left_elbow": about("z", -bend[0]),
        "right_elbow": about("z", bend[1]),
        "left_hip": Rotation.from_euler("ZXY", rng.uniform(-1.2, 1.2, 3)),
        "right_hip": Rotation.from_euler("ZXY", rng.uniform(-1.2, 1.2, 3)),
        "left_knee": about("y", bend[2]),
        "right_knee": about("y", bend[3]),
    }
    bent = body(turns, root=Rotation.random(rng=rng))
    links = frames(bent)
    angles = joint_angles(links)
    assert tuple(angles) == JOINTS
    assert angles["l_elbow"] == pytest.approx(bend[0]), "elbows bend forwards,"
    assert angles["r_elbow"] == pytest.approx(bend[1])
    assert angles["l_knee"] == pytest.approx(-bend[2]), "knees backwards"
    origin, heading = links["body"]
    found = forward(urdf("b3", measures(bent)), angles, "b3")
    for name, (position, turned) in links.items():
        if name in ("head", "l_foot", "r_foot"):
            continue  # a head on a neck that bends, and feet, are not in that model
        pose = found[f"{name}_b3"]
        np.testing.assert_allclose(pose[:3, :3], heading.T @ turned, atol=1e-6, err_msg=name)
        if stoops and not name.endswith(("body", "waist", "hip", "knee", "ankle")):
            continue  # people bend higher up than at the pelvis: shoulders and arms of who stoops are elsewhere
        np.testing.assert_allclose(pose[:3, 3], heading.T @ (position - origin), atol=2e-3, err_msg=name)
    np.testing.assert_allclose(found["head_b3"][:3, :3], heading.T @ links["head"][1], atol=1e-6)


def test_measures_are_the_persons_whatever_the_pose() -> None:
    rng = np.random.default_rng(0)
    still = measures(body({}))
    for _ in range(5):
        moved = measures(body({name: Rotation.random(rng=rng) for name in J}))
        for link, place in still.items():
            np.testing.assert_allclose(moved[link], place, atol=1e-6, err_msg=link)
    assert still["l_elbow"][2] == pytest.approx(-np.linalg.norm(REST_OFFSETS[J["left_elbow"]]))


def test_standing_with_hanging_arms_is_zero() -> None:
    arms = {"left_shoulder": about("x", -np.pi / 2), "right_shoulder": about("x", np.pi / 2)}
    links = frames(body(arms))
    np.testing.assert_allclose(list(joint_angles(links).values()), 0.0, atol=1e-7)
    for name, (_, turned) in links.items():
        np.testing.assert_allclose(turned, np.eye(3), atol=1e-7, err_msg=name)


@pytest.mark.parametrize(("number", "source", "name"), [
    (0, "", "b0"),
    (17, "", "b11"),
    (-1, "", "bffffffff"),
    (2**31 - 1, "", "b7fffffff"),
    (0, "front door__2/", "b0_front_door_2"),
    (0, "左", "b0_u5de6"),
])  # fmt: skip
def test_names_that_ros_takes(number: int, source: str, name: str) -> None:
    assert body_name(number, source) == name
