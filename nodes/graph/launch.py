"""Launch files: which nodes to start, with which settings, and how they reach each other.

A launch file is TOML with one section per subject, and is read strictly: an unknown key is an error that names the
nearest known one. Every section is optional; with the defaults the nodes run but play no input. `nodes.graph.topology`
declares the sections of nodes. On the command line, ``--set delay=2`` means ``prior.delay``, because no other setting's
name ends in ``delay``.
"""

import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Any, TypeVar

from steadypose import PACKAGE
from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.nodes.graph.topology import (
    NODES,
    POSE_NODES,
    Delivery,
    NodeDeclaration,
    ServerSettings,
    TransportSettings,
    add_node,
    load,
)
from steadypose.nodes.settings import LaunchError, launch_errors, load_plugin, resolve_paths
from steadypose.prior.body.layouts import add_layouts
from steadypose.prior.models.weights import check_weights
from steadypose.prior.settings import build_settings, nearest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Settings = TypeVar("Settings")

TOO_DEEP = "lists or tables within lists, hundreds deep: expected settings, which are two or three deep"


@dataclass(frozen=True)
class _EveryLaunch:
    """The settings of a launch file that are common to all nodes."""

    nodes: list[str] = field(default_factory=lambda: list(POSE_NODES))
    transport: TransportSettings = field(default_factory=TransportSettings)
    server: ServerSettings = field(default_factory=ServerSettings)
    skeletons: dict[str, Any] = field(default_factory=dict)  # custom joint layouts (`prior.body.layouts`)
    plugins: dict[str, Any] = field(default_factory=dict)
    """nodes of other packages: node name to the ``module:name`` of its `NodeDeclaration`"""


@dataclass(frozen=True)
class Launch(_EveryLaunch):
    """A parsed launch file with the command line's overrides applied."""

    sections: Mapping[str, Any] = field(default_factory=dict)
    """the nodes' sections that the file contains; read them with `settings` and `table`"""

    def __post_init__(self) -> None:
        if not self.nodes:
            raise LaunchError(f"nodes: expected one or more of {', '.join(NODES)}, got none")
        for node in self.nodes:
            if node not in NODES:
                raise LaunchError(f"nodes: expected some of {', '.join(NODES)}, got {node!r}{nearest(node, NODES)}")
        for node, count in Counter(self.nodes).items():
            if count > 1:
                raise LaunchError(f"nodes names {node!r} {count} times: expected each node once")
        if self.server.clients and "pose_input" in self.nodes:
            raise LaunchError("[server] clients have their own pose_input: expected nodes without it, such as prior")
        if self.server.clients and self.transport.lossless:
            raise LaunchError("[server] clients do not wait: expected [transport] lossless = false")

    @classmethod
    def read(cls, path: str | Path, overrides: Iterable[str] = ()) -> "Launch":
        """Read a launch file: a path, or the name of a bundled one (``replay``, ``oak``).

        ``overrides``, each ``section.key=value``, replace the file's values. A value is TOML, or plain text if it is
        not valid TOML. Raises LaunchError if the file does not exist or is not TOML, a key is unknown, or a value of
        the wrong type.
        """
        file = find(path)
        table = read_toml(file)
        resolve_paths(_layout(table), table, file.parent)
        with launch_errors():
            for override in overrides:
                apply_override(table, override)
            _add_plugins(table.get("plugins", {}))
            layout = _layout(table)
            for key in table.keys() - {setting.name for setting in fields(layout)}:
                if places := [f"[{name}] {key}" for name, kind in _typed_sections().items() if key in {*_keys(kind)}]:
                    raise LaunchError(f"{key} is in no section: expected {' or '.join(places)}")
            whole = build_settings(layout, table, "")
            sections = {name: getattr(whole, name) for name in table.keys() & _sections().keys()}
            add_layouts(whole.skeletons)
            return cls(whole.nodes, whole.transport, whole.server, whole.skeletons, whole.plugins, sections)

    def settings(self, kind: type[Settings]) -> Settings:
        """The settings of the node that declares this dataclass: its section in the file, or the defaults."""
        section = next(n.section for n in NODES.values() if n.settings == f"{kind.__module__}:{kind.__qualname__}")
        found = self.sections.get(section) or kind()
        assert isinstance(found, kind)
        return found

    def table(self, section: str) -> Mapping[str, Any]:
        """The raw table of a section that its node parses itself; empty if the file has none."""
        return self.sections.get(section, {})

    def addresses(self, node: str) -> list[str]:
        """The addresses at which ``node`` publishes: one, or those of all clients."""
        if node == "pose_input" and self.server.clients:
            return self.server.clients
        return [self.transport.endpoint(node)]

    def reliable_subscribers(self, node: str) -> frozenset[str]:
        """The nodes of this launch that must not miss a pose of ``node``, and for which ``node`` therefore waits."""
        if not self.transport.lossless:
            return frozenset()
        return frozenset(
            name
            for name in self.nodes
            if NODES[name].delivery is not Delivery.BEST_EFFORT
            and any(topic != DIAGNOSTICS for topic in NODES[name].subscribes.get(node, ()))
        )


