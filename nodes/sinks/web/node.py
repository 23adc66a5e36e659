"""The web sink: bodies, events and node health as JSON over a WebSocket, for browsers and other programs.

docs/browser.md describes the messages. Positions are in metres, rounded to a tenth of a millimetre; values that are not
finite are null. Stamps are capture times in seconds, because a JavaScript number cannot hold nanoseconds.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import DIAGNOSTICS, POSE_EVENTS, POSE_WORLD
from steadypose.msgs.types import (
    CONTACTS,
    JOINTS,
    Diagnostics,
    Event,
    EventKind,
    JointState,
    Message,
    PoseEvents,
    PoseWorld,
    WorldBody,
)
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import LaunchError, check_host_and_port
from steadypose.nodes.sinks.serving import LOCAL_NAMES
from steadypose.prior.body.skeleton import PARENTS, VRM

if TYPE_CHECKING:
    from steadypose.nodes.sinks.web.server import WebServer


@dataclass(frozen=True)
class WebSettings:
    """``[web]``: poses, events and node health for browsers."""

    host: str = "127.0.0.1"
    """address to serve at. An address of the network sends poses, which are personal data, and the token in clear text;
    ``ssh -L 8766:localhost:8766 robot`` is the safe way from another machine"""
    port: int = 8766
    """port of the page and the WebSocket; 0: any free port"""
    names: list[str] = field(default_factory=list)
    """further host names by which browsers reach this machine, such as kiosk.local; requests for other names are
    refused"""
    token: str = ""
    """token that a client must give; empty: a random one, which is part of the printed address"""

    def __post_init__(self) -> None:
        check_host_and_port("web", self.host, self.port, least=0)
        if self.token and (len(self.token) < 16 or not all(c.isalnum() or c in "-_" for c in self.token)):
            got = f"{len(self.token)} characters; leave it out for a random one"
            raise LaunchError(f"[web] token: expected 16 or more letters, digits, - and _, got {got}")


TOKEN_FILE = "web_token"
"""Name of the file with the random token, in the directory of the sockets, which only this user can read. A restarted
node reads it, so that open pages stay connected."""


class WebNode(Node):
    """Serves the newest messages to browsers. The pipeline never waits for it."""

    name = "web"
    _server: WebServer | None = None

    @property
    def url(self) -> str:
        """Address of the page, with the token; empty until it is served."""
        return self._server.url if self._server else ""

    def work(self) -> None:
        from steadypose.nodes.sinks.web.server import WebServer  # not needed to read a launch file

        s = self.launch.settings(WebSettings)
        token = s.token or kept_token(self.launch.transport.ipc_directory / TOKEN_FILE)
        self._server = WebServer(s.host, s.port, s.names, token, hello())
        try:
            print(f"web: {self.url}", flush=True)
            if s.host not in LOCAL_NAMES:
                print(f"web: anyone who listens on the network to {s.host} can read poses and token", flush=True)
            super().work()
        finally:
            self._server.close()

    def handle(self, topic: str, message: Message) -> None:
        assert self._server
        if (text := to_json(message)) is not None:
            sender = message.node if isinstance(message, Diagnostics) else message.source
            self._server.send(f"{topic}/{sender}", text, replaces=topic != POSE_EVENTS)

    def status(self) -> dict[str, str]:
        server = self._server
        return {"clients": str(server.clients), "dropped.slow client": str(server.dropped)} if server else {}


def kept_token(file: Path) -> str:
    """The token in a file that only this user can read; created on first use. On a full disk, it is not kept."""
    with open(os.open(file, os.O_RDWR | os.O_CREAT, 0o600), "r+") as kept:
        fcntl.flock(kept, fcntl.LOCK_EX)
        token = kept.read()
        if not token:  # it is new, or the disk was full
            token = secrets.token_urlsafe(24)
            with suppress(OSError):
                os.write(kept.fileno(), token.encode())
    return token


VERSION = 1


def hello() -> str:
    """The first message to a client: the names behind the numbers in all other messages."""
    return _text(
        {
            "topic": "hello",
            "version": VERSION,
            "joints": JOINTS,
            "parents": PARENTS,
            "vrm": VRM,
            "contacts": CONTACTS,
            "states": [state.name for state in JointState],
            "events": [kind.name for kind in EventKind],
        }
    )


def to_json(message: Message) -> str | None:
    """A message as JSON; None for messages that browsers do not receive."""
    if isinstance(message, PoseWorld):
        return _text(_header(POSE_WORLD, message) | {"bodies": [_body(body) for body in message.bodies]})
    if isinstance(message, PoseEvents):
        return _text(_header(POSE_EVENTS, message) | {"events": [_event(event) for event in message.events]})
    if isinstance(message, Diagnostics):
        return _text(
            {
                "topic": DIAGNOSTICS,
                "stamp": message.stamp_ns / 1e9,
                "node": message.node,
                "level": message.level.name,
                "message": message.message,
                "values": message.values,
            }
        )
    return None


def _header(topic: str, message: PoseWorld | PoseEvents) -> dict[str, Any]:
    return {
        "topic": topic,
        "stamp": message.stamp_ns / 1e9,
        "frame": message.frame_id,
        "source": message.source,
        "end": message.end_of_stream,
    }


def _body(body: WorldBody) -> dict[str, Any]:
    return {
        "id": body.id,
        "tracking": body.tracking.name,
        "root": _numbers(body.root_position),
        "orientation": _numbers(body.root_orientation),
        "velocity": _numbers(body.root_velocity),
        "positions": _numbers(body.positions),
        "rotations": _numbers(body.rotations),
        "state": body.state.tolist(),
        "sigma": _numbers(body.sigma),
        "contacts": _numbers(body.contacts),
    }


def _event(event: Event) -> dict[str, Any]:
    return {
        "body": event.body,
        "kind": event.kind.name,
        "phase": event.phase.name,
        "hand": event.hand.name,
        "confidence": round(event.confidence, 3) if math.isfinite(event.confidence) else None,
        "direction": _numbers(event.direction) if event.kind == EventKind.POINTS else None,
        "since": event.since_ns / 1e9,
    }


def _numbers(values: NDArray[np.floating]) -> list[Any]:
    rounded = np.round(values.astype(np.float64), 4).astype(object)
    rounded[~np.isfinite(values)] = None
    return rounded.tolist()


def _text(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
