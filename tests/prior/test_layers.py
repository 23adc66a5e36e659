"""The rooms of the prior import downwards only."""

from __future__ import annotations

import ast
from collections import defaultdict

from steadypose import PACKAGE

FLOORS = ("body", "timing", "camera", "motion", "models", "clean", "world", "sim", "offline")
"""from the ground up: a room imports from those before it"""

AT_MOST = 25
"""arrows between rooms"""


def arrows() -> dict[tuple[str, str], list[str]]:
    """Which room imports which, and in which modules."""
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path in (PACKAGE / "prior").rglob("*.py"):
        room = path.relative_to(PACKAGE / "prior").parts[0]
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                parts = name.split(".")
                if parts[:2] == ["steadypose", "prior"] and len(parts) > 2 and parts[2] != room:
                    found[room, parts[2]].append(path.stem)
    return found


def test_rooms_import_downwards() -> None:
    between = {(a, b): where for (a, b), where in arrows().items() if a in FLOORS and b in FLOORS}
    up = {arrow: where for arrow, where in between.items() if FLOORS.index(arrow[0]) < FLOORS.index(arrow[1])}
    assert not up
    assert len(between) <= AT_MOST
    rooms = {path.name for path in (PACKAGE / "prior").iterdir() if (path / "__init__.py").is_file()}
    assert rooms == set(FLOORS)
