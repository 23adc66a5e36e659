"""The ROS 2 bridge: ``pose/world`` and ``diagnostics`` out to ROS 2. What comes out is told in docs/ros2.md."""

from __future__ import annotations

from importlib.util import find_spec

from steadypose.msgs.types import Diagnostics, Message, PoseWorld
from steadypose.nodes.graph.launch import Launch, LaunchError
from steadypose.nodes.graph.runtime import Clock, Node

PACKAGES = ("rclpy", "rmw_fastrtps_cpp", "visualization_msgs", "diagnostic_msgs", "sensor_msgs", "cyclonedds")


def require_ros2() -> None:
    """Raises:
    LaunchError: something of ROS 2 is not installed.
    """
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise LaunchError(
            f"the ROS 2 bridge needs {', '.join(missing)}, not installed: run `uv sync --inexact --extra ros2` in the "
            "checkout, or `pip install 'steadypose[ros2]'`; everything but ROS 2 works without"
        )


class Ros2BridgeNode(Node):
    """Publishes bodies in ROS 2."""

    name = "ros2_bridge"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        require_ros2()
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
                self.counts["refused.body not finite"] += refused

    def status(self) -> dict[str, str]:
        return {"bodies": str(self._bodies)}
