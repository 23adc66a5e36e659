"""The graph: every node, declared once. A new node is a class and one entry in `NODES`.

An entry names classes as ``module:name`` instead of importing them: to read a launch file, or to show the help of a
command, takes none of the libraries that a node works with.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from types import MappingProxyType
from typing import Any

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD


class Delivery(Enum):
    """What becomes of messages for a node that falls behind."""

    AS_LAUNCHED = auto()
    """``[transport] lossless`` says: the publisher waits, or the subscriber drops its oldest frames"""
    RELIABLE = auto()
    """nothing is dropped: the queue has no limit, and with ``lossless`` the publisher waits as well"""
    BEST_EFFORT = auto()
    """the oldest frames are dropped; no publisher ever waits for this node"""


@dataclass(frozen=True)
class NodeDeclaration:
    """One node of the graph."""

    node: str
    """its class, a `Node`, as ``module:name``"""
    publishes: tuple[str, ...] = ()
    """topics, the one of its stream first; ``diagnostics``, which every node publishes, is not among them"""
    subscribes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """to each publishing node, the topics taken from there"""
    section: str = ""
    """of a launch file, with its settings; empty: it has none"""
    settings: str = ""
    """the dataclass of the section, as ``module:name``; empty: a table that the node itself reads, so that reading a
    launch file takes none of its libraries"""
    delivery: Delivery = Delivery.AS_LAUNCHED
    optional: bool = False
    """poses go on without it: a run whose optional node cannot run does"""
    extra: str = ""
    """of `extras.EXTRAS`, that it needs; empty: none"""
    preflight: str = ""
    """a function of the `Launch`, as ``module:name``, that raises what would keep the node from starting; or empty"""

    @property
    def stream(self) -> str | None:
        """The topic of its stream; None for a node that publishes no poses."""
        return self.publishes[0] if self.publishes else None

    @property
    def topics(self) -> frozenset[str]:
        """All topics that it subscribes to."""
        return frozenset(topic for topics in self.subscribes.values() for topic in topics)


_POSES = {"trajectory": (POSE_WORLD, DIAGNOSTICS), "pose_input": (DIAGNOSTICS,)}
_ALL_STREAMS = {
    "pose_input": (POSE_RAW, POSE_TRUTH, DIAGNOSTICS),
    "prior": (POSE_CLEAN, DIAGNOSTICS),
    "trajectory": (POSE_WORLD, DIAGNOSTICS),
}
_IN_ROS = {
    "events": (POSE_EVENTS, DIAGNOSTICS),
    "trajectory": (POSE_WORLD, DIAGNOSTICS),
    "prior": (POSE_CLEAN, DIAGNOSTICS),
    "pose_input": (POSE_RAW, DIAGNOSTICS),
}

_NODES: dict[str, NodeDeclaration] = {
    "pose_input": NodeDeclaration(
        node="steadypose.nodes.sources.pose_input:PoseInputNode",
        publishes=(POSE_RAW, POSE_TRUTH),
        section="input",
        settings="steadypose.nodes.sources.registry:InputSettings",
        preflight="steadypose.nodes.sources.registry:check_input",
    ),
    "prior": NodeDeclaration(
        node="steadypose.nodes.graph.prior_node:PriorNode",
        publishes=(POSE_CLEAN,),
        subscribes={"pose_input": (POSE_RAW, DIAGNOSTICS)},
        section="prior",
    ),
    "trajectory": NodeDeclaration(
        node="steadypose.nodes.graph.trajectory_node:TrajectoryNode",
        publishes=(POSE_WORLD,),
        subscribes={"prior": (POSE_CLEAN,), "pose_input": (DIAGNOSTICS,)},
        section="trajectory",
    ),
    "events": NodeDeclaration(
        node="steadypose.nodes.graph.events_node:EventsNode",
        publishes=(POSE_EVENTS,),
        subscribes={"trajectory": (POSE_WORLD,), "prior": (POSE_CLEAN,), "pose_input": (DIAGNOSTICS,)},
        section="events",
        settings="steadypose.prior.events.detector:EventSettings",
        optional=True,
    ),
    "ros2_bridge": NodeDeclaration(
        node="steadypose.nodes.sinks.ros2.bridge:Ros2BridgeNode",
        subscribes=_IN_ROS,
        section="ros2",
        settings="steadypose.nodes.sinks.ros2:Ros2BridgeSettings",
        preflight="steadypose.nodes.sinks.ros2.bridge:check_ros2",
    ),
    "foxglove": NodeDeclaration(
        node="steadypose.nodes.sinks.ros2.bridge:FoxgloveNode",
        subscribes=_IN_ROS,
        section="foxglove",
        settings="steadypose.nodes.sinks.ros2:FoxgloveSettings",
        delivery=Delivery.BEST_EFFORT,
        extra="foxglove",
    ),
    "web": NodeDeclaration(
        node="steadypose.nodes.sinks.web.node:WebNode",
        subscribes={"events": (POSE_EVENTS, DIAGNOSTICS), "prior": (DIAGNOSTICS,), **_POSES},
        section="web",
        settings="steadypose.nodes.sinks.web.node:WebSettings",
        delivery=Delivery.BEST_EFFORT,
        extra="web",
    ),
    "retarget": NodeDeclaration(
        node="steadypose.nodes.sinks.retarget:RetargetNode",
        subscribes=_POSES,
        section="retarget",
        settings="steadypose.nodes.sinks.retarget:RetargetSettings",
        delivery=Delivery.BEST_EFFORT,
        extra="retarget",
        preflight="steadypose.nodes.sinks.retarget:check_retarget",
    ),
    "vmc": NodeDeclaration(
        node="steadypose.nodes.sinks.datagrams:VmcNode",
        subscribes=_POSES,
        section="vmc",
        settings="steadypose.nodes.sinks.datagrams:VmcSettings",
        delivery=Delivery.BEST_EFFORT,
        extra="vmc",
    ),
    "viewer": NodeDeclaration(
        node="steadypose.nodes.sinks.viewer.node:ViewerNode",
        subscribes=_ALL_STREAMS,
        section="viewer",
        settings="steadypose.nodes.sinks.viewer.node:ViewerSettings",
        delivery=Delivery.BEST_EFFORT,
        optional=True,
        extra="view",
    ),
    "recorder": NodeDeclaration(
        node="steadypose.nodes.sinks.recorder:RecorderNode",
        subscribes={**_ALL_STREAMS, "events": (POSE_EVENTS, DIAGNOSTICS)},
        section="recorder",
        settings="steadypose.nodes.sinks.recorder:RecorderSettings",
        delivery=Delivery.RELIABLE,
        optional=True,
        preflight="steadypose.nodes.sinks.recorder:check_recorder",
    ),
}
NODES: Mapping[str, NodeDeclaration] = MappingProxyType(_NODES)
"""by name, in the order in which they are stopped: with the stream, so that what is on its way arrives, and the
recorder has it; then those of other packages"""

POSE_NODES = tuple(name for name, declared in NODES.items() if declared.publishes and not declared.optional)
"""the publishers of poses, which run unless a launch file says otherwise"""


def add_node(name: str, declared: NodeDeclaration) -> None:
    """Make a node of another package known, to all of this process."""
    _NODES[name] = declared


def publishers(topic: str) -> list[str]:
    """The nodes to listen to for a topic: for ``diagnostics`` those that publish poses."""
    if topic == DIAGNOSTICS:
        return list(POSE_NODES)
    return [name for name, declared in NODES.items() if topic in declared.publishes]


def load(reference: str) -> Any:
    """What a declaration names as ``module:name``."""
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)
