"""Settings from launch files: nested dataclasses, read strictly."""

from __future__ import annotations

import difflib
import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import field, fields, is_dataclass
from functools import cache
from typing import Any, get_args, get_type_hints

logger = logging.getLogger(__name__)

MODEL = "model"
"""Key of the metadata of a field that names weights; its value is the model's name."""

RENAMED = {"prior.encode": "prior.reconstruct", "prior.bones": "prior.person", "server.kiosks": "server.clients"}
"""Former names of settings in version 0.2. Version 0.3 accepts them with a warning; 0.4 refuses them."""

UNUSED = {"prior.impute": ("steps", "rate")}
"""Settings in version 0.2, ignored with a warning. Gradient ascent in the latents gained nothing."""


def current_key(path: str) -> str:
    """Return the current name of a setting's path, such as ``prior.bones.samples``, with or without its section."""
    for old, new in RENAMED.items():
        (section, _, was), now = old.partition("."), new.partition(".")[2]
        for former, name in ((old, new), (was, now)):
            if f"{path}.".startswith(f"{former}."):
                _warn_once(f"[{section}] {was} is now called {now}: write that; a later version refuses {was}")
                return name + path[len(former) :]
    return path


def current_keys(section: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a launch file's section under their current names, without those no longer used.

    Raises:
        ValueError: a setting is given under both names.
    """
    current: dict[str, Any] = {}
    for key, value in settings.items():
        name = current_key(f"{section}.{key}").rpartition(".")[2] if f"{section}.{key}" in RENAMED else key
        if name != key and name in settings:
            raise ValueError(f"[{section}] {key} is the former name of {name}: expected one of the two")
        if unused := [k for k in UNUSED.get(f"{section}.{key}", ()) if isinstance(value, Mapping) and k in value]:
            keys = ", ".join(unused)
            _warn_once(f"[{section}.{key}] {keys}: no longer used, and to be refused by a later version")
            value = {k: v for k, v in value.items() if k not in unused}
        current[name] = value
    return current


@cache
def _warn_once(text: str) -> None:
    logger.warning(text)


def build_settings(cls: type, settings: Mapping[str, Any], path: str) -> Any:
    """Build a settings dataclass from a mapping, strictly; nested dataclasses from nested mappings. ``path`` is the
    section's name, such as ``prior.gate``; empty for a whole launch file.

    Raises ValueError for an unknown key or a wrong type; the message says what was expected and what was given.
    """
    defaults = cls()
    values: dict[str, Any] = {}
    known = [f.name for f in fields(cls)]
    for key, value in settings.items():
        if key not in known:
            hint = nearest(key, known) or f": expected one of {', '.join(known)}"
            raise ValueError(f"{f'[{path}]' if path else 'a launch file'} has no setting '{key}'{hint}")
        default, name = getattr(defaults, key), f"[{path}] {key}" if path else key
        if is_dataclass(default):
            if not isinstance(value, Mapping):
                raise ValueError(f"{name}: expected a section, got {value!r}")
            values[key] = build_settings(type(default), value, f"{path}.{key}".lstrip("."))
            continue
        expected = type(default)
        if not _is_of(expected, value):
            kind = "true or false" if expected is bool else f"{expected.__name__} such as {default!r}"
            raise ValueError(f"{name}: expected {kind}, got {value!r}")
        if expected is float and not math.isfinite(value):
            raise ValueError(f"{name}: expected a finite number such as {default!r}, got {value!r}")
        if isinstance(value, (list, dict)) and (kind := _kind_of_items(cls, key)) is not None:
            _check_items(name, value, kind)
        values[key] = expected(value)  # type: ignore[arg-type]  (it is of that type)
    return cls(**values)


def weights_setting(model: str, default: str = "default") -> Any:
    """A field for a model's weights: a weight set, or a path to a ``.safetensors`` file; empty for none."""
    return field(default=default, metadata={MODEL: model})


def check_range(name: str, value: float, least: float, most: float) -> None:
    """Check that a value lies in a range. Raises ValueError if it does not."""
    if not least <= value <= most:
        raise ValueError(f"{name}: expected {least:g} to {most:g}, got {value:g}")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the part of an error message that suggests the most similar known name; empty if there is none."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def _kind_of_items(cls: type, key: str) -> type | None:
    """Return the annotated type of a list's items or of a table's values; None if it is not int, float or str."""
    kinds = get_args(get_type_hints(cls)[key])
    return kinds[-1] if kinds and kinds[-1] in (int, float, str) else None


def _is_of(kind: type, value: object) -> bool:
    """Whether a value from a launch file is of a kind. An integer is also a float; True and False are no numbers."""
    return isinstance(value, bool) == (kind is bool) and isinstance(value, (int, float) if kind is float else kind)


def _check_items(name: str, value: list[Any] | dict[str, Any], kind: type) -> None:
    for item in value.values() if isinstance(value, dict) else value:
        if not _is_of(kind, item) or (isinstance(item, float) and not math.isfinite(item)):
            raise ValueError(f"{name}: expected each to be a {'text' if kind is str else kind.__name__}, got {item!r}")
