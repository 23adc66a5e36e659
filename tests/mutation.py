"""Mutation testing: ``python -m tests.mutation FOLDER_OR_FILE... [--tests TESTS] [--sample N] [--seed S]``.

A mutant is the code with one operator, number, order or statement changed. Tests that pass on a mutant do not hold that
place: it survived, and is printed. Unless tests are named, a mutant meets those of its room and those aimed at its
file: the ones that import it, or where none does, that import the modules that import it; none that is marked slow. Of
these it meets the files that run the changed function, the quickest first. The checkout stays as it is: mutants live in
a copy. Exit status 0 if at least `GOAL` of the mutants were killed, and 1 if fewer were, or if the tests fail without
any mutation.
"""

from __future__ import annotations

import ast
import copy
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import pytest
from tests.aims import aimed_at, of_room, runs_of

ROOT = Path(__file__).parents[1]
GOAL = 0.85
LIBRARIES = [
    "hypothesis",
    "mcap",
    "numba",
    "numpy",
    "pytest",
    "rosbags.typesys",
    "scipy.spatial.transform",
    "torch",
    "zmq",
]
ELSEWHERE = shutil.ignore_patterns(".venv", ".git", ".uv", ".hypothesis", "__pycache__", ".*_cache")
MADE = ("build", "data", "runs", "out")
"""Folders at the top of a checkout that hold no code; further down, one of these names does."""

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
SYMMETRIC = {"max", "min", "maximum", "minimum", "fmax", "fmin", "hypot"}
"""Functions of two values in any order."""
LOOPS = ROOT / "src" / "steadypose" / "__pycache__" / "loops_of_mutants"


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        file: relative to the checkout.
        line: from 1.
        old, new: source text.
        source: the whole file, changed.
    """

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
    """Nodes of a tree, but not in annotations, imports and f-strings, whose parts have no place of their own."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr | ast.Import | ast.ImportFrom):
                if isinstance(child, ast.expr | ast.stmt) and not _the_same_either_way(node, child):
                    yield child
                yield from _mutable(child)


