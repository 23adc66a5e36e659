"""Settings of the ROS 2 bridge and of Foxglove's server."""

from __future__ import annotations

import re
from dataclasses import dataclass

from steadypose.nodes.settings import LaunchError, check_host_and_port

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
            raise LaunchError(
                f"[ros2] namespace: expected a name such as robot or fleet/robot1, got {self.namespace!r}"
            )


@dataclass(frozen=True)
class FoxgloveSettings:
    """``[foxglove]``: poses for Foxglove."""

    port: int = 8765
    """port of the WebSocket: open ws://localhost:8765 in Foxglove"""
    world_frame: str = "world"
    """name of the frame of pose/world"""

    def __post_init__(self) -> None:
        check_host_and_port("foxglove", HOST, self.port, least=0)
