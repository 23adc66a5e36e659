"""What a result depends on, so that outdated results are recognised: the pipeline's output, weights, and the study's
code.

Studies measure the product's output. So a result records the pipeline's output on the bundled streams, not its code: a
refactoring that leaves the output unchanged leaves every result valid. Studies, baselines and training are recorded by
their definitions, whatever module they are in. Comments, docstrings, annotations, and functions that only write tables
or draw do not count.
"""

from __future__ import annotations

import ast
import datetime
import hashlib
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from steadypose import PACKAGE
from steadypose.prior.models.weights import WEIGHTS

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).parent / "results"  # folder of the results from which the README's tables are written

_WEIGHTS = ("mixture weights", "occlusion weights", "hgvae weights", "posture weights")
_HMVAE, _TRAJECTORY = ("hmvae weights",), ("contacts weights", "trajectory weights")

CLEAN = ("pose/clean", *_WEIGHTS)  # what `pose/clean` with default settings depends on, including the names in `ships`
CLEAN_22 = ("pose/clean of 22 joints", *_WEIGHTS)  # the same, if all canonical joints are given

VARIANTS = (*CLEAN, "pose/clean, HM-VAE", *_HMVAE)
"""What all variants of `benchmarks.product` depend on. One of them refines with HM-VAE, which the default does not."""
VARIANTS_22 = (*CLEAN_22, "pose/clean of 22 joints, HM-VAE", *_HMVAE)  # the same, if all canonical joints are given
WORLD = (*CLEAN, "pose/world", *_TRAJECTORY)  # what `pose/world` depends on
WORLD_22 = (*CLEAN_22, "pose/world of 22 joints", *_TRAJECTORY)  # the same, if all canonical joints are given
COMPLETE = "complete"  # output of `steadypose complete` on streams with a gap
_WEIGHT_SETS = ("default", "kinect_v2")  # weight sets that ship; others may be installed beside them

_PLUMBING = tuple(f"benchmarks.{name}" for name in ("evaluate", "figures", "output", "provenance", "report", "results"))
"""Modules that change no figure."""

SAME_M = 1e-4
"""Largest root mean square change of an unchanged output, metres. Results are quoted to 0.1 mm, and floats differ
between processors."""


class UncommittedError(RuntimeError):
    """The code to be measured is not committed; the message says what to do."""


@cache
def ships() -> dict[str, str]:
    """Return the digest of each model's weights by name: ``MODEL weights``."""
    weights: dict[str, list[Path]] = {}
    for path in sorted(WEIGHTS.iterdir()):
        model, _, rest = path.name.partition("-")
        if rest.partition(".")[0] in _WEIGHT_SETS and path.suffix in (".safetensors", ".json"):
            weights.setdefault(model, []).append(path)
    return {
        f"{model} weights": _digest(part for p in paths for part in (p.name.encode(), p.read_bytes()))
        for model, paths in weights.items()
    }


def _digest(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:16]


def measured(depends_on: Sequence[str]) -> dict[str, Any]:
    """Return what a result records for each name: an output, a digest of `ships`, or the digest of a package such as
    ``prior.fit``."""
    found = {}
    for name in depends_on:
        if name == COMPLETE or name.startswith("pose/"):
            from steadypose.benchmarks.output import outputs  # the pipelines take seconds to load

            found[name] = outputs()[name]
        else:
            found[name] = ships()[name] if name in ships() else package_digest(name)
    return found


@cache
def package_digest(package: str) -> str:
    """Return the digest of all definitions of a package or module of this project. The package may no longer exist.

    Moving a definition within the package does not change the digest.
    """
    path = PACKAGE.joinpath(*package.split("."))
    files = (
        sorted(path.rglob("*.py")) if path.is_dir() else [file] if (file := path.with_suffix(".py")).is_file() else []
    )
    return _digest(sorted(digest.encode() for file in files if file.is_file() for digest in definitions(file)))


