"""RViz's configuration and Foxglove's layout show what is published, and the sample stream's person is in their view.

No package registry has RViz 2, nor Foxglove's app (Debian's RViz, of ROS 1, draws the same markers). So RViz's part is
taken by a ROS 2 node (rclpy) that subscribes as the displays do, with their types and QoS, and Foxglove's by the
types of layouts in its SDK and by a client of its server. What a viewer ignores or answers with an error is a misfit;
each kind of misfit has its test.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json
import re
import threading
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from conftest import another_python, repeated, running, until
from ruamel.yaml import YAML
from tests.helpers.foxglove_client import FoxgloveClient
from tests.helpers.ros_output import Kept
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Diagnostics, Level, PoseClean, PoseWorld
from steadypose.nodes.graph.clock import Timeline
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sinks.ros2.bridge import RVIZ, Ros2BridgeNode
from steadypose.nodes.sinks.ros2.foxglove import LAYOUT, FoxgloveNode, FoxgloveSettings
from steadypose.nodes.sinks.ros2.messages import ARROW, LINE_LIST, SPHERE_LIST, TEXT_VIEW_FACING
from steadypose.nodes.sinks.ros2.settings import Ros2BridgeSettings
from steadypose.nodes.sinks.ros2.topics import BodyTopics
from steadypose.nodes.sources.registry import InputSettings

MANAGER = "Visualization Manager"
NEWS = Diagnostics(1, "prior", Level.WARN, "late", {"dropped.late": "3"})
DISPLAYS: Mapping[str, str | None] = {
    "rviz_default_plugins/Grid": None,
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/TF": None,
}
"""RViz's displays and the type of what their Topic names, as in its plugins_description.xml"""
OTHERS = {"rviz_common/Displays", "rviz_common/Views", "rviz_default_plugins/MoveCamera", "rviz_default_plugins/Orbit"}
"""its panels, tools and views"""
POLICIES = {
    "Depth": (int,),
    "Durability Policy": ("Volatile", "Transient Local"),
    "History Policy": ("Keep Last", "Keep All"),
    "Reliability Policy": ("Reliable", "Best Effort"),
    "Value": (str,),
}
"""what a Topic says, and its values; RViz takes its default where it does not know one"""
FIELD_OF_VIEW = 45.0
"""degrees, upwards: RViz's default"""
DRAWN = {
    "3D": {"visualization_msgs/msg/MarkerArray"},
    "DiagnosticSummary": {"diagnostic_msgs/msg/DiagnosticArray"},
}
"""the schemas, of those published, that each of Foxglove's panels takes for its topics"""


@dataclass(frozen=True)
class Subscription:
    """What a viewer asks ROS 2 for."""

    topic: str
    kind: str
    reliability: str = "RELIABLE"
    durability: str = "VOLATILE"
    depth: int = 10


RVIZ_ITSELF = (
    Subscription("/tf", "tf2_msgs/msg/TFMessage", depth=100),
    Subscription("/tf_static", "tf2_msgs/msg/TFMessage", durability="TRANSIENT_LOCAL", depth=100),
    Subscription("/clock", "rosgraph_msgs/msg/Clock", reliability="BEST_EFFORT", depth=1),
)
"""what RViz listens to with no display: tf2's listener, and rclcpp's of the time with use_sim_time"""


@pytest.fixture(scope="module")
def rviz() -> dict[str, Any]:
    return YAML(typ="safe").load(RVIZ)


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    return json.loads(LAYOUT.read_text())


@pytest.fixture(scope="module")
def stream() -> list[tuple[PoseClean, PoseWorld]]:
    """A calibrated camera sees two people for a second."""
    found = list(messages(2.0, bodies=2))
    cleans = [it for topic, it in found if topic == POSE_CLEAN and isinstance(it, PoseClean)]
    worlds = [it for topic, it in found if topic == POSE_WORLD and isinstance(it, PoseWorld)]
    return list(zip(cleans, worlds, strict=True))[-30:]


@pytest.fixture(scope="module")
def sent(stream: list[tuple[PoseClean, PoseWorld]]) -> Kept:
    """All that `launch/ros2.toml` has the bridge send."""
    kept = Kept()
    topics = BodyTopics(kept, Launch.read("ros2").settings(Ros2BridgeSettings))
    for message in (*stream[-1], NEWS):
        topics.send(message)
    return kept


def frames(sent: Kept) -> set[str]:
    """All that TF has."""
    told = [one for topic in ("tf", "tf_static") for message in sent.of(topic) for one in message.transforms]
    return {name for one in told for name in (one.header.frame_id, one.child_frame_id)}


# --- RViz