def _add_plugins(table: Any) -> None:
    for name, reference in table.items() if isinstance(table, dict) else ():
        declared = load_plugin(f"[plugins] {name}", reference)
        if not isinstance(declared, NodeDeclaration):
            raise LaunchError(f"[plugins] {name}: expected a NodeDeclaration, got {type(declared).__name__}")
        if NODES.get(name, declared) is not declared:
            raise LaunchError(f"[plugins] {name}: there is a node of that name already")
        add_node(name, declared)


def _sections() -> dict[str, str]:
    """Section name to its settings dataclass as ``module:name``, for all nodes."""
    return {declared.section: declared.settings for declared in NODES.values() if declared.section}


def _layout(table: Mapping[str, Any]) -> type:
    """The dataclass of a launch file. It imports a section's settings only if the file contains the section."""
    kinds = {name: load(kind) if kind and name in table else dict for name, kind in _sections().items()}
    sections = [(name, kind, field(default_factory=kind)) for name, kind in kinds.items()]
    return make_dataclass("LaunchFile", sections, bases=(_EveryLaunch,), frozen=True)


def read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML file. Raises LaunchError if the file cannot be read, or is not TOML."""
    try:
        return _parse(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise LaunchError(f"{file} is not TOML: {error}") from error
    except RecursionError as error:
        raise LaunchError(f"{file}: {TOO_DEEP}") from error
    except OSError as error:
        raise LaunchError(f"{file} cannot be read: {error.strerror}") from error


def _parse(text: str) -> dict[str, Any]:
    """Parse TOML. Raises ValueError if it is not TOML, or has an integer of more than TOML's 64 bits."""
    table = tomllib.loads(text)
    _check_integers("", table)
    return table


def _check_integers(name: str, value: Any) -> None:
    """Check the integers in a value of TOML: Python's have any length, but beyond 64 bits no float."""
    if isinstance(value, dict):
        for key, item in value.items():
            _check_integers(f"{name}.{key}".lstrip("."), item)
    elif isinstance(value, list):
        for item in value:
            _check_integers(name, item)
    elif isinstance(value, int) and value.bit_length() > 63:
        raise ValueError(f"{name}: expected an integer of at most 64 bits, got one of {value.bit_length()}")


def bundled(*parts: str) -> Path:
    """A path inside the package, such as of a launch file. Raises LaunchError if the installation is damaged."""
    path = PACKAGE.joinpath(*parts)
    if not path.exists():
        raise LaunchError(f"{path} does not exist, but is part of steadypose: reinstall it")
    return path


def find(launch: str | Path) -> Path:
    """The launch file at a path, or the bundled launch file of that name."""
    path = Path(launch).expanduser()
    if path.is_file():
        return path.resolve()
    own = sorted(file.stem for file in bundled("launch").glob("*.toml"))
    hint = nearest(path.stem, own) if path.parent == Path() else ""
    if path.parent != Path() or path.suffix:
        raise LaunchError(f"no launch file at {path}{hint}")
    if path.name not in own:
        raise LaunchError(f"no launch file {path.name!r}{hint}; there are {', '.join(own)}, or give a path")
    return bundled("launch", f"{path.name}.toml")