def code(module: str) -> list[str]:
    """Return ``NAME DIGEST`` of every definition in a study's module and in the modules of `benchmarks` that it
    imports."""
    todo, modules = [module], set[str]()
    if not _file_of(module).is_file():
        raise FileNotFoundError(f"{module}: expected a module of this project")
    while todo:
        name = todo.pop()
        if name in modules or name in _PLUMBING or not _file_of(name).is_file():
            continue
        modules.add(name)
        for node in ast.walk(ast.parse(_file_of(name).read_bytes())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("steadypose.benchmarks"):
                source = (node.module or "").removeprefix("steadypose.")
                todo += [source, *(f"{source}.{alias.name}" for alias in node.names)]
    return sorted({line for name in modules for line in definitions(_file_of(name))})


def _file_of(module: str) -> Path:
    return PACKAGE.joinpath(*module.split(".")).with_suffix(".py")


@cache
def definitions(path: Path) -> list[str]:
    """Return ``NAME DIGEST`` of every function, class and constant of a module that can change a figure, which
    ``DEPENDS_ON`` cannot."""
    found = []
    for node in ast.parse(path.read_bytes()).body:
        match node:
            case ast.FunctionDef(name=name):
                returned = ast.unparse(node.returns) if node.returns else ""
                if "Table" in returned or "Figure" in returned:
                    continue
            case (
                ast.ClassDef(name=name)
                | ast.Assign(targets=[ast.Name(id=name)])
                | ast.AnnAssign(target=ast.Name(id=name))
            ):
                pass
            case ast.Assign(targets=[ast.Tuple() as names]):
                name = ast.unparse(names)
            case _:
                continue
        if name == "DEPENDS_ON":
            continue
        found.append(f"{name} {_digest([ast.dump(_bare(node)).encode()])[:8]}")
    return found


def _bare(node: ast.stmt) -> ast.stmt:
    """Return a definition without docstrings and without functions' annotations."""
    for part in ast.walk(node):
        if isinstance(body := getattr(part, "body", None), list):
            part.body = [line for line in body if not _is_text(line)]  # type: ignore[attr-defined]
        if isinstance(part, ast.FunctionDef):
            part.returns = None
        if isinstance(part, ast.arg):
            part.annotation = None
    return node


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


@cache
def _known() -> frozenset[str]:
    """Return ``NAME DIGEST`` of every definition in `benchmarks`."""
    return frozenset(line for path in (PACKAGE / "benchmarks").rglob("*.py") for line in definitions(path))


def stale(result: Mapping[str, Any]) -> list[str]:
    """Return what has changed since a result was measured; nothing if it is valid or frozen.

    A frozen result is of a finished study, whose code is only at the commit named by ``frozen``.
    """
    if "frozen" in result:
        return []
    recorded: Mapping[str, Any] = result["measured"]
    now = measured(tuple(recorded))
    changed = [name for name, was in recorded.items() if not _is_same(was, now[name])]
    gone = [line.split()[0] for line in result["code"] if line not in _known()]
    return [*changed, f"code ({', '.join(gone[:3])}{', ...' * (len(gone) > 3)})"] if gone else changed


def _is_same(recorded: str | list[float], now: str | list[float]) -> bool:
    if isinstance(recorded, str) or isinstance(now, str):
        return recorded == now
    return math.dist(recorded, now) <= SAME_M * math.sqrt(len(recorded))


def require_committed(directory: Path) -> None:
    """Refuse to write results to `RESULTS` that no commit can reproduce. Call it before measuring. Raises
    UncommittedError if the checkout differs from its commit, in more than results and documents."""
    if directory.resolve() == RESULTS.resolve() and (files := uncommitted()):
        raise UncommittedError(
            f"results are measured at a commit, but {', '.join(files[:5])}{', ...' * (len(files) > 5)} differ from it: "
            "commit first, or write elsewhere (--out DIR)"
        )


def machine() -> dict[str, str | int | float]:
    """Return CPU, cores, memory, load, versions, and the measured commit ("-dirty" if the checkout is
    `uncommitted`)."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0,
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "load_1min": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
        "commit": _git("rev-parse", "--short=10", "HEAD") + ("-dirty" if uncommitted() else ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def uncommitted() -> list[str]:
    """Return the files that differ from the commit, except results and documents, which do not change what is
    measured."""
    changed = _git("diff", "--name-only", "HEAD", "--", ".", ":!benchmarks/results", ":!docs", ":!*.md")
    return [] if changed == "unknown" else changed.split()


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