def subscription(display: Mapping[str, Any]) -> Subscription | None:
    """What a display of RViz asks for; None if it has no topic."""
    kind = DISPLAYS.get(display["Class"])
    if not kind:
        return None
    topic = display["Topic"]
    return Subscription(
        topic["Value"],
        kind,
        topic["Reliability Policy"].upper().replace(" ", "_"),
        topic["Durability Policy"].upper().replace(" ", "_"),
        topic["Depth"],
    )


def unmet(asked: Subscription, offered: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Why a subscription gets nothing of what publishers offer by topic."""
    offer = offered.get(asked.topic)
    if offer is None:
        return [f"{asked.topic} is not published"]
    found = []
    if offer["kind"] != asked.kind:
        found.append(f"{asked.topic} is a {offer['kind']}, not a {asked.kind}")
    if asked.reliability == "RELIABLE" != offer["reliability"]:
        found.append(f"{asked.topic} is not reliable")
    if asked.durability == "TRANSIENT_LOCAL" != offer["durability"]:
        found.append(f"{asked.topic} is not latched")
    return found


def rviz_misfits(
    rviz: Mapping[str, Any], offered: Mapping[str, Mapping[str, str]], known: set[str], namespaces: set[str]
) -> list[str]:
    """What of a configuration RViz would ignore, wait for, or show as an error."""
    manager = rviz[MANAGER]
    found = [why for asked in RVIZ_ITSELF for why in unmet(asked, offered)]
    fixed = manager["Global Options"]["Fixed Frame"]
    if fixed not in known:
        found.append(f"fixed frame {fixed} is not in TF")
    for part in (*rviz["Panels"], *manager["Tools"], manager["Views"]["Current"]):
        if part["Class"] not in OTHERS:
            found.append(f"{part['Class']} is unknown")
    for display in manager["Displays"]:
        if display["Class"] not in DISPLAYS:
            found.append(f"{display['Class']} is unknown")
            continue
        for name, value in display.get("Topic", {}).items():
            if name not in POLICIES or (type(value) not in POLICIES[name] and value not in POLICIES[name]):
                found.append(f"{display['Name']}: {name}: {value} is unknown")
        if asked := subscription(display):
            found += unmet(asked, offered)
            if not display["Enabled"]:
                found.append(f"{display['Name']} is off")
        for name, on in display.get("Namespaces", {}).items():
            if name not in namespaces or not on:
                found.append(f"{display['Name']}: namespace {name} is off, or unknown")
    return found


def heard_by_displays(rviz: Mapping[str, Any]) -> list[Subscription]:
    """What its displays listen to; and /clock, but not TF, as no registry has a package of its messages."""
    return [asked for display in rviz[MANAGER]["Displays"] if (asked := subscription(display))] + [RVIZ_ITSELF[2]]


LISTENER = """
import json, sys, time
from importlib import import_module
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

rclpy.init()
node = rclpy.create_node("rviz")
asked, topics = json.loads(sys.argv[1]), json.loads(sys.argv[2])
heard, offered, end = set(), {}, time.monotonic() + 60
for it in asked:
    package, _, name = it["kind"].split("/")
    qos = QoSProfile(depth=it["depth"], reliability=ReliabilityPolicy[it["reliability"]],
                     durability=DurabilityPolicy[it["durability"]])
    kind = getattr(import_module(package + ".msg"), name)
    node.create_subscription(kind, it["topic"], lambda message, topic=it["topic"]: heard.add(topic), qos)
while (len(heard) < len(asked) or len(offered) < len(topics)) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.05)
    for topic in topics:
        for info in node.get_publishers_info_by_topic(topic):
            offered[topic] = {"kind": info.topic_type, "reliability": info.qos_profile.reliability.name,
                              "durability": info.qos_profile.durability.name}
