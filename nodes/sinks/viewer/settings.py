"""The viewer's section of a launch file, and what it needs."""

from __future__ import annotations

from dataclasses import dataclass

from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError


@dataclass(frozen=True)
class ViewerSettings:
    """``[viewer]``: the picture in the browser."""

    port: int = 9090
    """of the web page; the drawings come on the next one"""

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65534:
            raise LaunchError(f"[viewer] port: expected 1 to 65534, got {self.port}")


def check_viewer(launch: Launch) -> None:
    """Raises:
    LaunchError: Rerun is not installed.
    """
    require_extra("view")
