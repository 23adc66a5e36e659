"""Foxglove's WebSocket: what a client is offered, and gets."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import threading
from collections.abc import Callable

import pytest
from conftest import running, until
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.ros2.definitions import deserialise
from steadypose.nodes.sinks.ros2.foxglove import FoxgloveNode

pytest.importorskip("foxglove", reason="the extra 'foxglove' is not installed")


class WebSocket:
    """A client of as much of RFC 6455 as Foxglove's server speaks."""

    def __init__(self, port: int, protocol: str) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: {protocol}\r\n\r\n".encode()
        )
        self._file = self._socket.makefile("rb")
        assert b"101" in self._file.readline()
        while self._file.readline().strip():
            pass

    def receive(self) -> tuple[int, bytes]:
        first, second = self._file.read(2)
        length = second & 0x7F
        if length > 125:
            (length,) = struct.unpack(">H" if length == 126 else ">Q", self._file.read(2 if length == 126 else 8))
        return first & 0x0F, self._file.read(length)

    def send(self, text: str) -> None:
        data = text.encode()
        assert len(data) < 126
        self._socket.sendall(bytes([0x81, 0x80 | len(data), 0, 0, 0, 0]) + data)

    def close(self) -> None:
        self._file.close()
        self._socket.close()


def test_a_client_gets_markers(make_launch: Callable[..., Launch]) -> None:
    worlds = [message for topic, message in messages(1.0) if topic == POSE_WORLD]
    launch = make_launch(nodes='["trajectory", "foxglove"]', foxglove__port="0", transport__lossless="false")
    node = FoxgloveNode(launch)
    with Publisher(launch.transport.endpoint("trajectory")) as publisher, running(node):
        until(lambda: bool(node.url))

        def drawn() -> bool:
            publisher.publish(POSE_WORLD, worlds[-1])
            return node.health.stamp_ns > 0

        until(drawn)
        client = WebSocket(int(node.url.rpartition(":")[2]), "foxglove.sdk.v1")
        channel = None
        while channel is None:
            kind, data = client.receive()
            if kind == 1 and (told := json.loads(data))["op"] == "advertise":
                channel = next((c for c in told["channels"] if c["topic"] == "/steadypose/markers"), None)
        assert (channel["encoding"], channel["schemaName"]) == ("cdr", "visualization_msgs/msg/MarkerArray")
        assert "Marker[] markers" in channel["schema"]
        client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel["id"]}]}))
        got, subscribed = b"", threading.Event()

        def publish() -> None:  # when the server has noted the subscription, it does not say
            while not subscribed.wait(0.02):
                publisher.publish(POSE_WORLD, worlds[-1])

        publishing = threading.Thread(target=publish)
        publishing.start()
        try:
            while not got:
                kind, data = client.receive()
                got = data if kind == 2 and data[0] == 1 else b""
        finally:
            subscribed.set()
            publishing.join()
            client.close()
    message = deserialise(got[13:], "visualization_msgs/msg/MarkerArray")
    assert {mark.ns.partition("/")[2] for mark in message.markers} == {"joints", "bones", "velocity", "name"}
