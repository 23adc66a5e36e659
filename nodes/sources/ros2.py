"""Skeletons from a ROS 2 topic, in place of a camera: ``[input] source = "ros2"``."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.settings import LaunchError, nearest
from steadypose.nodes.sources.adapters import from_azure_kinect, from_pose_array
from steadypose.nodes.sources.source import LiveSource, SourceContext
from steadypose.prior.body.layouts import SKELETONS


@dataclass(frozen=True)
class Ros2Settings:
    """``[input.ros2]``: a ROS 2 topic with skeletons."""

    topic: str = "/body_tracking_data"
    type: str = "MarkerArray"
    """MarkerArray, as the driver of the Azure Kinect has it; or PoseArray, the joints of one body after the other"""
    skeleton: str = "smpl22"
    """of a PoseArray: the joints and their order"""
    up: str = "z"
    """of a PoseArray: the axis of its frame that points up: z, y or -y"""

    def __post_init__(self) -> None:
        if self.type not in ("MarkerArray", "PoseArray"):
            raise LaunchError(f"[input.ros2] type: expected MarkerArray or PoseArray, got {self.type!r}")
        if self.up not in ("z", "y", "-y"):
            raise LaunchError(f"[input.ros2] up: expected z, y or -y, got {self.up!r}")


class Ros2Source(LiveSource):
    """A subscription to ``MarkerArray`` or ``PoseArray``.

    Raises:
        LaunchError: there is no such skeleton.
    """

    def __init__(self, settings: Ros2Settings, context: SourceContext) -> None:
        super().__init__()
        if settings.skeleton not in SKELETONS:
            raise LaunchError(
                f"[input.ros2] skeleton: expected one of {', '.join(SKELETONS)}, got {settings.skeleton!r}"
                f"{nearest(settings.skeleton, SKELETONS)}"
            )
        self._settings = settings
        self._queue: deque[PoseRaw] = deque()
        self._received = 0

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
            node.create_subscription(kind, self._settings.topic, self._on_message, qos_profile_sensor_data)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            while True:
                executor.spin_once(timeout_sec=POLL_S)
                yield self._queue.popleft() if self._queue else None
        finally:
            context.shutdown()

    def _on_message(self, message: Any) -> None:
        self._received += 1
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
            self._queue.append(raw)

    def status(self) -> dict[str, str]:
        return {"camera": f"{self._settings.topic}, {self._received} messages"}
