"""Mutation testing: ``python -m tests.mutation FOLDER_OR_FILE... [--tests TESTS] [--sample N] [--seed S]``.

A mutant is a copy of the code with one small change: another operator or number, two arguments exchanged, or a
statement left out. Tests that fail on it kill it. If all of them pass, it survives: no test checks what was changed
there. Each mutant is printed as killed or survived.

Unless ``--tests`` names the tests, each mutant is tested by the test files in the folder of its file, such as
``tests/prior/fit`` for ``prior/fit``, those that import its module first. If none of them does, those elsewhere that do
are added, or, if there are none, those that import a module that imports it. Tests marked slow are left out. Mutants
are written to a temporary copy of the checkout. The exit status is 0 if at least `GOAL` of the mutants were killed, and
1 if fewer were, or if the tests fail on the unchanged code.
"""

import ast
import copy
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

FOLDERS = ("msgs", "prior", "training", "nodes", "benchmarks")
ROOT = Path(__file__).parents[1]
GOAL = 0.85
"""Least share of mutants that tests should kill."""

LIBRARIES = [
    "hypothesis", "mcap", "numba", "numpy", "pytest", "rosbags.typesys", "scipy.spatial.transform", "torch", "zmq",
]  # fmt: skip
"""Imported once, before the processes that run tests are forked."""

ELSEWHERE = shutil.ignore_patterns(".venv", ".git", ".uv", ".hypothesis", "__pycache__", ".*_cache")
MADE = ("build", "data", "runs", "out")
"""Names of folders without code at the top of a checkout. Further down, folders of these names have code."""

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
SYMMETRIC = {"max", "min", "maximum", "minimum", "fmax", "fmin", "hypot"}
"""Functions whose arguments may be exchanged."""

LOOPS = ROOT / "src" / "steadypose" / "__pycache__" / "loops_of_mutants"
"""Cache of numba's compiled loops."""


@dataclass(frozen=True)
class Mutant:
    """One change of one file, relative to the checkout, on a line (from 1); ``source`` is the whole file, changed."""

    file: Path
    line: int
    old: str
    new: str
    source: bytes

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {' '.join(self.old.split())[:70]} -> {' '.join(self.new.split())[:70]}"


def mutants(file: Path, root: Path = ROOT) -> list[Mutant]:
    """All mutants of a file, which is relative to ``root``. Annotations, strings and imports stay as they are."""
    source = (root / file).read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in _mutable(ast.parse(source)):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        first, last = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        old = source[first:last].decode()
        for changed in _changes(node):
            new = ast.unparse(changed) if isinstance(changed, ast.stmt) else f"({ast.unparse(changed)})"
            found.append(Mutant(file, node.lineno, old, new, source[:first] + new.encode() + source[last:]))
    return found


def _mutable(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield the nodes of a tree that may be changed: none in annotations, decorators and imports, nor in f-strings, for
    whose parts Python 3.11 gives no positions."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr | ast.Import | ast.ImportFrom):
                if isinstance(child, ast.expr | ast.stmt) and not _the_same_either_way(node, child):
                    yield child
                yield from _mutable(child)


def _the_same_either_way(node: ast.AST, child: ast.AST) -> bool:
    """Whether a change of ``child`` in ``node`` is left out.

    The order of exceptions has no effect, and that of indices is no order of values. Of -1, only the sign is changed.
    """
    return (isinstance(node, ast.ExceptHandler | ast.Subscript) and isinstance(child, ast.Tuple)) or (
        isinstance(node, ast.UnaryOp) and isinstance(child, ast.Constant)
    )


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    changed = copy.deepcopy(node)
    match changed:
        case ast.Compare(ops=[op]) if type(op) in OPERATORS:
            changed.ops = [OPERATORS[type(op)]()]  # type: ignore[list-item]
            yield changed
        case ast.BinOp() | ast.BoolOp() if type(changed.op) in OPERATORS:
            changed.op = OPERATORS[type(changed.op)]()  # type: ignore[assignment]
            yield changed
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int() | float() as value):
            yield ast.Constant(value + 1 if isinstance(value, int) else 2 * value or 1.0)
        case ast.List(elts=[first, *_, last], ctx=ast.Load()) | ast.Tuple(elts=[first, *_, last], ctx=ast.Load()):
            if ast.dump(first) != ast.dump(last):
                changed.elts[0], changed.elts[-1] = last, first
                yield changed
        case ast.Call(func=func, args=[first, *_, last]) if ast.Starred not in map(type, (first, last)):
            if ast.dump(first) != ast.dump(last) and ast.unparse(func).rpartition(".")[2] not in SYMMETRIC:
                changed.args[0], changed.args[-1] = last, first
                yield changed
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise():
            yield ast.Pass()
        case ast.Return(value=ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(ast.Constant(None))
        case _:
            return


@cache
def tests_of(file: Path) -> list[str]:
    """Return the test files of a file's module, those that import it first; all are relative to `ROOT`.

    Raises ValueError if no test imports the module, even through others.
    """
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
    }
    tests = {path: _imports(path) for path in sorted((ROOT / "tests").rglob("test_*.py"))}
    near = sorted((ROOT / "tests" / file.parent).glob("test_*.py"))
    sought, seen = {name for name, path in modules.items() if path == ROOT / file}, set()
    while sought:
        found = [path for path, names in tests.items() if names & sought]
        if found:
            first = [path for path in found if path in near] or found
            return [str(path.relative_to(ROOT)) for path in dict.fromkeys([*first, *near])]
        seen |= sought
        sought = {name for name, path in modules.items() if name not in seen and _imports(path) & sought}
    raise ValueError(f"{file}: expected a module that a test imports, directly or through others")


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


