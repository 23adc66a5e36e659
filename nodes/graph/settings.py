"""What all launch files have: their error, paths and plugins; where nodes publish, and who may subscribe."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from steadypose.msgs.security import Keys, load_keys, local_directory, make_private
from steadypose.nodes.graph.topology import NODES
from steadypose.prior.settings import nearest

_PATH = "path"


class LaunchError(ValueError):
    """A launch file, or a setting given on the command line, cannot be used. The text says what to do."""


def path_setting(metadata: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """A field of a settings dataclass that is a path: a relative one in a launch file starts at that file."""
    return field(default="", metadata={_PATH: True, **metadata})


def resolve_paths(settings: type, table: dict[str, Any], folder: Path) -> None:
    """Make the paths in a launch file's table absolute, in place.

    Args:
        settings: the dataclass of the table; nested ones are those of its sections.
        table: as TOML gives it.
        folder: where relative paths start.
    """
    for setting in fields(settings):
        value = table.get(setting.name)
        if setting.metadata.get(_PATH) and isinstance(value, str) and value:
            table[setting.name] = str(folder / Path(value).expanduser())
        elif isinstance(section := setting.default_factory, type) and is_dataclass(section) and isinstance(value, dict):
            resolve_paths(section, value, folder)


def check_addresses(setting: str, addresses: list[str]) -> None:
    """Raises:
    LaunchError: one of ``addresses`` is no text; the setting is named in it.
    """
    for address in addresses:
        if not isinstance(address, str):
            raise LaunchError(f"{setting}: expected addresses such as tcp://192.168.1.21:7111, got {address!r}")


def check_host_and_port(section: str, host: str, port: int, *, least: int = 1) -> None:
    """Raises:
    LaunchError: there is no host, or no such port; 0, where it is allowed, is any that is free.
    """
    if not host:
        raise LaunchError(f"[{section}] host: expected an address, such as 127.0.0.1, got none")
    if not least <= port <= 65535:
        raise LaunchError(f"[{section}] port: expected {least}{'' if least else ' (any)'} to 65535, got {port}")


def load_plugin(setting: str, reference: Any) -> Any:
    """What a launch file names as ``module:name`` of an installed package.

    Raises:
        LaunchError: it is no such name, or cannot be imported.
    """
    module, separator, name = reference.partition(":") if isinstance(reference, str) else ("", "", "")
    if not (module and separator and name):
        raise LaunchError(f"{setting}: expected module:name, got {reference!r}")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise LaunchError(
            f"{setting}: {reference} cannot be imported: {error}; install its package beside steadypose"
        ) from error


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
