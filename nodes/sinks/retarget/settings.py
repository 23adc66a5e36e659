"""The retargeting sink's section of a launch file, and what it needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError, path_setting


@dataclass(frozen=True)
class RetargetSettings:
    """``[retarget]``: a person's motion as a robot's, as JSON datagrams."""

    urdf: str = path_setting()
    """of the robot"""
    links: dict[str, str] = field(default_factory=dict)
    """the link that plays a part of the body, such as ``left_foot``, where its name does not tell"""
    sole: float = 0.0
    """metres from the floor to the origins of the foot links, when they stand"""
    host: str = "127.0.0.1"
    """where the datagrams go. Nobody is asked whether they may have them, and anybody on the way can read them"""
    port: int = 8767
    """to which UDP port"""

    def __post_init__(self) -> None:
        if not self.host:
            raise LaunchError("[retarget] host: expected where to send datagrams, such as 127.0.0.1, got nothing")
        if not 1 <= self.port <= 65535:
            raise LaunchError(f"[retarget] port: expected 1 to 65535, got {self.port}")
        if not 0.0 <= self.sole <= 0.5:
            raise LaunchError(f"[retarget] sole: expected 0 to 0.5 metres, got {self.sole:g}")


def check_retarget(launch: Launch) -> None:
    """Raises:
    LaunchError: the solver is not installed, or there is no such robot.
    """
    require_extra("retarget")
    settings = launch.settings(RetargetSettings)
    if not settings.urdf:
        raise LaunchError("[retarget] urdf: expected the robot's URDF file, got none")
    from steadypose.nodes.sinks.retarget.robot import load_robot

    load_robot(Path(settings.urdf), settings.links)
