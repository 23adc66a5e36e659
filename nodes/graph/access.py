"""Where nodes publish, and who may subscribe: addresses, sockets of this machine, CurveZMQ keys."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from steadypose.msgs.addresses import local_directory, make_private
from steadypose.msgs.keys import Keys, load_keys
from steadypose.nodes.graph.settings import LaunchError, check_addresses, path_setting
from steadypose.nodes.graph.topology import NODES
from steadypose.prior.settings import nearest


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
    """``[server]``: one prior for several kiosks, whose input nodes run on machines of their own."""

    kiosks: list[str] = field(default_factory=list)
    """addresses of their input nodes (``tcp://192.168.1.21:7101``), subscribed to in place of an own one"""

    def __post_init__(self) -> None:
        check_addresses("[server] kiosks", self.kiosks)
