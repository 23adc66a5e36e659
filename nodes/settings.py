"""Shared by the settings of all packages: their error, and checks of paths, addresses and plugins."""

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import Field, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from steadypose import PACKAGE
from steadypose.prior.settings import MODEL

_PATH = "path"
STREAMS = "sim_data"  # folder of the bundled streams


class LaunchError(ValueError):
    """A launch file or a command line's setting that cannot be used. The text says what to do."""


@contextmanager
def launch_errors() -> Iterator[None]:
    """Raise invalid settings and missing weights as `LaunchError`."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        raise LaunchError(str(error)) from error


def path_setting(bundled: str = "") -> Any:
    """A field for a path. A relative path in a launch file is relative to that file.

    Files of the package's folder ``bundled`` can be given by name alone, see `located`.
    """
    return field(default="", metadata={_PATH: bundled})


def located(name: str, folder: Path, bundled: str) -> Path:
    """The path of a file: ``name`` (``~`` is the home folder) relative to ``folder``, or else the file of that name in
    the package's folder ``bundled``, if that is not empty.
    """
    path, own = folder / Path(name).expanduser(), PACKAGE / bundled / name
    return own if bundled and Path(name).name == name and own.exists() and not path.exists() else path


def resolve_paths(settings: type, table: dict[str, Any], folder: Path) -> None:
    """Make the paths in a launch file's table, of the dataclass ``settings``, absolute, in place: they are relative to
    ``folder``.
    """
    for setting in fields(settings):
        value = table.get(setting.name)
        if isinstance(value, str) and value and _is_path(setting, value):
            table[setting.name] = str(located(value, folder, setting.metadata.get(_PATH, "")))
        elif isinstance(section := setting.default_factory, type) and is_dataclass(section) and isinstance(value, dict):
            resolve_paths(section, value, folder)


def paths_in(settings: Any) -> Iterator[Path]:
    """All paths in the values of a settings dataclass."""
    for setting in fields(settings):
        value = getattr(settings, setting.name)
        if is_dataclass(value):
            yield from paths_in(value)
        elif isinstance(value, str) and value and _is_path(setting, value):
            yield Path(value)


def _is_path(setting: Field[Any], value: str) -> bool:
    return _PATH in setting.metadata or (MODEL in setting.metadata and value.endswith(".safetensors"))


def check_host_and_port(section: str, host: str, port: int, *, least: int = 1) -> None:
    """Raise LaunchError if a host is empty, or a port out of range. With ``least`` 0, port 0 means any free port."""
    if not host:
        raise LaunchError(f"[{section}] host: expected an address, such as 127.0.0.1, got none")
    if not least <= port <= 65535:
        raise LaunchError(f"[{section}] port: expected {least}{'' if least else ' (any)'} to 65535, got {port}")


def load_plugin(setting: str, reference: Any) -> Any:
    """Import what a launch file names as ``module:name``. Raises LaunchError if it cannot be imported."""
    module, separator, name = reference.partition(":") if isinstance(reference, str) else ("", "", "")
    if not (module and separator and name):
        raise LaunchError(f"{setting}: expected module:name, got {reference!r}")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        remedy = "install its package beside steadypose"
        raise LaunchError(f"{setting}: {reference} cannot be imported: {error}; {remedy}") from error


def as_text(name: str) -> str:
    """A file's name for messages and images: escapes stand for bytes that are not UTF-8, which these cannot hold."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def printable(text: str) -> str:
    """The text, with what a terminal would obey instead of showing it made visible."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)
