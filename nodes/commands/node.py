"""``steadypose node``: one node in this process."""

from __future__ import annotations

import logging
import signal
from typing import Annotated

import tyro

from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError, nearest
from steadypose.nodes.graph.topology import NODES, load


def node(
    name: str,
    launch: str = "replay",
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="SECTION.KEY=VALUE")] = (),
) -> None:
    """Run one node of a launch file until it is stopped, with SIGTERM or Ctrl-C.

    Args:
        name: pose_input, prior, trajectory, ros2_bridge, foxglove, recorder or viewer.
        launch: a launch file, or the name of one of the project's own.
        settings: any setting of the launch file, over what it says. May be given again.
    """
    if name not in NODES:
        raise LaunchError(f"no node {name!r}{nearest(name, NODES)}; there are {', '.join(NODES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    process = load(NODES[name].node)(Launch.read(launch, settings))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: process.stop())
    process.run()
