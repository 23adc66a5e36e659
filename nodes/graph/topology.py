"""The graph: every node, declared once, where it publishes, and who may subscribe.

A new node is a class and one entry in `NODES`.

An entry names classes as ``module:name`` instead of importing them: to read a launch file, or to show the help of a
command, takes none of the libraries that a node works with.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from types import MappingProxyType
from typing import Any

from steadypose.msgs.security import Keys, load_keys, local_directory, make_private
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.nodes.settings import LaunchError, check_addresses, path_setting
from steadypose.prior.settings import nearest


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


@dataclass(frozen=True)
class TransportSettings:
    """``[transport]``: how messages travel."""

    directory: str = path_setting()
    """of the ipc sockets; empty: ``steadypose`` in the user's runtime directory"""
    endpoints: dict[str, str] = field(default_factory=dict)
    """node to address (``tcp://192.168.1.5:7101``); a node not named here has an ipc socket in ``directory``"""
    keys: str = path_setting()
    """directory of CurveZMQ keys, needed where an address is not local"""
    lossless: bool = True
    """a recording can wait, a camera cannot: true lets a node hold up its source while it is slow, or not there yet;
    false drops its oldest frames"""
    queue: int = 8
    """not lossless: frames a node keeps at most when it falls behind; once the oldest is late, all but the newest go"""
    lifespan_s: float = 1.0
    """not lossless: age of a message, from its sending on, from which a node drops it instead of taking it for new"""
    clear_text: bool = False
    """whether to publish and subscribe to other machines without keys: others on the network can read and forge
    poses"""

    def __post_init__(self) -> None:
        for node, address in self.endpoints.items():
            if not isinstance(address, str):
                raise LaunchError(f"[transport.endpoints] {node}: expected an address, got {address!r}")
            if node not in NODES:
                raise LaunchError(
                    f"[transport.endpoints] names {node!r}, which is no node{nearest(node, NODES)}; "
                    f"nodes are {', '.join(NODES)}"
                )
        if not self.lifespan_s > 0:
            raise LaunchError(f"[transport] lifespan_s: expected more than 0, got {self.lifespan_s}")
        if self.queue < 1:
            raise LaunchError(f"[transport] queue: expected 1 frame or more, got {self.queue}")

    def endpoint(self, node: str) -> str:
        """The address ``node`` publishes at."""
        if node in self.endpoints:
            return self.endpoints[node]
        return f"ipc://{self.ipc_directory / node}"

    def curve_keys(self) -> Keys | None:
        """The CurveZMQ keys asked for, or None.

        Raises:
            LaunchError: they are not there, or not safe.
        """
        try:
            return load_keys(self.keys) if self.keys else None
        except ValueError as error:
            raise LaunchError(str(error)) from error

    @property
    def ipc_directory(self) -> Path:
        """Where the ipc sockets are."""
        return Path(self.directory) if self.directory else local_directory()

    def make_ipc_directory(self) -> Path:
        """Make the directory of the sockets, accessible to this user only.

        Raises:
            TransportError: it is there, and others may write to it.
        """
        make_private(self.ipc_directory)
        return self.ipc_directory


@dataclass(frozen=True)
class ServerSettings:
    """``[server]``: one prior for several clients, whose input nodes run on machines of their own."""

    clients: list[str] = field(default_factory=list)
    """addresses of their input nodes (``tcp://192.168.1.21:7101``), subscribed to in place of an own one"""

    def __post_init__(self) -> None:
        check_addresses("[server] clients", self.clients)
