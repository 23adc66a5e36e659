"""Publishes poses and ``diagnostics`` as ROS 2 messages: in ROS 2, or to Foxglove over its WebSocket without ROS.

docs/ros2.md lists the topics.
"""

# pyright: reportMissingImports=false
# an optional extra that may not be installed

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from steadypose import PACKAGE
from steadypose.msgs.types import Message, PoseWorld
from steadypose.nodes.checks.problem import Problem, warning
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.ros2 import check_ros, connect
from steadypose.nodes.ros2.definitions import Connection, Publish, ros_types
from steadypose.nodes.settings import LaunchError, check_host_and_port
from steadypose.nodes.sinks.serving import port_taken

if TYPE_CHECKING:
    from steadypose.nodes.sinks.ros2.messages import BodyTopics

RVIZ, LAYOUT = PACKAGE / "launch/views/steadypose.rviz", PACKAGE / "launch/views/foxglove.json"
GLOBAL = ("tf", "tf_static", "clock", "diagnostics")  # topics outside any namespace, by ROS's convention
SILENT_NS = 5_000_000_000  # time without a message after which the bodies of a source are removed, nanoseconds
HOST = "127.0.0.1"
"""Address to serve at: this machine only, because poses are personal data. From another machine, use
``ssh -L 8765:localhost:8765 robot``."""
_NAMESPACE = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


@dataclass(frozen=True)
class Ros2BridgeSettings:
    """``[ros2]``: poses in ROS 2."""

    world_frame: str = "world"
    """TF frame of pose/world: map, odom, base_link, or a separate frame"""
    sensor_tf: bool = True
    """whether to publish the pose of a calibrated sensor; false if the robot's description does"""
    clock: bool = True
    """whether to publish /clock during a replay, for nodes with use_sim_time"""
    namespace: str = ""
    """namespace of the node and its topics, except /tf, /tf_static, /clock and /diagnostics, which all robots share"""

    def __post_init__(self) -> None:
        if not self.world_frame or self.world_frame.startswith("/"):
            raise LaunchError(f"[ros2] world_frame: expected a frame's name without a slash, got {self.world_frame!r}")
        if self.namespace and not _NAMESPACE.fullmatch(self.namespace):
            raise LaunchError(f"[ros2] namespace: expected a name, as robot or fleet/robot1, got {self.namespace!r}")


@dataclass(frozen=True)
class FoxgloveSettings:
    """``[foxglove]``: poses for Foxglove."""

    port: int = 8765
    """port of the WebSocket: open ws://localhost:8765 in Foxglove"""
    world_frame: str = "world"
    """name of the frame of pose/world"""

    def __post_init__(self) -> None:
        check_host_and_port("foxglove", HOST, self.port, least=0)


def check_ros2(launch: Launch) -> None:
    """Raise LaunchError if ROS 2's topics cannot be reached."""
    check_ros()


class RosOutput:
    """Publishes to ROS 2 in a namespace. A topic is advertised with its first message."""

    def __init__(self, connection: Connection, namespace: str = "") -> None:
        self._connection = connection
        self._prefix = f"{namespace}/" if namespace else ""
        self._publish: dict[str, Publish] = {}
        self.missing: dict[str, str] = {}
        """topics whose types are not available, and what to do about it"""

    def send(self, topic: str, kind: str, cdr: bytes, *, latched: bool = False) -> None:
        if topic in self.missing:
            return
        if topic not in self._publish:
            try:
                full = topic if topic in GLOBAL else self._prefix + topic
                self._publish[topic] = self._connection.publisher(full, kind, latched=latched)
            except LaunchError as error:
                self.missing[topic] = str(error)
                return
        self._publish[topic](cdr)

    def drop(self, topic: str) -> None:
        if publish := self._publish.pop(topic, None):
            self._connection.drop(publish)


