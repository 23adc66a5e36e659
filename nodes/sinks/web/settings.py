"""The web sink's section of a launch file, and what it needs."""

from __future__ import annotations

from dataclasses import dataclass, field

from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError


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
        if not self.host:
            raise LaunchError("[web] host: expected an address to serve at, such as 127.0.0.1, got none")
        if not 0 <= self.port <= 65535:
            raise LaunchError(f"[web] port: expected 0 (any) to 65535, got {self.port}")
        if self.token and (len(self.token) < 16 or not all(c.isalnum() or c in "-_" for c in self.token)):
            raise LaunchError(
                f"[web] token: expected 16 or more letters, digits, - and _, got {len(self.token)} characters; "
                "leave it out, and one is made"
            )


def check_web(launch: Launch) -> None:
    """Raises:
    LaunchError: the server library is not installed.
    """
    require_extra("web")
