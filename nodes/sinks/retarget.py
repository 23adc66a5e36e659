"""The retargeting sink: the newest pose of a robot, as a JSON datagram for each message of ``pose/world``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from steadypose.msgs.types import PoseWorld
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError, path_setting
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.sinks.datagrams import DatagramNode, DatagramSettings
from steadypose.nodes.sinks.robot import load_robot

if TYPE_CHECKING:
    from steadypose.nodes.sinks.retargeter import RobotPose


@dataclass(frozen=True)
class RetargetSettings(DatagramSettings):
    """``[retarget]``: a person's motion as a robot's, as JSON datagrams."""

    section = "retarget"

    urdf: str = path_setting()
    """of the robot"""
    links: dict[str, str] = field(default_factory=dict)
    """the link that plays a part of the body, such as ``left_foot``, where its name does not tell"""
    sole: float = 0.0
    """metres from the floor to the origins of the foot links, when they stand"""
    port: int = 8767
    """to which UDP port"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.sole <= 0.5:
            raise LaunchError(f"[retarget] sole: expected 0 to 0.5 metres, got {self.sole:g}")


def check_retarget(launch: Launch) -> None:
    """Raises:
    LaunchError: there is no such robot.
    """
    settings = launch.settings(RetargetSettings)
    if not settings.urdf:
        raise LaunchError("[retarget] urdf: expected the robot's URDF file, got none")
    load_robot(Path(settings.urdf), settings.links)


def datagram(pose: RobotPose, joints: tuple[str, ...]) -> bytes:
    """A pose as JSON: stamp in seconds of capture, root link in the world (metres, xyzw), joints by name."""
    return json.dumps(
        {
            "stamp": pose.stamp_ns / 1e9,
            "root": pose.root.round(5).tolist(),
            "joints": dict(zip(joints, pose.joints.tolist(), strict=True)),
            "stands": dict(zip(("left", "right"), pose.stands, strict=True)),
        },
        separators=(",", ":"),
    ).encode()


class RetargetNode(DatagramNode):
    """Sends a robot's poses."""

    name = "retarget"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        from steadypose.nodes.sinks.retargeter import Follower, Retargeter

        one_thread()
        self._settings = settings = launch.settings(RetargetSettings)
        self._robot = load_robot(Path(settings.urdf), settings.links)
        self._follower = Follower(Retargeter(self._robot, settings.sole))

    def datagrams(self, world: PoseWorld) -> Sequence[bytes]:
        pose = self._follower.process(world)
        return [] if pose is None else [datagram(pose, self._robot.joints)]