print(json.dumps([offered, sorted(heard)]), flush=True)
"""


@pytest.fixture
def ros_node(
    ros: None,
    rviz: dict[str, Any],
    sent: Kept,
    stream: list[tuple[PoseClean, PoseWorld]],
    make_launch: Callable[..., Launch],
    tmp_path: Any,
) -> tuple[dict[str, dict[str, str]], list[str]]:
    """What the bridge offers by topic, as a ROS 2 node discovers it, and what that node heard of what displays ask."""
    asked = json.dumps([dataclasses.asdict(one) for one in heard_by_displays(rviz)])
    topics = json.dumps(sorted({f"/{topic}" for topic, *_ in sent.sent} | {"/clock"}))
    launch = make_launch(nodes='["prior", "trajectory", "ros2_bridge"]', transport__lossless="true")
    bridge = Ros2BridgeNode(launch)
    bridge.timeline = Timeline(stream[0][1].stamp_ns, bridge.clock.now_ns(), 1.0)
    turn = itertools.cycle(stream)
    with (
        another_python(LISTENER, tmp_path, asked, topics) as listener,
        Publisher(launch.transport.endpoint("prior"), reliable={"ros2_bridge"}) as prior,
        Publisher(launch.transport.endpoint("trajectory"), reliable={"ros2_bridge"}) as trajectory,
        running(bridge),
    ):
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(listener.stdout or ()), daemon=True).start()

        def told() -> bool:
            clean, world = next(turn)
            prior.publish(POSE_CLEAN, clean, timeout_s=1)
            trajectory.publish(POSE_WORLD, world, timeout_s=1)
            trajectory.publish(DIAGNOSTICS, NEWS)
            return bool(said)

        until(told, timeout_s=120)
    return json.loads(said[-1])


def changed(config: dict[str, Any], path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """A copy with another value at a place."""
    copied = copy.deepcopy(config)
    inner: Any = copied
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return copied


PEOPLE = (MANAGER, "Displays", 1)
RVIZ_MUTANTS = [
    ((*PEOPLE, "Topic", "Value"), "/steadypose/marker", "is not published"),
    ((*PEOPLE, "Topic", "Value"), "/steadypose/poses", "not a visualization_msgs/msg/MarkerArray"),
    ((*PEOPLE, "Topic", "Durability Policy"), "Transient Local", "is not latched"),
    ((*PEOPLE, "Topic", "Reliability Policy"), "reliable", "is unknown"),
    ((*PEOPLE, "Topic", "Filter"), 3, "is unknown"),
    ((*PEOPLE, "Class"), "rviz/MarkerArray", "is unknown"),
    ((*PEOPLE, "Enabled"), False, "is off"),
    ((*PEOPLE, "Namespaces"), {"b0/joints": False}, "is off"),
    ((*PEOPLE, "Namespaces"), {"0/joints": True}, "is off, or unknown"),
    ((MANAGER, "Global Options", "Fixed Frame"), "map", "is not in TF"),
    ((MANAGER, "Tools", 0, "Class"), "rviz_default_plugins/Move", "is unknown"),
]


def test_rviz_gets_what_its_configuration_asks_for(
    rviz: dict[str, Any], sent: Kept, ros_node: tuple[dict[str, dict[str, str]], list[str]]
) -> None:
    offered, heard = ros_node
    namespaces = {mark.ns for message in sent.of("steadypose/markers") for mark in message.markers}
    assert rviz_misfits(rviz, offered, frames(sent), namespaces) == []
    assert heard == sorted(asked.topic for asked in heard_by_displays(rviz))
    assert rviz[MANAGER]["Displays"][PEOPLE[2]]["Name"] == "people"

    for path, value, why in RVIZ_MUTANTS:
        assert why in " ".join(rviz_misfits(changed(rviz, path, value), offered, frames(sent), namespaces)), path
    lazy = changed(offered, ("/tf_static", "durability"), "VOLATILE")
    assert rviz_misfits(rviz, lazy, frames(sent), namespaces) == ["/tf_static is not latched"]
    lossy = changed(offered, ("/steadypose/markers", "reliability"), "BEST_EFFORT")
    assert rviz_misfits(rviz, lossy, frames(sent), namespaces) == ["/steadypose/markers is not reliable"]


def marker_errors(mark: Any) -> list[str]:
    """For what RViz and Foxglove refuse a marker, or draw nothing."""
    points = np.array([[p.x, p.y, p.z] for p in mark.points]).reshape(-1, 3)
    scale = np.array([mark.scale.x, mark.scale.y, mark.scale.z])
    turned, place = mark.pose.orientation, mark.pose.position
    sizes = {SPHERE_LIST: [0, 1, 2], LINE_LIST: [0], ARROW: [0, 1], TEXT_VIEW_FACING: [2]}[mark.type]
    checks = {
        "scale": bool((scale[sizes] > 0).all()),
        "finite": bool(np.isfinite(points).all() and np.isfinite([place.x, place.y, place.z]).all()),
        "quaternion": abs(np.linalg.norm([turned.x, turned.y, turned.z, turned.w]) - 1) < 1e-6,
        "points": {SPHERE_LIST: len(points) > 0, LINE_LIST: len(points) > 0 and len(points) % 2 == 0,
                   ARROW: len(points) == 2, TEXT_VIEW_FACING: bool(mark.text)}[mark.type],
        "visible": all(colour.a > 0 for colour in mark.colors) if len(mark.colors) else mark.color.a > 0,
        "colours": len(mark.colors) in (0, len(points)),
        "action": mark.action == 0,
    }  # fmt: skip
    return [name for name, good in checks.items() if not good]


def test_a_viewer_refuses_no_marker(sent: Kept) -> None:
    (message,) = sent.of("steadypose/markers")
    assert [error for mark in message.markers for error in marker_errors(mark)] == []
    assert len({(mark.ns, mark.id) for mark in message.markers}) == len(message.markers), "each its name"
    assert {mark.header.frame_id for mark in message.markers} <= frames(sent)
    bones = copy.deepcopy(next(mark for mark in message.markers if mark.type == LINE_LIST))
    bones.points = bones.points[1:]
    bones.scale.x = 0.0
    assert marker_errors(bones) == ["scale", "points", "colours"]


# --- Foxglove


def layout_misfits(
    layout: Mapping[str, Any], schemas: Mapping[str, str], known: set[str], namespaces: set[str]
) -> list[str]:
    """What of a layout Foxglove would ignore, wait for, or show as an error."""
    fl = pytest.importorskip("foxglove.layouts", reason="the extra 'foxglove' is not installed")
    kinds = {"3D": fl.ThreeDeeConfig, "DiagnosticSummary": fl.DiagnosticsSummaryConfig}
    panels = layout["configById"]
    found = [f"{name} is not in the layout, or has no configuration" for name in set(panels) ^ set(places(layout))]
    for name, config in panels.items():
        kind = name.partition("!")[0]
        if kind not in kinds:
            found.append(f"{kind} is unknown")
            continue
        found += [f"{name}: {why}" for why in unfit(config, kinds[kind])]
        topics = config.get("topics", {})
        for topic in {*topics, config.get("topicToRender")} - {None}:
            if schemas.get(topic) not in DRAWN[kind]:
                found.append(f"{name}: {topic} is not published, or not drawn: {schemas.get(topic)}")
        for topic, settings in topics.items():
            if not settings.get("visible"):
                found.append(f"{name}: {topic} is off")
            for namespace, one in settings.get("namespaces", {}).items():
                if namespace not in namespaces or not one["visible"]:
                    found.append(f"{name}: namespace {namespace} is off, or unknown")
        if config.get("followTf", "world") not in known:
            found.append(f"{name}: frame {config['followTf']} is not in TF")
    return found


def places(layout: Mapping[str, Any]) -> Iterator[str]:
    """The panels that are placed."""
    open_nodes = [layout["layout"]]
    while open_nodes:
        node = open_nodes.pop()
        if isinstance(node, str):
            yield node
        else:
            open_nodes += [node["first"], node["second"]]


def unfit(value: Any, hint: Any) -> list[str]:
    """Where a value of JSON differs from a type of Foxglove's SDK, whose fields are the keys in snake case."""
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            return [f"{value!r} is no {hint}"]
        fields, found = get_type_hints(hint), []
        for key, inner in value.items():
            name = re.sub("[A-Z]", lambda letter: "_" + letter[0].lower(), key)
            found += (
                [f"{key}: {why}" for why in unfit(inner, fields[name])] if name in fields else [f"{key} is unknown"]
            )
        return found
    origin, of = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return min((unfit(value, one) for one in of), key=len)
    if origin is Literal:
        return [] if value in of else [f"{value!r} is none of {of}"]
    if origin is dict:
        return [why for one in value.values() for why in unfit(one, of[1])] if isinstance(value, dict) else ["no table"]
    if origin in (list, tuple):
        each = of if origin is tuple else of * len(value)
        if not isinstance(value, list) or len(value) != len(each):
            return [f"{value!r} is no {hint}"]
        return [why for one, kind in zip(value, each, strict=True) for why in unfit(one, kind)]
    good = isinstance(value, (int, float)) and not isinstance(value, bool) if hint is float else isinstance(value, hint)
    return [] if good else [f"{value!r} is no {hint}"]


