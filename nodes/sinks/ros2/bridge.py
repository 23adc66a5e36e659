"""The ROS 2 bridge: poses and ``diagnostics`` out to ROS 2. docs/ros2.md lists the topics."""

from __future__ import annotations

from collections import Counter

from steadypose import PACKAGE
from steadypose.msgs.types import Message, PoseWorld
from steadypose.nodes.checks.problem import Problem, warning
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.ros2.connect import check_ros, connect
from steadypose.nodes.ros2.connection import Connection, Publish
from steadypose.nodes.sinks.ros2.settings import Ros2BridgeSettings
from steadypose.nodes.sinks.ros2.topics import BodyTopics

RVIZ = PACKAGE / "launch/views/steadypose.rviz"
GLOBAL = ("tf", "tf_static", "clock", "diagnostics")
"""topics that are in no namespace, by ROS's convention"""


def check_ros2(launch: Launch) -> None:
    """Raises:
    LaunchError: nothing that speaks ROS 2 is installed.
    """
    check_ros()


class RosOutput:
    """Publishes each topic from its first message on, in a namespace."""

    def __init__(self, connection: Connection, namespace: str = "") -> None:
        self._connection = connection
        self._prefix = f"{namespace}/" if namespace else ""
        self._publish: dict[str, Publish] = {}
        self.missing: dict[str, str] = {}
        """topics whose types are not to be had, and what to do about it"""

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


class Ros2BridgeNode(Node):
    """Publishes bodies in ROS 2."""

    name = "ros2_bridge"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        check_ros()
        self._settings = launch.settings(Ros2BridgeSettings)
        self._bodies = 0
        self._missing: Counter[str] = Counter()

    def work(self) -> None:
        connection = connect("steadypose_bridge", self._settings.namespace)
        try:
            self._output = RosOutput(connection, self._settings.namespace)
            self._topics = BodyTopics(self._output, self._settings)
            print(f"RViz: rviz2 -d {RVIZ.resolve()} -f {self._settings.world_frame}", flush=True)
            super().work()
        finally:
            connection.close()

    def handle(self, topic: str, message: Message) -> None:
        if isinstance(message, PoseWorld):
            self._bodies = len(message.bodies)
            if self._settings.clock and self.timeline and not self.timeline.is_now:
                self._topics.send_clock(self.timeline.stamp_at(self.clock.now_ns()))
        if refused := self._topics.send(message):
            self.health.counts["refused.body not finite"] += refused

    def problems(self) -> list[Problem]:
        missing = self._output.missing if hasattr(self, "_output") else {}
        return [warning("ros_type", f"/{topic} is not published: {why}") for topic, why in list(missing.items())[:1]]

    def status(self) -> dict[str, str]:
        return {"bodies": str(self._bodies)}
