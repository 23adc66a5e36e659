"""Settings on the command line: ``--set delay=2`` is ``prior.delay``, where no other setting ends so."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError, ServerSettings, TransportSettings
from steadypose.nodes.graph.topology import NODES, load
from steadypose.prior.settings import current_key, nearest

PIPELINES = {
    "prior": "steadypose.prior.clean.settings:PriorSettings",
    "trajectory": "steadypose.prior.world.pipeline:TrajectorySettings",
}
"""the sections that the nodes read themselves, and the dataclass of each"""


def full_key(override: str, sections: Mapping[str, type]) -> str:
    """``section.key=value``, of one that may lack the beginning of its name.

    Args:
        override: as it was given.
        sections: of the launch file, and the dataclass of each.

    Raises:
        LaunchError: it is no setting, or the end of several.
    """
    path, separator, value = override.partition("=")
    name = current_key(path.strip())
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
        return f"{name}={value}"  # a table, or a part of one
    near = nearest(name, [*known, *(key.partition(".")[2] for key in known)])
    raise LaunchError(f"--set {name}: no such setting{near}; sections are {', '.join(sections)}")


def check_settings(settings: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises:
    LaunchError: a setting of a pipeline that does not exist, or a value that cannot be; nothing is loaded for that.
    """
    for section, kind in PIPELINES.items():
        try:
            load(kind).from_dict(settings.get(section, {}))
        except ValueError as error:
            raise LaunchError(str(error)) from error


def pipeline_sections() -> dict[str, type]:
    """The sections of the two pipelines, which `clean` runs."""
    return {section: load(kind) for section, kind in PIPELINES.items()}


def in_launch_file(overrides: Sequence[str]) -> list[str]:
    """As `full_key`, of any section of a launch file; one that names its section is left to the launch file's reader.

    Raises:
        LaunchError: as `full_key`.
    """
    declared = {node.section: node.settings for node in NODES.values() if node.section}
    first = {*declared, *(setting.name for setting in fields(Launch))}
    if all(override.partition("=")[0].partition(".")[0].strip() in first for override in overrides):
        return list(overrides)  # without the libraries of every node
    sections = pipeline_sections() | {section: load(kind) for section, kind in declared.items() if kind}
    sections |= {"transport": TransportSettings, "server": ServerSettings}
    return [
        override if override.partition("=")[0].partition(".")[0].strip() in first else full_key(override, sections)
        for override in overrides
    ]


def _keys(kind: type) -> Iterator[str]:
    """The settings of a dataclass, those of nested ones with a dot."""
    for setting in fields(kind):
        inner = setting.default_factory if setting.default_factory is not MISSING else type(setting.default)
        if isinstance(inner, type) and is_dataclass(inner):
            yield from (f"{setting.name}.{key}" for key in _keys(inner))
        else:
            yield setting.name
