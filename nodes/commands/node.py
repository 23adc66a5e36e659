"""``steadypose node``: one node in this process."""

from __future__ import annotations

import importlib
import logging
import signal
from typing import Annotated

import tyro

from steadypose.nodes.graph.launch import LISTENS, Launch, LaunchError, nearest

#: name: the class that is the node
CLASSES = {
    "pose_input": "steadypose.nodes.sources.pose_input:PoseInputNode",
    "prior": "steadypose.nodes.graph.prior_node:PriorNode",
    "trajectory": "steadypose.nodes.graph.trajectory_node:TrajectoryNode",
    "ros2_bridge": "steadypose.nodes.sinks.ros2.bridge:Ros2BridgeNode",
    "recorder": "steadypose.nodes.sinks.recorder:RecorderNode",
    "viewer": "steadypose.nodes.sinks.viewer:ViewerNode",
}


def node(
    name: str,
    launch: str = "replay",
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="SECTION.KEY=VALUE")] = (),
) -> None:
    """Run one node of a launch file until it is stopped, with SIGTERM or Ctrl-C.

    Args:
        name: pose_input, prior, trajectory, ros2_bridge, recorder or viewer.
        launch: a launch file, or the name of one of the project's own.
        settings: any setting of the launch file, over what it says. May be given again.
    """
    if name not in CLASSES:
        raise LaunchError(f"no node {name!r}{nearest(name, LISTENS)}; there are {', '.join(CLASSES)}")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    module, kind = CLASSES[name].split(":")
    process = getattr(importlib.import_module(module), kind)(Launch.read(launch, settings))
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: process.stop())
    process.run()
