"""The declarations of the sources name what exists."""

from __future__ import annotations

import dataclasses

import pytest

from steadypose.nodes.extras import EXTRAS
from steadypose.nodes.sources.registry import SOURCES, InputSettings
from steadypose.nodes.sources.source import LiveSource


@pytest.mark.parametrize("name", SOURCES)
def test_a_declaration_names_what_exists(name: str) -> None:
    declared, settings = SOURCES[name], getattr(InputSettings(), name)
    assert not declared.extra or declared.extra in EXTRAS
    if name == "recording":
        assert settings == ""
    else:
        assert dataclasses.is_dataclass(settings)
        # a class, or a function that chooses one
        assert not isinstance(declared.opens, type) or issubclass(declared.opens, LiveSource)
