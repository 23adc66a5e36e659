import ast
from collections.abc import Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from steadypose import PACKAGE

FLOORS = ("timing", "body", "camera", "mocap", "models", "events", "sim", "clean", "world", "complete", "fit")
"""of the prior, from the ground up: a room imports from those before it"""
AT_MOST = 22
"""arrows between them"""


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path
    for room in ("msgs", "prior", "training", "nodes", "benchmarks")
    for path in (PACKAGE / room).rglob("*.py")
}


def imports(path: Path) -> set[str]:
    """Modules of this project that a module imports, wherever in it."""
    found, waiting = set(), list[ast.AST](ast.parse(path.read_text()).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):  # expressions have none
            waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("steadypose."):
            parent = (node.module or "").removeprefix("steadypose.")
            children = {f"{parent}.{alias.name}" for alias in node.names}
            found |= children & MODULES.keys() or {parent}
    return found & MODULES.keys()


@cache
def all_imports() -> dict[str, set[str]]:
    return {name: imports(path) - {name} for name, path in MODULES.items()}


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        return error.args[1]
    return []


def folded(depth: int) -> dict[str, set[str]]:
    """The graph of rooms: the first parts of modules' names."""
    graph: dict[str, set[str]] = {}
    for name, others in all_imports().items():
        room = ".".join(name.split(".")[:depth])
        graph.setdefault(room, set()).update(".".join(other.split(".")[:depth]) for other in others)
    return {room: others - {room} for room, others in graph.items()}


def test_no_modules_and_no_rooms_import_each_other_in_a_circle() -> None:
    assert circle(all_imports()) == []
    assert circle({room: others for room, others in folded(2).items() if not room.startswith("benchmarks")}) == []


def test_no_room_imports_one_that_imports_it() -> None:
    rooms = ("msgs", "prior", "training", "nodes", "benchmarks")
    between = {(a, b) for a, others in folded(1).items() for b in others}
    assert not {(a, b) for a, b in between if rooms.index(a) < rooms.index(b)}


def test_the_priors_rooms_import_downwards() -> None:
    rooms = {path.name for path in (PACKAGE / "prior").iterdir() if (path / "__init__.py").is_file()}
    assert rooms == set(FLOORS)
    between = {(a[6:], b[6:]) for a, others in folded(2).items() for b in others if {a[6:], b[6:]} <= rooms}
    assert not {(a, b) for a, b in between if FLOORS.index(a) < FLOORS.index(b)}
    assert len(between) <= AT_MOST
