"""The graph: declares each node once, with the topics that it publishes and subscribes to.

To add a node, write its class and one entry in `NODES`.

An entry names classes as ``module:name`` instead of importing them, so that reading a launch file or showing a
command's help imports none of the nodes' libraries.
"""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, auto
from pathlib import Path
from types import MappingProxyType
from typing import Any

from steadypose.msgs.security import Keys, load_keys, local_directory, make_private
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.nodes.settings import LaunchError, path_setting
from steadypose.prior.settings import nearest


class Delivery(Enum):
    """What happens to messages when a node falls behind."""

    AS_LAUNCHED = auto()
    """``[transport] lossless`` decides: true makes the publisher wait, false makes the node drop its oldest frames"""
    RELIABLE = auto()
    """nothing is dropped: the queue is unbounded, and with ``lossless`` the publisher waits as well"""
    BEST_EFFORT = auto()
    """the oldest frames are dropped; no publisher waits for this node"""


@dataclass(frozen=True)
class NodeDeclaration:
    """One node of the graph."""

    node: str
    """the node's class, a subclass of `Node`, as ``module:name``"""
    publishes: tuple[str, ...] = ()
    """published topics, the main stream first; without ``diagnostics``, which every node publishes"""
    subscribes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """publishing node to the topics subscribed to there"""
    section: str = ""
    """the launch file's section with the node's settings; empty if it has none"""
    settings: str = ""
    """the section's dataclass as ``module:name``; empty if the node parses the table itself, so that reading a launch
    file imports none of its libraries"""
    delivery: Delivery = Delivery.AS_LAUNCHED
    optional: bool = False
    """whether a run continues when this node cannot run"""
    extra: str = ""
    """the extra in `extras.EXTRAS` that the node needs; empty if none"""
    preflight: str = ""
    """a function of the `Launch`, as ``module:name``, that raises if the node could not start; empty if none"""

    @property
    def stream(self) -> str | None:
        """The node's main topic; None if it publishes only diagnostics."""
        return self.publishes[0] if self.publishes else None

    @property
    def topics(self) -> frozenset[str]:
        """All topics that the node subscribes to."""
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
        preflight="steadypose.nodes.sources.registry:open_input",
    ),
    "prior": NodeDeclaration(
        node="steadypose.nodes.graph.prior_node:PriorNode",
        publishes=(POSE_CLEAN,),
        subscribes={"pose_input": (POSE_RAW, DIAGNOSTICS)},
        section="prior",
        settings="steadypose.prior.clean.settings:PriorSettings",
        preflight="steadypose.nodes.graph.launch:check_weights_of",
    ),
    "trajectory": NodeDeclaration(
        node="steadypose.nodes.graph.trajectory_node:TrajectoryNode",
        publishes=(POSE_WORLD,),
        subscribes={"prior": (POSE_CLEAN,), "pose_input": (DIAGNOSTICS,)},
        section="trajectory",
        settings="steadypose.prior.world.settings:TrajectorySettings",
        preflight="steadypose.nodes.graph.launch:check_weights_of",
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
        settings="steadypose.nodes.sinks.ros2.bridge:Ros2BridgeSettings",
        preflight="steadypose.nodes.sinks.ros2.bridge:check_ros2",
    ),
    "foxglove": NodeDeclaration(
        node="steadypose.nodes.sinks.ros2.bridge:FoxgloveNode",
        subscribes=_IN_ROS,
        section="foxglove",
        settings="steadypose.nodes.sinks.ros2.bridge:FoxgloveSettings",
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
"""Declarations by node name, in the order in which nodes are stopped, those of other packages last.

This is the order of the stream, so that messages in flight still arrive and are recorded."""
POSE_NODES = tuple(name for name, declared in NODES.items() if declared.publishes and not declared.optional)
"""Names of the nodes that publish poses. They run unless a launch file names others."""


def add_node(name: str, declared: NodeDeclaration) -> None:
    """Register a node of another package in this process."""
    _NODES[name] = declared


def publishers(topic: str) -> list[str]:
    """Names of the nodes that publish a topic; for ``diagnostics``, those that publish poses."""
    if topic == DIAGNOSTICS:
        return list(POSE_NODES)
    return [name for name, declared in NODES.items() if topic in declared.publishes]


def load(reference: str) -> Any:
    """Import the object that a declaration names as ``module:name``."""
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)


@dataclass(frozen=True)
class TransportSettings:
    """``[transport]``: how messages travel between nodes."""

    directory: str = path_setting()
    """directory of the ipc sockets; empty: ``steadypose`` in the user's runtime directory"""
    endpoints: dict[str, str] = field(default_factory=dict)
    """node to address (``tcp://192.168.1.5:7101``); any other node has an ipc socket in ``directory``"""
    keys: str = path_setting()
    """directory of CurveZMQ keys; required if an address is not local"""
    lossless: bool = True
    """true, for a recording: a slow or missing node makes its source wait; false, for a camera: a slow node drops its
    oldest frames"""
    queue: int = 8
    """without ``lossless``: largest number of frames in a node's queue; once the oldest is late, only the newest is
    kept"""
    lifespan_s: float = 1.0
    """without ``lossless``: age since sending at which a node drops a message, seconds"""
    clear_text: bool = False
    """whether to publish and subscribe to other machines without keys; others on the network can then read and forge
    poses"""

    def __post_init__(self) -> None:
        taken: dict[str, str] = {}
        for node, address in self.endpoints.items():
            if node not in NODES:
                got = f"{node!r}{nearest(node, NODES)}"
                raise LaunchError(f"[transport.endpoints] expected some of {', '.join(NODES)}, got {got}")
            if (other := taken.setdefault(address, node)) != node and not address.endswith(":*"):
                got = f"{address}, as for {other}"
                raise LaunchError(f"[transport.endpoints] {node}: expected an address of its own, got {got}")
        if not self.lifespan_s > 0:
            raise LaunchError(f"[transport] lifespan_s: expected more than 0, got {self.lifespan_s}")
        if self.queue < 1:
            raise LaunchError(f"[transport] queue: expected 1 frame or more, got {self.queue}")

    def endpoint(self, node: str) -> str:
        """The address at which ``node`` publishes."""
        return self.endpoints[node] if node in self.endpoints else f"ipc://{self.ipc_directory / node}"

    def curve_keys(self) -> Keys | None:
        """The configured CurveZMQ keys; None if none are. Raises TransportError if they cannot be used."""
        return load_keys(self.keys) if self.keys else None

    @property
    def ipc_directory(self) -> Path:
        """The directory of the ipc sockets."""
        return Path(self.directory) if self.directory else local_directory()

    def make_ipc_directory(self) -> Path:
        """Create the sockets' directory for this user only. Raises TransportError if others may write to it."""
        make_private(self.ipc_directory)
        return self.ipc_directory


@dataclass(frozen=True)
class ServerSettings:
    """``[server]``: one prior for several clients, whose input nodes run on other machines."""

    clients: list[str] = field(default_factory=list)
    """addresses of the clients' input nodes (``tcp://192.168.1.21:7101``), which replace a local input node"""
