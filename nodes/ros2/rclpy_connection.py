"""ROS 2's topics through the rclpy of a sourced ROS, with any middleware, on any processor that ROS supports."""

# pyright: reportMissingImports=false
# rclpy is installed with ROS

from collections.abc import Callable
from importlib import import_module
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from steadypose.nodes.ros2.definitions import DEPTH, Publish
from steadypose.nodes.settings import LaunchError


class RclpyConnection:
    """A ROS 2 node that sends and receives serialised messages; implements `Connection`."""

    def __init__(self, name: str, namespace: str = "") -> None:
        self._context = Context()
        # this process handles Ctrl-C itself
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node: Any = rclpy.create_node(
            name,
            namespace=namespace or None,
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[Publish, Any] = {}

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=1 if latched else DEPTH, durability=durability)
        publisher = self._node.create_publisher(_compiled(kind), f"/{topic}", qos)

        def publish(cdr: bytes) -> None:
            publisher.publish(cdr)

        self._publishers[publish] = publisher
        return publish

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        qos = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._node.create_subscription(_compiled(kind), f"/{topic}", heard, qos, raw=True)

    def spin(self, timeout_s: float) -> None:
        self._executor.spin_once(timeout_sec=timeout_s)

    def drop(self, publish: Publish) -> None:
        self._node.destroy_publisher(self._publishers.pop(publish))

    def close(self) -> None:
        self._node.destroy_node()
        self._context.shutdown()


def _compiled(kind: str) -> Any:
    package, _, name = kind.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError as error:
        how = f"sudo apt install ros-$ROS_DISTRO-{package.replace('_', '-')}"
        how = "build it with colcon: docs/ros2.md" if package == "steadypose_msgs" else how
        raise LaunchError(f"{kind} is not available in the sourced ROS: {how}") from error
