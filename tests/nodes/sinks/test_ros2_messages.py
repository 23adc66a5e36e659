"""`msgs/` as a ROS 2 package: built by colcon with Jazzy's generators, and received by a ROS 2 node with its types.

`.ci/ros2-msgs` builds it.
"""

import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import running, until
from tests.helpers.processes import another_python
from tests.helpers.synthetic_poses import messages_on

from steadypose.msgs.codec import DEFINITIONS, encode
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import JointState, Message, Tracking
from steadypose.nodes.ros2.definitions import deserialise, ros_types
from steadypose.nodes.sinks.ros2.bridge import Ros2BridgeNode

ROOT = Path(__file__).parents[3]
BUILT = ROOT / ".ros2/install"
SHARED = BUILT / "steadypose_msgs/share/steadypose_msgs/msg"
KINDS = {"pose_raw": "PoseRaw", "pose_clean": "PoseClean", "pose_world": "PoseWorld"}
pytestmark = [
    pytest.mark.skipif(
        not (BUILT / "setup.sh").exists(),
        reason="steadypose_msgs is not built: run .ci/ros2-msgs (x86-64, with cmake, make and g++)",
    ),
    pytest.mark.usefixtures("ros"),
]

LISTENER = """
import json
import rclpy
from steadypose_msgs.msg import CleanBody, PoseClean, PoseRaw, PoseWorld, WorldBody

def plain(value):
    if hasattr(value, "get_fields_and_field_types"):
        return {field: plain(getattr(value, field)) for field in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list) else value

rclpy.init()
node = rclpy.create_node("listener")
heard = {}
for topic, kind in (("pose_raw", PoseRaw), ("pose_clean", PoseClean), ("pose_world", PoseWorld)):
    node.create_subscription(kind, f"/steadypose/{topic}", lambda m, t=topic: heard.setdefault(t, plain(m)), 10)
print("ready", flush=True)
while len(heard) < 3:
    rclpy.spin_once(node, timeout_sec=0.05)
constants = {name: getattr(kind, name) for kind in (CleanBody, WorldBody) for name in dir(type(kind))
             if name.startswith(("STATE_", "TRACKING_"))}
print(json.dumps({"heard": heard, "constants": constants}), flush=True)
"""

SENDER = """
import sys, time
from pathlib import Path
from steadypose.nodes.ros2.rclpy_connection import RclpyConnection

connection = RclpyConnection("sender")
sends = [(connection.publisher(f"steadypose/{file.stem}", f"steadypose_msgs/msg/{file.suffix[1:]}"), file.read_bytes())
         for file in Path(sys.argv[1]).iterdir()]
while True:
    for send, cdr in sends:
        send(cdr)
    connection.spin(0.02)
"""


def sourced(script: str, folder: Path, python: Path, *arguments: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """A Python process with this script after ``. install/setup.sh``."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("LD_LIBRARY", "_ROS"))}
    command = ("sh", "-c", '. "$0" && exec "$@"', str(BUILT / "setup.sh"), str(python))
    return another_python(script, folder, *arguments, python=command, environment=environment)


@contextmanager
def listener(folder: Path) -> Iterator[list[str]]:
    """A ROS 2 node with the generated types; what it says, line by line: that it is ready, and what it heard."""
    with sourced(LISTENER, folder, ROOT / ".ros2/venv/bin/python") as it:
        lines: list[str] = []
        threading.Thread(target=lambda: lines.extend(it.stdout or ()), daemon=True).start()
        yield lines


def plain(value: Any) -> Any:
    """A message of rosbags' types as its fields, for a comparison."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [plain(item) for item in value]
    if kind := getattr(value, "__msgtype__", None):
        return {name: plain(getattr(value, name)) for name, _ in ros_types().fielddefs[kind][1]}
    return value


def fields_of(message: Message) -> dict[str, Any]:
    return plain(deserialise(encode(message), f"steadypose_msgs/msg/{type(message).__name__}"))


@pytest.fixture(scope="module")
def stream() -> dict[str, list[Message]]:
    """Two seconds and a half of two bodies, one joint hidden towards the end."""
    return {topic: messages_on(topic, 2.5, bodies=2) for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD)}


@pytest.mark.parametrize("kind", sorted(path.stem for path in DEFINITIONS.glob("*.msg")))
def test_ros_gives_each_type_the_hash_that_we_announce(kind: str) -> None:
    described = json.loads((SHARED / f"{kind}.json").read_text())
    hashes = {it["type_name"]: it["hash_string"] for it in described["type_hashes"]}
    assert hashes[f"steadypose_msgs/msg/{kind}"] == ros_types().hash_rihs01(f"steadypose_msgs/msg/{kind}")


def test_a_ros_node_receives_whole_messages(make_launch, tmp_path: Path, stream: dict[str, list[Message]]):
    launch = make_launch(nodes='["pose_input", "prior", "trajectory", "ros2_bridge"]', transport__lossless="true")
    turn = itertools.cycle(range(60))
    with (
        listener(tmp_path) as lines,
        Publisher(launch.transport.endpoint("pose_input"), reliable={"ros2_bridge"}) as raw,
        Publisher(launch.transport.endpoint("prior"), reliable={"ros2_bridge"}) as clean,
        Publisher(launch.transport.endpoint("trajectory"), reliable={"ros2_bridge"}) as world,
        running(Ros2BridgeNode(launch)),
    ):

        def all_received() -> bool:
            index = next(turn)
            for publisher, topic in ((raw, POSE_RAW), (clean, POSE_CLEAN), (world, POSE_WORLD)):
                publisher.publish(topic, stream[topic][index], timeout_s=1)
            return len(lines) > 1

        until(all_received, timeout_s=120)
    result = json.loads(lines[-1])
    for topic, heard in result["heard"].items():
        stamp = heard["header"]["stamp"]
        (sent,) = [
            message
            for message in stream[topic.replace("_", "/")]
            if message.stamp_ns == stamp["sec"] * 10**9 + stamp["nanosec"]
        ]
        np.testing.assert_equal(heard, fields_of(sent))
        assert len(heard["bodies"]) == 2
    constants = result["constants"]
    for state in JointState:
        assert constants[f"STATE_{state.name}"] == state
    for tracking in Tracking:
        assert constants[f"TRACKING_{tracking.name}"] == tracking


def test_a_sourced_ros_carries_them_as_well(tmp_path: Path, stream: dict[str, list[Message]]) -> None:
    folder = tmp_path / "cdr"
    folder.mkdir()
    last = {topic.replace("/", "_"): found[-1] for topic, found in stream.items()}
    for topic, message in last.items():
        (folder / f"{topic}.{KINDS[topic]}").write_bytes(encode(message))
    with listener(tmp_path) as lines, sourced(SENDER, tmp_path, Path(sys.executable), str(folder)):
        until(lambda: len(lines) > 1, timeout_s=120)
    for topic, heard in json.loads(lines[-1])["heard"].items():
        np.testing.assert_equal(heard, fields_of(last[topic]))
