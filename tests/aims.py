"""Which tests are aimed at a place of the code: by what they import, and by the functions that run it."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOMS = ("msgs", "prior", "training", "nodes", "benchmarks")


def aimed_at(file: Path, root: Path) -> list[str]:
    """Test files, relative to ``root``, aimed at a file of the package.

    Raises:
        ValueError: no test imports the file's module, nor what imports it.
    """
    modules = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for room in ROOMS
        for path in (root / room).rglob("*.py")
    }
    tests = {path: _imports(path) for path in sorted((root / "tests").rglob("test_*.py"))}
    sought, seen = {name for name, path in modules.items() if path == root / file}, set()
    while sought:
        found = [path for path, names in tests.items() if names & sought]
        if near := [path for path in found if (root / "tests" / file).parent in path.parents]:
            found = near  # those of the same room, where there are any
        if found:
            return [str(path.relative_to(root)) for path in found]
        seen |= sought
        sought = {name for name, path in modules.items() if name not in seen and _imports(path) & sought}
    raise ValueError(f"{file}: expected a module of the package that a test imports, if only by another")


def of_room(file: Path, root: Path) -> list[str]:
    """Test files, relative to ``root``, of the room of a file."""
    return [str(path.relative_to(root)) for path in sorted((root / "tests" / file.parent).glob("test_*.py"))]


@cache
def _imports(path: Path) -> set[str]:
    """Names without ``steadypose.``: of modules, and of what is taken from them."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("steadypose."):
            module = (node.module or "").removeprefix("steadypose.")
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return names


class Part(NamedTuple):
    """A function, a method, a constant, or what a module does as it is imported.

    Attributes:
        file: relative to the checkout.
        first, last: lines from 1, decorators included.
        ran: the first line of the function that runs it, 1 of a module.
        names: that it defines; of a method, none.
        uses: names that it mentions.
        is_run: whether Python runs it; otherwise it is compiled, or a value, and shows in those that use it.
    """

    file: Path
    first: int
    last: int
    ran: int
    names: frozenset[str]
    uses: frozenset[str]
    is_run: bool


@cache
def parts(root: Path) -> list[Part]:
    """All of the package; in a file, what is at a line comes before the module or class about it."""
    found = []
    for file in sorted(path for room in ROOMS for path in (root / room).rglob("*.py")):
        tree = ast.parse(file.read_text())
        within = [child for node in tree.body if isinstance(node, ast.ClassDef) for child in node.body]
        for node in (*within, *tree.body):
            decorators = getattr(node, "decorator_list", [])
            names, is_run = set[str](), not any("njit" in ast.unparse(decorator) for decorator in decorators)
            if node in tree.body and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = {node.name}
            elif node in tree.body and isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names, is_run = set[str]().union(*map(_names, targets)), False
            first = min(part.lineno for part in (node, *decorators))
            ran = first if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) else 1
            last = node.end_lineno or first
            part = Part(file.relative_to(root), first, last, ran, frozenset(names), frozenset(_names(node)), is_run)
            found.append(part)
    return found


def _names(node: ast.AST) -> set[str]:
    """Names in a part of the code; of a class without its methods."""
    if isinstance(node, ast.ClassDef):
        inner = [child for child in node.body if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)]
        return set[str]().union(*map(_names, (*node.bases, *node.decorator_list, *inner)))
    every = [n for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute)]
    return {n.id if isinstance(n, ast.Name) else n.attr for n in every}


def runs_of(file: Path, line: int, root: Path) -> set[tuple[str, int]]:
    """Files and first lines of the code that runs, or uses, what is at a line of a file."""
    every = parts(root)
    waiting = [next(p for p in every if p.file == file and p.first <= line <= p.last)]
    found, seen = set[tuple[str, int]](), set[Part]()
    while waiting:
        part = waiting.pop()
        if part in seen:
            continue
        seen.add(part)
        if part.is_run:
            found.add((str(part.file), part.ran))
        else:
            waiting += [other for other in every if other.uses & part.names]
    return found
