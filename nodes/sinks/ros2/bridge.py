"""The ROS 2 bridge: ``pose/world`` and ``diagnostics`` out to ROS 2. docs/ros2.md lists the topics."""

from __future__ import annotations

from steadypose.msgs.types import Diagnostics, Message, PoseWorld
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node


def check_ros2(launch: Launch) -> None:
    """Raises:
    LaunchError: something of ROS 2 is not installed.
    """
    require_extra("ros2")


class Ros2BridgeNode(Node):
    """Publishes bodies in ROS 2."""

    name = "ros2_bridge"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        require_extra("ros2")
        self._bodies = 0

    def work(self) -> None:
        from steadypose.nodes.sinks.ros2.output import RosOutput

        with RosOutput() as self._ros:
            super().work()

    def handle(self, topic: str, message: Message) -> None:
        if isinstance(message, Diagnostics):
            self._ros.publish_diagnostics(message)
        elif isinstance(message, PoseWorld):
            self._bodies = len(message.bodies)
            if refused := self._ros.publish_bodies(message):
                self.health.counts["refused.body not finite"] += refused

    def status(self) -> dict[str, str]:
        return {"bodies": str(self._bodies)}