@pytest.fixture
def schemas(
    sent: Kept, stream: list[tuple[PoseClean, PoseWorld]], make_launch: Callable[..., Launch]
) -> dict[str, str]:
    """The type of each topic that Foxglove's server offers a client."""
    pytest.importorskip("foxglove", reason="the extra 'foxglove' is not installed")
    launch = make_launch(nodes='["prior", "trajectory", "foxglove"]', foxglove__port="0", transport__lossless="true")
    node = FoxgloveNode(launch)
    with (
        Publisher(launch.transport.endpoint("prior"), reliable={"foxglove"}) as prior,
        Publisher(launch.transport.endpoint("trajectory"), reliable={"foxglove"}) as trajectory,
        running(node),
    ):
        until(lambda: bool(node.url))

        def publish() -> None:
            prior.publish(POSE_CLEAN, stream[-1][0], timeout_s=1)
            trajectory.publish(POSE_WORLD, stream[-1][1], timeout_s=1)
            trajectory.publish(DIAGNOSTICS, NEWS)

        client = FoxgloveClient(int(node.url.rpartition(":")[2]))
        try:
            with repeated(publish):
                offered = client.channels(*{f"/{topic}" for topic, *_ in sent.sent})
        finally:
            client.close()
    return {topic: channel["schemaName"] for topic, channel in offered.items()}


