"""The viewer's section of a launch file, and what it needs."""

from __future__ import annotations

from dataclasses import dataclass

from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError


@dataclass(frozen=True)
class ViewerSettings:
    """``[viewer]``: the picture in the browser."""

    host: str = "127.0.0.1"
    """address to serve at. Any other than this machine's own shows people in a room to whoever listens on the network:
    ``ssh -L 9090:localhost:9090 robot`` carries the picture safely"""
    port: int = 9090
    """of the web page and the drawings"""

    def __post_init__(self) -> None:
        if not self.host:
            raise LaunchError("[viewer] host: expected an address to serve at, such as 127.0.0.1, got none")
        if not 1 <= self.port <= 65535:
            raise LaunchError(f"[viewer] port: expected 1 to 65535, got {self.port}")


def check_viewer(launch: Launch) -> None:
    """Raises:
    LaunchError: Rerun is not installed.
    """
    require_extra("view")
