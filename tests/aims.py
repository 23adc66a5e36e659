"""Finds the tests of a piece of code: by what test files import, and by which functions run it."""

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

FOLDERS = ("msgs", "prior", "training", "nodes", "benchmarks")


def tests_of_module(file: Path, root: Path) -> list[str]:
    """Return the test files that import a file's module or, if none does, a module that imports it.

    If some of these are in the folder of the file's own tests (``tests/prior/fit`` for ``prior/fit``), only those. All
    are relative to ``root``. Raises ValueError if no test imports the module, even through others.
    """
    modules = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for folder in FOLDERS
        for path in (root / folder).rglob("*.py")
    }
    tests = {path: _imports(path) for path in sorted((root / "tests").rglob("test_*.py"))}
    sought, seen = {name for name, path in modules.items() if path == root / file}, set()
    while sought:
        found = [path for path, names in tests.items() if names & sought]
        if near := [path for path in found if (root / "tests" / file).parent in path.parents]:
            found = near
        if found:
            return [str(path.relative_to(root)) for path in found]
        seen |= sought
        sought = {name for name, path in modules.items() if name not in seen and _imports(path) & sought}
    raise ValueError(f"{file}: expected a module that a test imports, directly or through others")


def tests_in_folder(file: Path, root: Path) -> list[str]:
    """Return the test files in the folder of a file's own tests; both are relative to ``root``."""
    return [str(path.relative_to(root)) for path in sorted((root / "tests" / file.parent).glob("test_*.py"))]


@cache
def _imports(path: Path) -> set[str]:
    """Return the modules of the package that a file imports, and the names that it imports from them, without
    ``steadypose.``"""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("steadypose."):
            module = (node.module or "").removeprefix("steadypose.")
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return names


class Part(NamedTuple):
    """A part of a module, from its first to its last line (from 1): a function, class, constant or statement.

    ``ran`` is the first line of the function that Python reports when it runs this part; 1 for the module's own
    statements. Constants and compiled loops (njit) are not reported (``is_run``): a change of theirs is found in the
    functions that use them. ``names`` are those that it defines, none for a method; ``uses`` those that it mentions.
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
    """Return all parts of the package; in each file, the methods of classes come before the classes."""
    found = []
    for file in sorted(path for folder in FOLDERS for path in (root / folder).rglob("*.py")):
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
    """Return the names in a part of the code; for a class, without its methods."""
    if isinstance(node, ast.ClassDef):
        inner = [child for child in node.body if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)]
        return set[str]().union(*map(_names, (*node.bases, *node.decorator_list, *inner)))
    every = [n for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute)]
    return {n.id if isinstance(n, ast.Name) else n.attr for n in every}


def runs_of(file: Path, line: int, root: Path) -> set[tuple[str, int]]:
    """Return file and first line of the functions that run the code at a line, or use it if it is a value."""
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
