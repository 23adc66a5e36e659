"""The same ROS 2 messages for Foxglove, over its WebSocket: no ROS, and no DDS."""

# pyright: reportMissingImports=false
# an optional extra, which need not be installed

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from steadypose import PACKAGE
from steadypose.msgs.types import Message
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.ros2.definitions import ros_types
from steadypose.nodes.sinks.ros2.settings import Ros2BridgeSettings
from steadypose.nodes.sinks.ros2.topics import BodyTopics

HOST = "127.0.0.1"
"""this machine only, as poses are personal data: from another machine, use ssh -L 8765:localhost:8765 robot"""
LAYOUT = PACKAGE / "launch/views/foxglove.json"


@dataclass(frozen=True)
class FoxgloveSettings:
    """``[foxglove]``: poses for Foxglove."""

    port: int = 8765
    """of the WebSocket: open ws://localhost:8765 in Foxglove"""
    world_frame: str = "world"
    """what the frame of pose/world is called"""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise LaunchError(f"[foxglove] port: expected 0 (any) to 65535, got {self.port}")


def check_foxglove(launch: Launch) -> None:
    """Raises:
    LaunchError: Foxglove's SDK is not installed.
    """
    require_extra("foxglove")


class FoxgloveOutput:
    """A WebSocket server with a channel for each topic, from its first message on.

    The server keeps no message: what is latched is sent again when somebody subscribes, to all who have.
    """

    def __init__(self, port: int) -> None:
        import foxglove
        from foxglove.websocket import ServerListener

        self._channels: dict[str, Any] = {}
        self._latched: dict[str, bytes] = {}
        output = self

        class Latch(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                output.repeat(channel.topic)

        self._context = foxglove.Context()
        try:
            self._server: Any = foxglove.start_server(
                name="steadypose", host=HOST, port=port, server_listener=Latch(), context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise LaunchError(f"[foxglove] port {port} cannot be opened: {error}") from error

    @property
    def url(self) -> str:
        return f"ws://localhost:{self._server.port}"

    def send(self, topic: str, kind: str, cdr: bytes, *, latched: bool = False) -> None:
        import foxglove

        if topic not in self._channels:
            definition, _ = ros_types().generate_msgdef(kind, ros_version=2)
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
            self._channels[topic] = foxglove.Channel(
                f"/{topic}", schema=schema, message_encoding="cdr", context=self._context
            )
        if latched:
            self._latched[topic] = cdr
        self._channels[topic].log(cdr)

    def repeat(self, channel: str) -> None:
        """Send the latched message of a channel again, if there is one."""
        topic = channel.removeprefix("/")
        open_one, cdr = self._channels.get(topic), self._latched.get(topic)
        if open_one and cdr is not None:
            open_one.log(cdr)

    def drop(self, topic: str) -> None:
        self._latched.pop(topic, None)
        if channel := self._channels.pop(topic, None):
            channel.close()

    def close(self) -> None:
        self._server.stop()


class FoxgloveNode(Node):
    """Serves poses to Foxglove, newest first when it falls behind; the pipeline never waits for it."""

    name = "foxglove"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        require_extra("foxglove")
        self._settings = launch.settings(FoxgloveSettings)
        self.url = ""

    def work(self) -> None:
        output = FoxgloveOutput(self._settings.port)
        try:
            self.url = output.url
            self._topics = BodyTopics(output, Ros2BridgeSettings(world_frame=self._settings.world_frame))
            print(f"Foxglove: {self.url}, layout {LAYOUT.resolve()}", flush=True)
            super().work()
        finally:
            output.close()

    def handle(self, topic: str, message: Message) -> None:
        if refused := self._topics.send(message):
            self.health.counts["refused.body not finite"] += refused

    def status(self) -> dict[str, str]:
        return {"address": self.url}
