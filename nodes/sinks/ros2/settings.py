"""The bridge's section of a launch file: its frames and what it publishes."""

from __future__ import annotations

from dataclasses import dataclass

from steadypose.nodes.graph.settings import LaunchError


@dataclass(frozen=True)
class Ros2BridgeSettings:
    """``[ros2]``: poses in ROS 2."""

    world_frame: str = "world"
    """what the frame of pose/world is called in TF: map, odom, base_link, or a frame of its own"""
    sensor_tf: bool = True
    """publish where a calibrated sensor stands; off where the robot's own description does"""
    clock: bool = True
    """publish /clock while a recording is replayed, for nodes with use_sim_time"""

    def __post_init__(self) -> None:
        if not self.world_frame or self.world_frame.startswith("/"):
            raise LaunchError(f"[ros2] world_frame: expected a frame's name without a slash, got {self.world_frame!r}")
