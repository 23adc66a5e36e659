"""The retargeting sink: the newest pose of a robot, as a JSON datagram for each message of ``pose/world``."""

from __future__ import annotations

import json
import socket
from pathlib import Path

from steadypose.msgs.types import Message, PoseWorld
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.sinks.retarget.follower import Follower
from steadypose.nodes.sinks.retarget.retargeter import Retargeter, RobotPose
from steadypose.nodes.sinks.retarget.robot import load_robot
from steadypose.nodes.sinks.retarget.settings import RetargetSettings


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


class RetargetNode(Node):
    """Sends a robot's poses; the pipeline never waits for it."""

    name = "retarget"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        require_extra("retarget")
        one_thread()
        self._settings = launch.settings(RetargetSettings)
        self._robot = load_robot(Path(self._settings.urdf), self._settings.links)
        self._follower = Follower(Retargeter(self._robot, self._settings.sole))
        self._sent = 0

    def work(self) -> None:
        s = self._settings
        family, kind, _, _, address = socket.getaddrinfo(s.host, s.port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as self._socket:
            self._socket.setblocking(False)
            self._address = address
            super().work()

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseWorld) or message.end_of_stream:
            return
        pose = self._follower.process(message)
        if pose is None:
            return
        try:
            self._socket.sendto(datagram(pose, self._robot.joints), self._address)
            self._sent += 1
        except OSError:  # nobody listens, or the way there is full: the next is newer
            self.health.counts["dropped.not sent"] += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._sent)}
