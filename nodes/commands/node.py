"""``steadypose node``: one node in this process."""

import argparse
import logging
from collections.abc import Sequence

from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.loops import COMPILED, compile_missing
from steadypose.nodes.graph.node import supervisor_id
from steadypose.nodes.graph.process import startup, stop_on_signals
from steadypose.nodes.graph.topology import NODES, load
from steadypose.nodes.settings import LaunchError
from steadypose.prior.settings import nearest


def node(arguments: Sequence[str]) -> None:
    """Run one node of a launch file until SIGTERM or Ctrl-C: `steadypose run` starts each like this.

    Try: steadypose node prior --launch server
    """
    parser = argparse.ArgumentParser(prog="steadypose node", description=node.__doc__, allow_abbrev=False)
    parser.add_argument("name", help=", ".join(NODES))
    parser.add_argument("--launch", default="replay", help="a launch file, or the name of a bundled one")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override a setting of the launch file; repeatable",
    )
    given = parser.parse_args(arguments)
    launch = Launch.read(given.launch, given.set)
    if given.name not in NODES:
        raise LaunchError(f"no node {given.name!r}{nearest(given.name, NODES)}; there are {', '.join(NODES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if given.name in COMPILED and not supervisor_id():  # else the run has done it
        compile_missing(logging.info)
    with startup():
        process = load(NODES[given.name].node)(launch)
    stop_on_signals(lambda *_: process.stop())
    process.run()
