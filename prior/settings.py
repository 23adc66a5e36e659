"""Settings from launch files: nested dataclasses, read strictly."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def build_settings(cls: type, settings: Mapping[str, Any], path: str) -> Any:
    """A settings dataclass from a mapping, nested ones from nested mappings; strict.

    Raises:
        ValueError: saying the key or the type that was expected, and what came.
    """
    defaults = cls()
    values: dict[str, Any] = {}
    known = [f.name for f in fields(cls)]
    for key, value in settings.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"expected one of {', '.join(known)}"
            raise ValueError(f"[{path}] has no setting '{key}': {hint}")
        default = getattr(defaults, key)
        if is_dataclass(default):
            if not isinstance(value, Mapping):
                raise ValueError(f"[{path}] {key}: expected a section, got {value!r}")
            values[key] = build_settings(type(default), value, f"{path}.{key}")
            continue
        wanted = float if isinstance(default, float) else type(default)
        if isinstance(value, bool) != isinstance(default, bool) or not isinstance(
            value, (int, float) if wanted is float else wanted
        ):
            raise ValueError(f"[{path}] {key}: expected {wanted.__name__} such as {default!r}, got {value!r}")
        values[key] = wanted(value)
    return cls(**values)
