"""The VMC sink: one person as OSC over UDP, for avatars in Unity, Unreal and others (Virtual Motion Capture)."""

from __future__ import annotations

import socket
from dataclasses import dataclass

import numpy as np

from steadypose.msgs.types import Message, PoseWorld, Tracking, WorldBody
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError
from steadypose.prior.arrays import Floats
from steadypose.prior.body.avatars import VRM
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices
from steadypose.prior.body.skeleton import PARENTS

BONES = tuple(name[0].upper() + name[1:] for name in VRM)
"""(22,) as the protocol and Unity call them"""
GONE_NS = 1_000_000_000
"""after which another person is followed"""
_A_BUNDLE = 11  # bones, so that a datagram is not taken apart on its way


@dataclass(frozen=True)
class VmcSettings:
    """``[vmc]``: one person's pose for avatars, by the VMC protocol."""

    host: str = "127.0.0.1"
    """where datagrams go. Nobody is asked whether they may have them, and anybody on the way can read them"""
    port: int = 39539
    """to which UDP port: 39539 is what programs that play an avatar listen at"""

    def __post_init__(self) -> None:
        if not self.host:
            raise LaunchError("[vmc] host: expected where to send datagrams, such as 127.0.0.1, got nothing")
        if not 1 <= self.port <= 65535:
            raise LaunchError(f"[vmc] port: expected 1 to 65535, got {self.port}")


def check_vmc(launch: Launch) -> None:
    """Raises:
    LaunchError: the OSC library is not installed.
    """
    require_extra("vmc")


def unity(body: WorldBody) -> tuple[Floats, Floats]:
    """Where each bone is in its parent's frame, and how it is turned, in Unity's axes: x right, y up, z forward.

    Unity's are left-handed: positions are mirrored, and with them the sense of every turn.

    Returns:
        (22, 3) metres, the hips' in the world, and (22, 4) xyzw.
    """
    rotations = np.asarray(body.rotations, dtype=np.float64)
    world = global_rotations(rotation_matrices(rotations))
    positions = np.asarray(body.positions, dtype=np.float64)
    parents = list(PARENTS[1:])
    local = (positions[1:] - positions[parents])[:, None] @ world[parents]
    places = np.concatenate([positions[:1], local[:, 0]])
    return places[:, [1, 2, 0]] * (-1.0, 1.0, 1.0), rotations[:, [1, 2, 0, 3]] * (1.0, -1.0, -1.0, 1.0)


class VmcNode(Node):
    """Sends the pose of one person at a time, until they are gone; the pipeline never waits for it."""

    name = "vmc"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        require_extra("vmc")
        self._settings = launch.settings(VmcSettings)
        self._body: int | None = None
        self._seen_ns = 0
        self._first_ns: int | None = None
        self._sent = 0

    def work(self) -> None:
        family, kind, _, _, self._address = socket.getaddrinfo(
            self._settings.host, self._settings.port, type=socket.SOCK_DGRAM
        )[0]
        with socket.socket(family, kind) as self._socket:
            self._socket.setblocking(False)
            super().work()

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseWorld) or message.end_of_stream:
            return
        bodies = {body.id: body for body in message.bodies if body.tracking != Tracking.LOST}
        if bodies and self._body not in bodies and abs(message.stamp_ns - self._seen_ns) > GONE_NS:
            self._body = min(bodies)
        body = bodies.get(self._body) if self._body is not None else None
        if body is not None:
            self._seen_ns = message.stamp_ns
        self._first_ns = message.stamp_ns if self._first_ns is None else self._first_ns
        try:
            for datagram in datagrams((message.stamp_ns - self._first_ns) / 1e9, body):
                self._socket.sendto(datagram, self._address)
            self._sent += body is not None
        except OSError:  # nobody listens, or the way there is full: the next is newer
            self.health.counts["dropped.not sent"] += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._sent)}


def datagrams(time_s: float, body: WorldBody | None) -> list[bytes]:
    """A moment as OSC bundles: whether somebody is there, the time in seconds, and the bones of who is."""
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import build_msg

    messages = [build_msg("/VMC/Ext/OK", [int(body is not None)]), build_msg("/VMC/Ext/T", [time_s])]
    if body is not None:
        messages.append(build_msg("/VMC/Ext/Root/Pos", ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        for name, place, turn in zip(BONES, *unity(body), strict=True):
            messages.append(build_msg("/VMC/Ext/Bone/Pos", [name, *place.tolist(), *turn.tolist()]))
    bundles = []
    for start in range(0, len(messages), _A_BUNDLE):
        bundle = OscBundleBuilder(IMMEDIATELY)
        for message in messages[start : start + _A_BUNDLE]:
            bundle.add_content(message)
        bundles.append(bundle.build().dgram)
    return bundles