class FoxgloveOutput:
    """A WebSocket server with a channel per topic, created with its first message.

    The server keeps no messages: a latched one is sent again to all subscribers when a client subscribes.
    """

    def __init__(self, port: int) -> None:
        import foxglove
        from foxglove.websocket import ServerListener

        self._channels: dict[str, Any] = {}
        self._latched: dict[str, bytes] = {}
        repeat = self._repeat

        class Latch(ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                repeat(channel.topic.removeprefix("/"))

        self._context = foxglove.Context()
        try:
            self._server: Any = foxglove.start_server(
                name="steadypose", host=HOST, port=port, server_listener=Latch(), context=self._context
            )
        except (OSError, RuntimeError) as error:
            raise LaunchError(port_taken("foxglove", HOST, port, error)) from error

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

    def _repeat(self, topic: str) -> None:
        if topic in self._latched:
            self._channels[topic].log(self._latched[topic])

    def drop(self, topic: str) -> None:
        self._latched.pop(topic, None)
        if channel := self._channels.pop(topic, None):
            channel.close()

    def close(self) -> None:
        self._server.stop()


class RosMessagesNode(Node):
    """Publishes steadypose's messages as ROS messages, by the `BodyTopics` of its output."""

    _topics: BodyTopics

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        self._heard_ns: dict[str, int] = {}

    def handle(self, topic: str, message: Message) -> None:
        now_ns = self.clock.monotonic_ns()
        if isinstance(message, PoseWorld):
            self._heard_ns[message.source] = now_ns
        for source in [source for source, heard_ns in self._heard_ns.items() if now_ns - heard_ns > SILENT_NS]:
            del self._heard_ns[source]
            self._topics.forget(source)
        if refused := self._topics.send(message):
            self.health.counts["refused.body not finite"] += refused


class Ros2BridgeNode(RosMessagesNode):
    """Publishes bodies in ROS 2."""

    name = "ros2_bridge"
    _bodies = 0
    _output: RosOutput | None = None

    def work(self) -> None:
        from steadypose.nodes.sinks.ros2.messages import BodyTopics  # not needed to read a launch file; so below

        self._settings = s = self.launch.settings(Ros2BridgeSettings)
        connection, several = connect("steadypose_bridge", s.namespace), bool(self.launch.server.clients)
        try:
            self._output = RosOutput(connection, s.namespace)
            self._topics = BodyTopics(self._output, s.world_frame, sensor_tf=s.sensor_tf, several=several)
            print(f"RViz: rviz2 -d {RVIZ.resolve()} -f {s.world_frame}", flush=True)
            super().work()
        finally:
            connection.close()

    def handle(self, topic: str, message: Message) -> None:
        if isinstance(message, PoseWorld):
            self._bodies = len(message.bodies)
            if self._settings.clock and self.timeline and not self.timeline.is_now:
                self._topics.send_clock(self.timeline.stamp_at(self.clock.now_ns()))
        super().handle(topic, message)

    def problems(self) -> list[Problem]:
        missing = self._output.missing if self._output else {}
        return [warning("ros_type", f"/{topic} is not published: {why}") for topic, why in list(missing.items())[:1]]

    def status(self) -> dict[str, str]:
        return {"bodies": str(self._bodies)}


class FoxgloveNode(RosMessagesNode):
    """Serves poses to Foxglove. When it falls behind it skips frames; the pipeline never waits for it."""

    name = "foxglove"
    url = ""

    def work(self) -> None:
        from steadypose.nodes.sinks.ros2.messages import BodyTopics

        settings = self.launch.settings(FoxgloveSettings)
        output = FoxgloveOutput(settings.port)
        try:
            self.url = output.url
            self._topics = BodyTopics(output, settings.world_frame, several=bool(self.launch.server.clients))
            print(f"Foxglove: {self.url}, layout {LAYOUT.resolve()}", flush=True)
            super().work()
        finally:
            output.close()

    def status(self) -> dict[str, str]:
        return {"address": self.url}
