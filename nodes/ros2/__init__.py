"""ROS 2 without a ROS installation: messages, and topics over plain DDS or over the rclpy of a sourced ROS.

`connect` joins the ROS domain.
"""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

from steadypose.nodes.extras import install_command
from steadypose.nodes.settings import LaunchError

if TYPE_CHECKING:
    from steadypose.nodes.ros2.definitions import Connection


def check_ros() -> None:
    """Raise LaunchError if there is neither a sourced ROS 2 nor Cyclone DDS."""
    if not has_sourced_ros() and find_spec("cyclonedds") is None:
        needs = f"ROS 2: needs Cyclone DDS, which comes with the extra 'ros2' (x86-64): {install_command('ros2')}"
        raise LaunchError(f"{needs}; or a ROS 2 that is sourced, with a Python of the same version")


def has_sourced_ros() -> bool:
    """Whether a complete ROS 2 is sourced, not only its packages from PyPI."""
    return all(find_spec(package) is not None for package in ("rclpy", "tf2_msgs"))


def connect(name: str, namespace: str = "") -> Connection:
    """Join the ROS domain, through rclpy if a ROS is sourced, otherwise over plain DDS.

    ``name`` and ``namespace`` are the node's, visible only with rclpy; topics are given by their full names. Raises
    LaunchError if there is neither a usable rclpy nor Cyclone DDS.
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
