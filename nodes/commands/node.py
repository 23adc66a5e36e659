"""``steadypose node``: one node in this process."""

from __future__ import annotations

import argparse
import logging
import signal
from collections.abc import Sequence

from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError, nearest
from steadypose.nodes.graph.startup import startup
from steadypose.nodes.graph.topology import NODES, load


def node(arguments: Sequence[str]) -> None:
    """Run one node of a launch file until it is stopped, with SIGTERM or Ctrl-C."""
    parser = argparse.ArgumentParser(prog="steadypose node", description=node.__doc__, allow_abbrev=False)
    parser.add_argument("name", help=", ".join(NODES))
    parser.add_argument("--launch", default="replay", help="a launch file, or the name of one of the project's own")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="any setting of the launch file, over what it says; may be given again",
    )
    given = parser.parse_args(arguments)
    if given.name not in NODES:
        raise LaunchError(f"no node {given.name!r}{nearest(given.name, NODES)}; there are {', '.join(NODES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with startup():
        process = load(NODES[given.name].node)(Launch.read(given.launch, given.set))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: process.stop())
    process.run()
