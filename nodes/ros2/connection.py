"""A connection to ROS 2's topics: through the rclpy of a ROS that is sourced, or else over Cyclone DDS."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Protocol

from steadypose.nodes.graph.extras import install_command
from steadypose.nodes.graph.settings import LaunchError

Publish = Callable[[bytes], None]
"""a message, as CDR"""
DEPTH = 10
"""messages held for a subscriber that is late"""


class Connection(Protocol):
    """A node in a ROS domain. Not thread-safe."""

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        """A reliable publisher of messages on a topic.

        Args:
            topic: such as ``tf``; without a leading slash.
            kind: such as ``tf2_msgs/msg/TFMessage``.
            latched: whether late subscribers get the last message (TRANSIENT_LOCAL).

        Raises:
            LaunchError: the type is not available.
        """
        ...

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        """Call ``heard`` with each message of a topic from `spin`; publishers may be reliable or best-effort."""
        ...

    def spin(self, timeout_s: float) -> None:
        """Wait for messages, for so long at most, and pass them to their callbacks."""
        ...

    def drop(self, publish: Publish) -> None:
        """Publish there no more."""
        ...

    def close(self) -> None: ...


def check_ros() -> None:
    """Raises:
    LaunchError: neither a sourced ROS 2 nor Cyclone DDS is there.
    """
    if not has_sourced_ros() and find_spec("cyclonedds") is None:
        raise LaunchError(
            f"ROS 2: needs Cyclone DDS, which comes with the extra 'ros2' (x86-64): {install_command('ros2')}; "
            "or a ROS 2 that is sourced, with a Python of the same version"
        )


def has_sourced_ros() -> bool:
    """Whether a whole ROS 2 is there, not only what PyPI has of it."""
    return all(find_spec(package) is not None for package in ("rclpy", "tf2_msgs"))


def connect(name: str, namespace: str = "") -> Connection:
    """Join the ROS domain: through the rclpy of a ROS that is sourced, or else over plain DDS.

    Args:
        name: of the node, which only rclpy's are seen to have.
        namespace: of the node; topics are named in full.

    Raises:
        LaunchError: nothing that can do so is installed.
    """
    check_ros()
    if has_sourced_ros():
        try:
            from steadypose.nodes.ros2.rclpy_connection import RclpyConnection
        except ImportError as error:
            why = f"Python {sys.version_info[0]}.{sys.version_info[1]} cannot import the sourced rclpy: "
            why += str(error).partition("\n")[0]
            if find_spec("cyclonedds") is None:
                raise LaunchError(
                    f"ROS 2: {why}; expected the Python that ROS is built for (Humble 3.10, Jazzy 3.12), which "
                    "`./steadypose` takes if ROS is sourced when there is no .venv yet, and PyYAML, which comes with "
                    "the extra 'ros2'"
                ) from error
            print(f"ROS 2 over plain DDS: {why}", flush=True)
        else:
            return RclpyConnection(name, namespace)
    from steadypose.nodes.ros2.dds import DdsConnection

    return DdsConnection()
