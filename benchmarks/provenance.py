"""What a result depends on, so that none outlives it: weights, default settings and code, as digests."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from steadypose import PACKAGE
from steadypose.benchmarks.machine import uncommitted
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.events.detector import EventSettings
from steadypose.prior.fit.solve import FitSettings
from steadypose.prior.models.weights import WEIGHTS
from steadypose.prior.world.settings import TrajectorySettings

RESULTS = Path(__file__).parent / "results"
"""Where the results lie that the README's tables are written from."""

CLEAN = ("mixture weights", "occlusion weights", "hgvae weights", "posture weights", "prior settings")
"""What `pose/clean` depends on with default settings, of what `ships`."""

VARIANTS = (*CLEAN, "hmvae weights")
"""The same of all variants of `benchmarks.ours`: one refines with HM-VAE, which the default does not."""

WORLD = (*CLEAN, "contacts weights", "trajectory weights", "trajectory settings")
"""What `pose/world` depends on."""

_WEIGHT_SETS = ("default", "kinect_v2")
"""Those that ship; others may have been installed beside them."""


class UncommittedError(RuntimeError):
    """What would be measured is in no commit; the message says what to do."""


@cache
def ships() -> dict[str, str]:
    """Digests of all that a result can depend on.

    By name: ``MODEL weights`` of each model, ``SECTION settings`` of each table of a launch file, such as ``prior``
    and ``prior.impute``, and of ``offline``, the settings of ``steadypose fit``.
    """
    weights: dict[str, list[Path]] = {}
    for path in sorted(WEIGHTS.iterdir()):
        model, _, rest = path.name.partition("-")
        if rest.partition(".")[0] in _WEIGHT_SETS and path.suffix in (".safetensors", ".json"):
            weights.setdefault(model, []).append(path)
    return {
        **{f"{model} weights": _digest(*(part for p in paths for part in (p.name.encode(), p.read_bytes())))
           for model, paths in weights.items()},
        **dict(_settings("prior", PriorSettings())),
        **dict(_settings("trajectory", TrajectorySettings())),
        **dict(_settings("events", EventSettings())),
        **dict(_settings("offline", FitSettings())),
    }  # fmt: skip


def _settings(name: str, settings: Any) -> Iterator[tuple[str, str]]:
    """The digest of a dataclass, and of each dataclass in it."""
    yield f"{name} settings", _digest(json.dumps(asdict(settings), sort_keys=True, default=str).encode())
    for field in fields(settings):
        if is_dataclass(value := getattr(settings, field.name)):
            yield from _settings(f"{name}.{field.name}", value)


def _digest(*parts: bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:16]


def code() -> dict[str, str]:
    """Digest of every module of this project that is imported now, by name, such as ``prior.clean.fuse``."""
    files = {name: getattr(module, "__file__", None) for name, module in sys.modules.items()}
    ours = {name.removeprefix("steadypose."): file for name, file in files.items() if name.startswith("steadypose.")}
    return {name: digest for name, file in sorted(ours.items()) if file and (digest := code_digest(Path(file)))}


@cache
def code_digest(path: Path) -> str:
    """Of a module's statements, without comments and docstrings, which change no figure; empty if it is not there."""
    if not path.is_file():
        return ""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [part for part in body if not _is_text(part)]  # type: ignore[attr-defined]
    return _digest(ast.dump(tree).encode())


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def stale(result: Mapping[str, Any]) -> list[str]:
    """What has changed since a result was measured; nothing where it holds.

    A result's ``measured`` has the digests of what `ships`, and its ``code`` those of the modules that ran. Results of
    before 2026-11-23 have no ``code``.
    """
    measured = result.get("measured")
    if measured is None:
        return ["weights", "settings"]
    changed = [part for part, digest in measured.items() if ships().get(part) != digest]
    if "code" not in result:
        return [*changed, "code (not recorded)"]
    modules = [name for name, digest in result["code"].items() if code_digest(_file_of(name)) != digest]
    if modules:
        changed.append(f"code ({', '.join(modules[:3])}{', ...' * (len(modules) > 3)})")
    return changed


def _file_of(module: str) -> Path:
    path = PACKAGE.joinpath(*module.split("."))
    file = path.with_suffix(".py")
    return file if file.is_file() else path / "__init__.py"


def require_committed(directory: Path) -> None:
    """Refuse to fill `RESULTS` with what no commit can make again; to be asked before measuring.

    Raises:
        UncommittedError: the checkout differs from its commit, in more than results and documents.
    """
    if directory.resolve() == RESULTS.resolve() and (files := uncommitted()):
        raise UncommittedError(
            f"results are measured at a commit, but {', '.join(files[:5])}{', ...' * (len(files) > 5)} differ from it: "
            "commit first, or write elsewhere (--out DIR)"
        )
