"""Settings from launch files: nested dataclasses, read strictly."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

MODEL = "model"
"""Key of the metadata of a field that names weights; its value is the model's name."""


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
