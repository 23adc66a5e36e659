"""RViz's configuration and Foxglove's layout ask for what is published, and the sample stream's person is in view.

No package registry has RViz 2, nor Foxglove's app, so what they ask for is read from their files.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from tests.helpers.ros_output import Kept
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import Diagnostics, Level, PoseWorld
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sinks.ros2.bridge import LAYOUT, RVIZ, FoxgloveSettings, Ros2BridgeSettings
from steadypose.nodes.sinks.ros2.messages import ARROW, LINE_LIST, SPHERE_LIST, TEXT_VIEW_FACING, BodyTopics
from steadypose.nodes.sources.registry import InputSettings

MANAGER = "Visualization Manager"
FIELD_OF_VIEW = 45.0
"""degrees, upwards: RViz's default"""
DRAWN = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "3D": "visualization_msgs/msg/MarkerArray",
    "DiagnosticSummary": "diagnostic_msgs/msg/DiagnosticArray",
}
"""the type of what a display of RViz, or a panel of Foxglove, draws"""


@pytest.fixture(scope="module")
def rviz() -> dict[str, Any]:
    return YAML(typ="safe").load(RVIZ)


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    return json.loads(LAYOUT.read_text())


@pytest.fixture(scope="module")
def sent() -> Kept:
    """All that `launch/ros2.toml` has the bridge send of a calibrated camera that sees two people."""
    kept = Kept()
    topics = BodyTopics(kept, Launch.read("ros2").settings(Ros2BridgeSettings).world_frame)
    last = dict(messages(2.0, bodies=2))
    for message in (last[POSE_CLEAN], last[POSE_WORLD], Diagnostics(1, "prior", Level.WARN, "late", {"dropped": "3"})):
        topics.send(message)
    topics.send_clock(1)
    return kept


def frames(sent: Kept) -> set[str]:
    transforms = [one for topic in ("tf", "tf_static") for message in sent.of(topic) for one in message.transforms]
    return {name for one in transforms for name in (one.header.frame_id, one.child_frame_id)}


def published(sent: Kept) -> dict[str, tuple[str, bool]]:
    return {f"/{topic}": (kind, latched) for topic, kind, _, latched in sent.sent}


def test_rviz_gets_what_its_configuration_asks_for(rviz: dict[str, Any], sent: Kept) -> None:
    manager, topics = rviz[MANAGER], published(sent)
    assert manager["Global Options"]["Fixed Frame"] in frames(sent)
    displays = {display["Name"]: display for display in manager["Displays"]}
    assert displays["people"]["Enabled"]
    for display in displays.values():
        if asked := display.get("Topic"):
            kind, latched = topics[asked["Value"]]
            assert kind == DRAWN[display["Class"]]
            assert latched or asked["Durability Policy"] == "Volatile"
    # what RViz listens to with no display
    assert topics["/tf"] == ("tf2_msgs/msg/TFMessage", False)
    assert topics["/tf_static"] == ("tf2_msgs/msg/TFMessage", True)
    assert topics["/clock"][0] == "rosgraph_msgs/msg/Clock"


def test_foxglove_gets_what_its_layout_asks_for(layout: dict[str, Any], sent: Kept) -> None:
    assert Launch.read("foxglove").settings(FoxgloveSettings).world_frame == "world", "as in what was sent"
    topics, panels = published(sent), layout["configById"]
    assert {layout["layout"]["first"], layout["layout"]["second"]} == set(panels)
    for name, config in panels.items():
        shown = config.get("topics", {})
        assert all(settings["visible"] for settings in shown.values())
        for topic in {*shown, config.get("topicToRender")} - {None}:
            assert topics[topic][0] == DRAWN[name.partition("!")[0]]
        assert config.get("followTf", "world") in frames(sent)


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


@pytest.mark.parametrize("viewer", ["ros2", "foxglove"])
def test_the_person_of_the_sample_stream_is_in_view(viewer: str, rviz: dict[str, Any], layout: dict[str, Any]) -> None:
    with RecordingReader(Launch.read(viewer).settings(InputSettings).recording) as recording:
        worlds = [it for _, _, it in recording.messages([POSE_TRUTH]) if isinstance(it, PoseWorld)]
    joints = np.concatenate([body.positions for world in worlds for body in world.bodies]).astype(float)
    state = layout["configById"]["3D!people"]["cameraState"]
    eye, target = rviz_camera(rviz[MANAGER]["Views"]["Current"]) if viewer == "ros2" else foxglove_camera(state)
    field = FIELD_OF_VIEW if viewer == "ros2" else state["fovy"]
    assert eye[2] > 0, "above the floor"
    assert np.abs(angles(eye, target, joints)).max() < field / 2
    assert np.ptp(angles(eye, target, joints[:22])[:, 1]) > 5, "and not a dot"
