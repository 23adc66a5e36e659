import json
import socket
from collections.abc import Callable
from typing import Any

import pytest
from conftest import repeated, running, until
from tests.helpers.synthetic_poses import messages_on

from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.ros2.definitions import deserialise, new, serialise
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.ros2.bridge import HOST, FoxgloveNode, FoxgloveOutput

pytest.importorskip("foxglove", reason="the extra 'foxglove' is not installed")


def test_a_client_gets_markers(make_launch: Callable[..., Launch]) -> None:
    last = messages_on(POSE_WORLD, 1.0)[-1]
    launch = make_launch(nodes='["trajectory", "foxglove"]', foxglove__port="0", transport__lossless="false")
    node = FoxgloveNode(launch)
    with Publisher(launch.transport.endpoint("trajectory")) as publisher, running(node):
        until(lambda: bool(node.url))
        with repeated(lambda: publisher.publish(POSE_WORLD, last)):
            channel, got = first_message(int(node.url.rpartition(":")[2]), "/steadypose/markers")
    assert (channel["encoding"], channel["schemaName"]) == ("cdr", "visualization_msgs/msg/MarkerArray")
    assert "Marker[] markers" in channel["schema"]
    message = deserialise(got, "visualization_msgs/msg/MarkerArray")
    assert {mark.ns.partition("/")[2] for mark in message.markers} == {"joints", "bones", "velocity", "name"}


def test_who_subscribes_late_gets_what_is_latched() -> None:
    output = FoxgloveOutput(0)
    try:
        for text in ("at first", "at last"):
            cdr = serialise(new("std_msgs/msg/String", data=text))
            output.send("humans/bodies/b1/urdf", "std_msgs/msg/String", cdr, latched=True)
        _, got = first_message(int(output.url.rpartition(":")[2]), "/humans/bodies/b1/urdf")
        assert deserialise(got, "std_msgs/msg/String").data == "at last"
    finally:
        output.close()


def test_a_port_that_is_taken_is_said_with_what_to_do() -> None:
    with socket.create_server((HOST, 0)) as other, pytest.raises(LaunchError, match="set another port"):
        FoxgloveOutput(other.getsockname()[1])


def first_message(port: int, topic: str) -> tuple[dict[str, Any], bytes]:
    client = pytest.importorskip("websockets.sync.client", reason="the extra 'web' is not installed")
    with client.connect(f"ws://localhost:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as connection:
        offered: dict[str, dict[str, Any]] = {}
        while topic not in offered:
            offer = json.loads(connection.recv(20))
            offered |= {channel["topic"]: channel for channel in offer.get("channels", ())}
        asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": offered[topic]["id"]}]}
        connection.send(json.dumps(asked))
        while not isinstance(frame := connection.recv(20), bytes) or frame[0] != 1:
            # the SDK offers a channel a moment before it knows it, and refuses who subscribes in between
            if isinstance(frame, str) and "unknown channel" in frame.lower():
                connection.send(json.dumps(asked))
        return offered[topic], frame[13:]  # after four bytes of subscription and eight of time