def _the_same_either_way(node: ast.AST, child: ast.AST) -> bool:
    """Of exceptions the order does not count, that of indices is no order of values, and -2 is as unknown as -1."""
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
        case ast.Call(func=func, args=[first, *_, last]) if not any(
            isinstance(end, ast.Starred) for end in (first, last)
        ):
            if ast.dump(first) != ast.dump(last) and ast.unparse(func).rpartition(".")[2] not in SYMMETRIC:
                changed.args[0], changed.args[-1] = last, first
                yield changed
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise():
            yield ast.Pass()
        case ast.Return(value=ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(ast.Constant(None))
        case _:
            return


def copy_checkout(source: Path, target: Path) -> None:
    """All that tests of a checkout need, and nothing that they make."""

    def left_out(folder: str, names: list[str]) -> set[str]:
        return {*ELSEWHERE(folder, names), *(MADE if Path(folder) == source else ())}

    shutil.copytree(source, target, symlinks=True, ignore=left_out)


def passes(tests: Sequence[str], root: Path, limit_s: float | None = None, record: Path | None = None) -> bool:
    """Whether the tests pass on the copy of the checkout at ``root``; those that do not end in time do not.

    Args:
        tests: as pytest takes them.
        root: of the copy.
        limit_s: seconds that they may take.
        record: a file for what they run: JSON of files and first lines of functions.

    Raises:
        ValueError: there are no such tests.
    """
    # forked from a process that has the libraries already: to import them takes longer than most tests
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    child = context.Process(target=_run, args=(tests, root, record))
    child.start()
    child.join(limit_s)
    if child.is_alive():
        child.kill()
        child.join()
    if child.exitcode in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise ValueError(f"--tests: expected tests of this checkout, got {' '.join(tests)}")
    return child.exitcode == 0


def _run(tests: Sequence[str], root: Path, record: Path | None) -> None:
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    os.chdir(root)
    sys.path[:0] = [str(root), str(root / "src")]
    # no bytecode: two mutants of one second and one size would be taken for one another
    sys.dont_write_bytecode = True
    os.environ |= {"PYTHONPATH": str(root / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    os.environ.setdefault("NUMBA_CACHE_DIR", str(LOOPS))  # only loops that are changed are compiled
    ran: set[tuple[str, int]] = set()

    def note(frame: FrameType, event: str, arg: object) -> None:
        ran.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

    if record:
        threading.settrace(note)
        sys.settrace(note)
    status = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests])
    sys.settrace(None)
    if record:
        within = [(Path(name).resolve(), line) for name, line in ran]
        record.write_text(json.dumps([(str(f.relative_to(root)), n) for f, n in within if f.is_relative_to(root)]))
    sys.exit(status)


class Met(NamedTuple):
    """What a test file does without any mutation.

    Attributes:
        seconds: that it takes.
        ran: files and first lines of functions.
    """

    seconds: float
    ran: list[list[str | int]]


def _digest(path: Path) -> str:
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def main() -> int:
    """Mutate, test, count."""
    parser = ArgumentParser("python -m tests.mutation", description=__doc__)
    parser.add_argument("code", nargs="+", type=Path, help="files, or folders of them")
    parser.add_argument("--tests", nargs="+", help="what pytest is to run; those aimed at each file if left out")
    parser.add_argument("--sample", type=int, help="so many mutants, drawn at random; all of them if left out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kept", type=Path, help="a file for what unchanged tests run, made by the first call with it")
    options = parser.parse_args()
    paths = [path.resolve() for path in options.code]
    files = [file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    every = [mutant for file in files for mutant in mutants(file.relative_to(ROOT))]
    drawn = random.Random(options.seed).sample(every, min(options.sample or len(every), len(every)))
    drawn.sort(key=lambda mutant: mutant.file)
    with tempfile.TemporaryDirectory() as temporary:
        root, record = Path(temporary).resolve() / "checkout", Path(temporary) / "ran.json"
        copy_checkout(ROOT, root)
        survived, met_before = 0, dict[str, Met]()
        if options.kept and options.kept.is_file():
            met_before = {key: Met(*value) for key, value in json.loads(options.kept.read_text()).items()}
        for mutant in drawn:
            tests = options.tests or [*aimed_at(mutant.file, ROOT), *of_room(mutant.file, ROOT)]
            known = {test: f"{test} {_digest(root / test.partition('::')[0])}" for test in tests}
            for test, key in known.items():
                if key not in met_before:
                    started = time.monotonic()
                    if not passes([test], root, record=record):
                        sys.exit(f"the tests fail without any mutation, nothing can be said of them: {test}")
                    met_before[key] = Met(time.monotonic() - started, json.loads(record.read_text()))
                    if options.kept:
                        options.kept.write_text(json.dumps(met_before))
            seconds = {test: met_before[key].seconds for test, key in known.items()}
            changed = [list(place) for place in runs_of(mutant.file, mutant.line, ROOT)]
            # what runs in other processes is not recorded
            met = [test for test, key in known.items() if any(place in met_before[key].ran for place in changed)]
            met = sorted(met or known, key=seconds.__getitem__)
            original = (root / mutant.file).read_bytes()
            (root / mutant.file).write_bytes(mutant.source)
            alive = passes(met, root, limit_s=10.0 + 3.0 * sum(seconds[test] for test in met))
            (root / mutant.file).write_bytes(original)
            survived += alive
            print("survived" if alive else "killed  ", mutant, flush=True)
    killed = len(drawn) - survived
    print(f"{killed} of {len(drawn)} mutants killed ({len(every)} in all), {100 * killed / max(len(drawn), 1):.0f} %")
    return 0 if killed >= GOAL * len(drawn) else 1


if __name__ == "__main__":
    sys.exit(main())
