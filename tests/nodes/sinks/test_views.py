"""RViz's configuration and Foxglove's layout show what is published, and the sample stream's person is in their view.

No package registry has RViz 2, nor Foxglove's app (Debian's RViz, of ROS 1, draws the same markers). So RViz's part is
taken by what its displays ask for, with their types and QoS, and Foxglove's by the types of layouts in its SDK. What a
viewer ignores or answers with an error is a misfit.
"""

from __future__ import annotations

import dataclasses
import json
import re
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from ruamel.yaml import YAML
from tests.helpers.ros_output import Kept
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import Diagnostics, Level, PoseClean, PoseWorld
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sinks.ros2.bridge import (
    LAYOUT,
    RVIZ,
    FoxgloveSettings,
    Ros2BridgeSettings,
)
from steadypose.nodes.sinks.ros2.messages import ARROW, LINE_LIST, SPHERE_LIST, TEXT_VIEW_FACING, BodyTopics
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
    durability: str = "VOLATILE"


RVIZ_ITSELF = (
    Subscription("/tf", "tf2_msgs/msg/TFMessage"),
    Subscription("/tf_static", "tf2_msgs/msg/TFMessage", durability="TRANSIENT_LOCAL"),
    Subscription("/clock", "rosgraph_msgs/msg/Clock"),
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
    topics.send_clock(1)
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
        topic["Durability Policy"].upper().replace(" ", "_"),
    )


def unmet(asked: Subscription, sent: Kept) -> list[str]:
    """Why a subscription gets nothing of what is published."""
    offers = [(kind, latched) for topic, kind, _, latched in sent.sent if f"/{topic}" == asked.topic]
    if not offers:
        return [f"{asked.topic} is not published"]
    kind, latched = offers[-1]
    found = [] if kind == asked.kind else [f"{asked.topic} is a {kind}, not a {asked.kind}"]
    return found + ([f"{asked.topic} is not latched"] if asked.durability == "TRANSIENT_LOCAL" and not latched else [])


def rviz_misfits(rviz: Mapping[str, Any], sent: Kept, namespaces: set[str]) -> list[str]:
    """What of a configuration RViz would ignore, wait for, or show as an error."""
    manager = rviz[MANAGER]
    found = [why for asked in RVIZ_ITSELF for why in unmet(asked, sent)]
    fixed = manager["Global Options"]["Fixed Frame"]
    if fixed not in frames(sent):
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
            found += unmet(asked, sent)
            if not display["Enabled"]:
                found.append(f"{display['Name']} is off")
        for name, on in display.get("Namespaces", {}).items():
            if name not in namespaces or not on:
                found.append(f"{display['Name']}: namespace {name} is off, or unknown")
    return found


def test_rviz_gets_what_its_configuration_asks_for(rviz: dict[str, Any], sent: Kept) -> None:
    namespaces = {mark.ns for message in sent.of("steadypose/markers") for mark in message.markers}
    assert rviz_misfits(rviz, sent, namespaces) == []
    assert "people" in {display["Name"] for display in rviz[MANAGER]["Displays"]}


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


def test_foxglove_gets_what_its_layout_asks_for(layout: dict[str, Any], sent: Kept) -> None:
    assert Launch.read("foxglove").settings(FoxgloveSettings).world_frame == "world", "as in what was sent"
    namespaces = {mark.ns for message in sent.of("steadypose/markers") for mark in message.markers}
    schemas = {f"/{topic}": kind for topic, kind, *_ in sent.sent}
    assert layout_misfits(layout, schemas, frames(sent), namespaces) == []


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
