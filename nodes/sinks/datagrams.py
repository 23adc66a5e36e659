"""Sinks that send one person's pose as UDP datagrams, and the VMC sink.

VMC (Virtual Motion Capture) is a protocol of OSC over UDP, for avatars in Unity, Unreal and others.
"""

import socket
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from steadypose.msgs.types import Message, PoseWorld, Tracking, WorldBody
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import check_host_and_port
from steadypose.nodes.sinks.drawing import ahead
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices
from steadypose.prior.body.skeleton import PARENTS, VRM

GONE_NS = 1_000_000_000  # time of absence after which another person is followed, nanoseconds


@dataclass(frozen=True)
class DatagramSettings:
    """The receiver of datagrams."""

    section: ClassVar[str]
    """the section in a launch file"""

    host: str = "127.0.0.1"
    """address of the receiver; there is no access control, and anyone on the way can read the datagrams"""
    port: int = 0
    """UDP port of the receiver"""

    def __post_init__(self) -> None:
        check_host_and_port(self.section, self.host, self.port)


class Followed:
    """Selects one person (or only ``body``) to follow until they are gone, then the next; ``id`` is None at first."""

    def __init__(self, body: int | None = None) -> None:
        self.id = self._only = body
        self._seen_ns: int | None = None

    def update(self, world: PoseWorld) -> WorldBody | None:
        """The followed body in a message; None if it is absent."""
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
        """The datagrams to send for a message."""

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
        except OSError:  # nobody listens, or the network buffer is full; not repeated, because the next pose is newer
            self.health.counts["dropped.not sent"] += 1

    def status(self) -> dict[str, str]:
        return {"written": str(self._sent)}


BONES = tuple(name[0].upper() + name[1:] for name in VRM)  # (22,) names of the bones in the protocol and in Unity
_A_BUNDLE = 11  # messages per datagram, so that datagrams are not fragmented


@dataclass(frozen=True)
class VmcSettings(DatagramSettings):
    """``[vmc]``: one person's pose for avatars, by the VMC protocol."""

    section = "vmc"

    port: int = 39539
    """UDP port of the receiver; 39539 is the usual port of programs that play an avatar"""


def unity(body: WorldBody) -> tuple[Floats, Floats]:
    """Each bone's position (22, 3) metres and rotation (22, 4) xyzw in its parent's frame, the hips' in the world.

    The axes are Unity's: x right, y up, z forward. They are left-handed, so positions are mirrored, and the sense of
    rotations is reversed. A person who faces the camera looks along z.
    """
    rotations = np.array(body.rotations, dtype=np.float64)
    world = global_rotations(rotation_matrices(rotations))
    positions = np.asarray(body.positions, dtype=np.float64)
    parents = list(PARENTS[1:])
    local = (positions[1:] - positions[parents])[:, None] @ world[parents]
    root, rotations[0] = ahead(positions[0], rotations[0])
    places = np.concatenate([root[None], local[:, 0]])
    return places[:, [1, 2, 0]] * (-1.0, 1.0, 1.0), rotations[:, [1, 2, 0, 3]] * (1.0, -1.0, -1.0, 1.0)


class VmcNode(DatagramNode):
    """Sends one person's pose by VMC, and follows that person until they are gone."""

    name = "vmc"

    def __init__(self, launch: Launch) -> None:
        super().__init__(launch)
        self._settings = launch.settings(VmcSettings)
        self._followed = Followed()
        self._first_ns: int | None = None

    def datagrams(self, world: PoseWorld) -> list[bytes]:
        self._first_ns = world.stamp_ns if self._first_ns is None else self._first_ns
        return osc_bundles((world.stamp_ns - self._first_ns) / 1e9, self._followed.update(world))


def osc_bundles(time_s: float, body: WorldBody | None) -> list[bytes]:
    """OSC bundles for one time: whether there is a person, the time in seconds, and the person's bones."""
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import build_msg

    messages = [build_msg("/VMC/Ext/OK", [int(body is not None)]), build_msg("/VMC/Ext/T", [time_s])]
    if body is not None:
        messages.append(build_msg("/VMC/Ext/Root/Pos", ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        for name, place, turn in zip(BONES, *unity(body), strict=True):
            if np.isfinite(place).all():  # Unity takes no NaN: a bone without an estimate stays as it is
                messages.append(build_msg("/VMC/Ext/Bone/Pos", [name, *place.tolist(), *turn.tolist()]))
    bundles = []
    for start in range(0, len(messages), _A_BUNDLE):
        bundle = OscBundleBuilder(IMMEDIATELY)
        for message in messages[start : start + _A_BUNDLE]:
            bundle.add_content(message)
        bundles.append(bundle.build().dgram)
    return bundles
