"""The web sink: bodies, events and health in a browser, and for any program that reads JSON from a WebSocket."""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from steadypose.msgs.topics import DIAGNOSTICS, POSE_EVENTS
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.settings import LaunchError, check_host_and_port
from steadypose.nodes.sinks.web.form import to_json

if TYPE_CHECKING:
    from steadypose.nodes.sinks.web.server import WebServer


@dataclass(frozen=True)
class WebSettings:
    """``[web]``: poses, events and health for browsers."""

    host: str = "127.0.0.1"
    """address to serve at. Any other than this machine's own sends poses, which are personal data, and the token in
    clear text over the network; ``ssh -L 8766:localhost:8766 robot`` carries them safely"""
    port: int = 8766
    """of the page and of the WebSocket; 0: any that is free"""
    names: list[str] = field(default_factory=list)
    """other names by which browsers reach this machine, such as kiosk.local; under others nothing is served"""
    token: str = ""
    """that a client must know; empty: one drawn at random, which is part of the address that is printed"""

    def __post_init__(self) -> None:
        check_host_and_port("web", self.host, self.port, least=0)
        if self.token and (len(self.token) < 16 or not all(c.isalnum() or c in "-_" for c in self.token)):
            raise LaunchError(
                f"[web] token: expected 16 or more letters, digits, - and _, got {len(self.token)} characters; "
                "leave it out, and one is made"
            )


TOKEN_FILE = "web_token"
"""beside the sockets, in a folder that only this user reads: a node that is started again has the token that pages
know"""


class WebNode(Node):
    """Serves the newest messages to browsers; the pipeline never waits for it."""

    name = "web"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        self._settings = launch.settings(WebSettings)
        self._server: WebServer | None = None

    @property
    def url(self) -> str:
        """Of the page, with the token; empty before it is served."""
        return self._server.url if self._server else ""

    def work(self) -> None:
        from steadypose.nodes.sinks.web.server import LOCAL_NAMES, WebServer  # not to read a launch file

        s = self._settings
        token = s.token or kept_token(self.launch.transport.ipc_directory / TOKEN_FILE)
        self._server = WebServer(s.host, s.port, s.names, token)
        try:
            print(f"web: {self.url}", flush=True)
            if s.host not in LOCAL_NAMES:
                print(f"web: whoever listens on the network to {s.host} can read the poses and the token", flush=True)
            super().work()
        finally:
            self._server.close()

    def handle(self, topic: str, message: Message) -> None:
        assert self._server
        text = to_json(message)
        if text is not None:
            stream = (
                f"{DIAGNOSTICS}/{message.node}" if isinstance(message, Diagnostics) else f"{topic}/{message.source}"
            )
            self._server.send(stream, text, replaces=topic != POSE_EVENTS)

    def status(self) -> dict[str, str]:
        if self._server is None:
            return {}
        server = self._server
        return {"clients": str(server.clients), "dropped.slow client": str(server.dropped)}


def kept_token(file: Path) -> str:
    """The token in a file that only this user may read; made at the first call."""
    try:
        made = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return file.read_text()
    with open(made, "w") as new:
        new.write(token := secrets.token_urlsafe(24))
    return token