SCENE = ("configById", "3D!people")
HEALTH = ("configById", "DiagnosticSummary!health")
LAYOUT_MUTANTS = [
    ((*SCENE, "topics"), {"/steadypose/marker": {"visible": True}}, "is not published"),
    ((*SCENE, "topics"), {"/steadypose/pose_world": {"visible": True}}, "not drawn"),
    ((*SCENE, "topics", "/steadypose/markers", "visible"), False, "is off"),
    ((*SCENE, "topics", "/steadypose/markers", "namespaces"), {"b0/joints": {"visible": False}}, "is off"),
    ((*SCENE, "topics", "/steadypose/markers", "visble"), True, "visble is unknown"),
    ((*SCENE, "followTf"), "map", "frame map is not in TF"),
    ((*SCENE, "followMode"), "none", "none of"),
    ((*SCENE, "cameraState", "distance"), "6", "is no"),
    ((*SCENE, "cameraState", "targetOffset"), [0, 0], "is no"),
    ((*SCENE, "camera"), {}, "camera is unknown"),
    ((*HEALTH, "topicToRender"), "/steadypose/markers", "not drawn"),
    ((*HEALTH, "topicToRender"), "/diagnostic", "is not published"),
    (("layout", "second"), "DiagnosticSummary!other", "not in the layout"),
    (("configById", "Diagnostics!more"), {}, "is unknown"),
]


def test_foxglove_gets_what_its_layout_asks_for(layout: dict[str, Any], sent: Kept, schemas: dict[str, str]) -> None:
    assert Launch.read("foxglove").settings(FoxgloveSettings).world_frame == "world", "as in what was sent"
    namespaces = {mark.ns for message in sent.of("steadypose/markers") for mark in message.markers}
    assert layout_misfits(layout, schemas, frames(sent), namespaces) == []

    for path, value, why in LAYOUT_MUTANTS:
        assert why in " ".join(layout_misfits(changed(layout, path, value), schemas, frames(sent), namespaces)), path


# --- both


def angles(eye: np.ndarray, target: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) degrees to the right and upwards at which a camera that looks at ``target`` sees ``points`` (N, 3)."""
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (points - eye) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    return np.degrees(np.arctan2(seen[:, :2], seen[:, 2:]))


def rviz_camera(view: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of RViz's orbiting camera."""
    target = np.array([view["Focal Point"][axis] for axis in "XYZ"], float)
    yaw, pitch = view["Yaw"], view["Pitch"]
    towards = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    return target + view["Distance"] * towards, target


def foxglove_camera(state: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of the 3D panel's camera: ``targetOffset`` is where it looks."""
    target = np.array(state["targetOffset"], float)
    phi, theta = np.radians(state["phi"]), np.radians(state["thetaOffset"])
    towards = np.array([-np.sin(phi) * np.sin(theta), -np.sin(phi) * np.cos(theta), np.cos(phi)])
    return target + state["distance"] * towards, target


@pytest.mark.parametrize("viewer", ["rviz", "foxglove"])
def test_the_person_of_the_sample_stream_is_in_view(viewer: str, rviz: dict[str, Any], layout: dict[str, Any]) -> None:
    launch = Launch.read("ros2" if viewer == "rviz" else "foxglove")
    played = launch.settings(InputSettings).recording
    with RecordingReader(played) as recording:
        worlds = [it for topic, _, it in recording if topic == POSE_TRUTH and isinstance(it, PoseWorld)]
    joints = np.concatenate([body.positions for world in worlds for body in world.bodies]).astype(float)
    if viewer == "rviz":
        field = FIELD_OF_VIEW
        eye, target = rviz_camera(rviz[MANAGER]["Views"]["Current"])
    else:
        state = layout["configById"]["3D!people"]["cameraState"]
        field = state["fovy"]
        eye, target = foxglove_camera(state)
    assert eye[2] > 0, "above the floor"
    assert np.abs(angles(eye, target, joints)).max() < field / 2
    assert np.ptp(angles(eye, target, joints[:22])[:, 1]) > 5, "and not a dot"
