"""Sinks that send one person's pose as UDP datagrams: whom they follow, and how they send."""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from steadypose.msgs.types import Message, PoseWorld, Tracking, WorldBody
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError

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
        if not self.host:
            raise LaunchError(
                f"[{self.section}] host: expected where to send datagrams, such as 127.0.0.1, got nothing"
            )
        if not 1 <= self.port <= 65535:
            raise LaunchError(f"[{self.section}] port: expected 1 to 65535, got {self.port}")


class Followed:
    """The one person that is followed, until they are gone; then the next.

    Args:
        body: the id of the only one to follow; None: the first who is there.

    Attributes:
        id: of who is followed; None before there was anybody.
    """

    def __init__(self, body: int | None = None) -> None:
        self.id = self._only = body
        self._seen_ns = 0

    def update(self, world: PoseWorld) -> WorldBody | None:
        """The body to follow at a message's moment; None while it is not there."""
        bodies = {body.id: body for body in world.bodies if body.tracking != Tracking.LOST}
        gone = self.id not in bodies and abs(world.stamp_ns - self._seen_ns) > GONE_NS
        if gone and bodies and self._only is None:
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
