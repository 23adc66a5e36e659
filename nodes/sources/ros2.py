"""Skeletons from a ROS 2 topic, in place of a camera: ``[input] source = "ros2"``."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from typing import Any

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.launch import LaunchError, Ros2Settings, nearest
from steadypose.nodes.graph.runtime import TURN_S
from steadypose.nodes.sinks.ros2.bridge import require_ros2
from steadypose.nodes.sources.adapters import from_azure_kinect, from_pose_array
from steadypose.nodes.sources.camera import LiveSource
from steadypose.prior.body.layouts import SKELETONS


class Ros2Source(LiveSource):
    """A subscription to ``MarkerArray`` or ``PoseArray``.

    Raises:
        LaunchError: ROS 2 is not installed, or there is no such skeleton.
    """

    def __init__(self, settings: Ros2Settings) -> None:
        super().__init__()
        require_ros2()
        if settings.skeleton not in SKELETONS:
            raise LaunchError(
                f"[input.ros2] skeleton: expected one of {', '.join(SKELETONS)}, got {settings.skeleton!r}"
                f"{nearest(settings.skeleton, SKELETONS)}"
            )
        self._settings = settings
        self._found: deque[PoseRaw] = deque()
        self._heard = 0

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        import rclpy  # pyright: ignore[reportMissingImports]
        from geometry_msgs.msg import PoseArray  # pyright: ignore[reportMissingImports]
        from rclpy.executors import SingleThreadedExecutor  # pyright: ignore[reportMissingImports]
        from rclpy.qos import qos_profile_sensor_data  # pyright: ignore[reportMissingImports]
        from rclpy.signals import SignalHandlerOptions  # pyright: ignore[reportMissingImports]
        from visualization_msgs.msg import MarkerArray  # pyright: ignore[reportMissingImports]

        context = rclpy.Context()
        # Ctrl-C is the input node's business, not rclpy's
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            node: Any = rclpy.create_node("steadypose_input", context=context, enable_rosout=False)
            kind = {"MarkerArray": MarkerArray, "PoseArray": PoseArray}[self._settings.type]
            # best effort, which hears reliable publishers too
            node.create_subscription(kind, self._settings.topic, self._hear, qos_profile_sensor_data)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            while True:
                executor.spin_once(timeout_sec=TURN_S)
                yield self._found.popleft() if self._found else None
        finally:
            context.shutdown()

    def _hear(self, message: Any) -> None:
        self._heard += 1
        try:
            if self._settings.type == "MarkerArray":
                raw = from_azure_kinect(message, source=self._settings.topic)
            else:
                skeleton = SKELETONS[self._settings.skeleton]
                raw = from_pose_array(message, skeleton, self._settings.up, source=self._settings.topic)
        except ValueError:
            self.refused[f"not a {self._settings.type} of skeletons"] += 1
            return
        if raw:
            self._found.append(raw)

    def status(self) -> dict[str, str]:
        return {"camera": f"{self._settings.topic}, {self._heard} messages"}