def apply_override(table: dict[str, Any], override: str) -> None:
    """Set one ``section.key=value`` in a table of settings, and create missing sections.

    Raises LaunchError if there is no ``=``, or a part of the path is a value, not a section.
    """
    path, separator, text = override.partition("=")
    if not separator or not path.strip():
        raise LaunchError(f"expected section.key=value, got {override!r}")
    path = path.strip()
    try:
        value = _parse(f"value = {text}")["value"]
    except ValueError:
        value = text
    except RecursionError as error:
        raise LaunchError(f"{path}: {TOO_DEEP}") from error
    *sections, key = (part.strip() for part in path.split("."))
    for section in sections:
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            raise LaunchError(f"cannot set {path}: {section} is a value, not a section")
    table[key] = value


PIPELINES = ("prior", "trajectory", "events")  # sections of what `clean` runs
_SECTIONS_OF_ALL = {
    "transport": "steadypose.nodes.graph.topology:TransportSettings",
    "server": "steadypose.nodes.graph.topology:ServerSettings",
}
"""Settings dataclass (``module:name``) of each section that belongs to no node."""


def full_key(override: str, sections: Mapping[str, type]) -> str:
    """Complete an abbreviated override: ``delay=2`` becomes ``prior.delay=2``.

    ``sections`` has the settings dataclass of each section. Raises LaunchError if no setting, or several, have this
    name or ending.
    """
    path, separator, value = override.partition("=")
    name = path.strip()
    if not separator or not name:
        raise LaunchError(f"--set: expected section.key=value, got {override!r}")
    known = [f"{section}.{key}" for section, kind in sections.items() for key in _keys(kind)]
    if name in known:
        return f"{name}={value}"
    found = [key for key in known if key.endswith(f".{name}")]
    if len(found) == 1:
        return f"{found[0]}={value}"
    if found:
        more = f" and {len(found) - 6} more" if len(found) > 6 else ""
        raise LaunchError(f"--set {name}: expected one setting, got the end of {', '.join(found[:6])}{more}")
    if any(key.startswith(f"{name}.") or name.startswith(f"{key}.") for key in known):
        return f"{name}={value}"  # a whole table, or a key inside a free-form table
    near = nearest(name, [*known, *(key.partition(".")[2] for key in known)])
    raise LaunchError(f"--set {name}: no such setting{near or '; sections are ' + ', '.join(sections)}")


def check_settings(settings: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise LaunchError for wrong settings of `PIPELINES`, or missing weights, without loading them."""
    with launch_errors():
        for section, kind in pipeline_sections().items():
            check_weights(build_settings(kind, settings.get(section, {}), section))


def check_weights_of(launch: Launch) -> None:
    """Raise LaunchError, before nodes start, if weights of `PIPELINES` do not exist."""
    with launch_errors():
        for section in launch.sections.keys() & {*PIPELINES}:
            check_weights(launch.sections[section])


def pipeline_sections() -> dict[str, type]:
    """Settings dataclasses of `PIPELINES`, by section."""
    return {section: load(NODES[section].settings) for section in PIPELINES}


def in_launch_file(launch: str | Path, overrides: Sequence[str]) -> list[str]:
    """Apply `full_key` over all sections of a launch file. It imports only what it needs. Raises as `full_key`."""
    if overrides:
        _add_plugins(read_toml(find(launch)).get("plugins", {}))
    kinds = {setting.name: "" for setting in fields(_EveryLaunch)} | _SECTIONS_OF_ALL | _sections()
    full = []
    for override in overrides:
        first = override.partition("=")[0].strip().partition(".")[0]
        if kinds.get(first) == "":  # free-form
            full.append(override)
        else:
            full.append(full_key(override, {first: load(kinds[first])} if first in kinds else _typed_sections()))
    return full


def _typed_sections() -> dict[str, type]:
    """Settings dataclasses of all sections that have one. This imports the libraries of all nodes."""
    return {name: load(kind) for name, kind in (_SECTIONS_OF_ALL | _sections()).items() if kind}


def _keys(kind: type) -> Iterator[str]:
    """The field names of a dataclass; nested fields are joined by dots."""
    for setting in fields(kind):
        inner = setting.default_factory if setting.default_factory is not MISSING else type(setting.default)
        if isinstance(inner, type) and is_dataclass(inner):
            yield from (f"{setting.name}.{key}" for key in _keys(inner))
        else:
            yield setting.name