def copy_checkout(source: Path, target: Path) -> None:
    """Copy what the tests of a checkout need, without data, results and caches."""

    def left_out(folder: str, names: list[str]) -> set[str]:
        return {*ELSEWHERE(folder, names), *(MADE if Path(folder) == source else ())}

    shutil.copytree(source, target, symlinks=True, ignore=left_out)


def passes(tests: Sequence[str], root: Path, limit_s: float | None = None) -> bool:
    """Return whether the tests (arguments of pytest) pass on the copy of the checkout at ``root`` within ``limit_s``.

    Raises ValueError if pytest finds no such tests.
    """
    # fork from a process that has already imported the libraries, because importing them takes longer than most tests
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    child = context.Process(target=_run, args=(tests, root))
    child.start()
    child.join(limit_s)
    if child.is_alive():
        child.kill()
        child.join()
    if child.exitcode == pytest.ExitCode.USAGE_ERROR:
        raise ValueError(f"--tests: expected tests of this checkout, got {' '.join(tests)}")
    return child.exitcode in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)  # none, where all are slow


def _run(tests: Sequence[str], root: Path) -> None:
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    os.chdir(root)
    sys.path[:0] = [str(root), str(root / "src")]
    # no bytecode, because Python would mistake a mutant for the last one if both have the same size and second
    sys.dont_write_bytecode = True
    os.environ |= {"PYTHONPATH": str(root / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    os.environ.setdefault("NUMBA_CACHE_DIR", str(LOOPS))  # only loops that are changed are compiled
    sys.exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests]))


def main() -> int:
    """Draw mutants, test them, and print the share that was killed."""
    parser = ArgumentParser("python -m tests.mutation", description=__doc__)
    parser.add_argument("code", nargs="+", type=Path, help="files, or folders of them")
    parser.add_argument("--tests", nargs="+", help="arguments of pytest; if omitted, chosen for each mutant")
    parser.add_argument("--sample", type=int, help="number of mutants, drawn at random; all if omitted")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    paths = [path.resolve() for path in options.code]
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    every = [mutant for file in files for mutant in mutants(file.relative_to(ROOT))]
    drawn = random.Random(options.seed).sample(every, min(options.sample or len(every), len(every)))
    drawn.sort(key=lambda mutant: mutant.file)
    survived, seconds = 0, dict[str, float]()
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary).resolve() / "checkout"
        copy_checkout(ROOT, root)
        for mutant in drawn:
            tests = options.tests or tests_of(mutant.file)
            for test in tests:
                if test not in seconds:
                    started = time.monotonic()
                    if not passes([test], root):
                        sys.exit(f"{test} fails on the unchanged code, so it can say nothing of mutants")
                    seconds[test] = time.monotonic() - started
            original = (root / mutant.file).read_bytes()
            (root / mutant.file).write_bytes(mutant.source)
            alive = passes(tests, root, limit_s=10.0 + 3.0 * sum(seconds[test] for test in tests))
            (root / mutant.file).write_bytes(original)
            survived += alive
            print("survived" if alive else "killed  ", mutant, flush=True)
    killed = len(drawn) - survived
    print(f"{killed} of {len(drawn)} mutants killed ({len(every)} in all), {100 * killed / max(len(drawn), 1):.0f} %")
    return 0 if killed >= GOAL * len(drawn) else 1


if __name__ == "__main__":
    sys.exit(main())
