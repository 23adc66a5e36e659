"""Sinks that send one person's pose as UDP datagrams: whom they follow, how they send, and VMC.

VMC (Virtual Motion Capture) is OSC over UDP, for avatars in Unity, Unreal and others.
"""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from steadypose.msgs.types import Message, PoseWorld, Tracking, WorldBody
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import check_host_and_port
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices
from steadypose.prior.body.skeleton import PARENTS, VRM

GONE_NS = 1_000_000_000
"""absence, nanoseconds, after which another person is followed"""


@dataclass(frozen=True)
class DatagramSettings:
    """Where datagrams go."""

    section: ClassVar[str]
    """of a launch file"""

    host: str = "127.0.0.1"
    """where the datagrams go. Nobody is asked whether they may have them, and anybody on the way can read them"""
    port: int = 0
    """to which UDP port"""

    def __post_init__(self) -> None:
        check_host_and_port(self.section, self.host, self.port)


class Followed:
    """The one person that is followed, until they are gone; then the next.

    Args:
        body: the id of the only one to follow; None: the first who is there.

    Attributes:
        id: of who is followed; None before there was anybody.
    """

    def __init__(self, body: int | None = None) -> None:
        self.id = self._only = body
        self._seen_ns: int | None = None

    def update(self, world: PoseWorld) -> WorldBody | None:
        """The body to follow at a message's moment; None while it is not there."""
        bodies = {body.id: body for body in world.bodies if body.tracking != Tracking.LOST}
        gone = self._seen_ns is None or abs(world.stamp_ns - self._seen_ns) > GONE_NS
        if self.id not in bodies and gone and bodies and self._only is None:
            self.id = min(bodies)
        if self.id is None or self.id not in bodies:
            return None
        self._seen_ns = world.stamp_ns
        return bodies[self.id]


class DatagramNode(Node):
    """Sends datagrams for each message of ``pose/world``; the pipeline never waits for it."""

    _settings: DatagramSettings
    _sent = 0

    @abstractmethod
    def datagrams(self, world: PoseWorld) -> Sequence[bytes]:
        """What is to be sent of a message: none before there was anybody."""

    def work(self) -> None:
        s = self._settings
        family, kind, _, _, self._address = socket.getaddrinfo(s.host, s.port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as self._socket:
            self._socket.setblocking(False)
            super().work()

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseWorld) or message.end_of_stream:
            return
        datagrams = self.datagrams(message)
        try:
            for datagram in datagrams:
                self._socket.sendto(datagram, self._address)
            self._sent += bool(datagrams)
        except OSError:  # nobody listens, or the way there is full: the next is newer
            self.health.counts["dropped.not sent"] += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._sent)}


BONES = tuple(name[0].upper() + name[1:] for name in VRM)
"""(22,) as the protocol and Unity call them"""
_A_BUNDLE = 11  # bones, so that a datagram is not taken apart on its way


@dataclass(frozen=True)
class VmcSettings(DatagramSettings):
    """``[vmc]``: one person's pose for avatars, by the VMC protocol."""

    section = "vmc"

    port: int = 39539
    """to which UDP port: 39539 is what programs that play an avatar listen at"""


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


class VmcNode(DatagramNode):
    """Sends the pose of one person at a time, until they are gone."""

    name = "vmc"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        self._settings = launch.settings(VmcSettings)
        self._followed = Followed()
        self._first_ns: int | None = None

    def datagrams(self, world: PoseWorld) -> list[bytes]:
        self._first_ns = world.stamp_ns if self._first_ns is None else self._first_ns
        return osc_bundles((world.stamp_ns - self._first_ns) / 1e9, self._followed.update(world))


def osc_bundles(time_s: float, body: WorldBody | None) -> list[bytes]:
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
