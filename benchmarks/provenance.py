"""What a result was measured with, so that none outlives it: weights and default settings, as digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from steadypose.benchmarks.machine import uncommitted
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.models.weights_io import WEIGHTS
from steadypose.prior.world.pipeline import TrajectorySettings

RESULTS = Path(__file__).parent / "results"
"""Where the results lie that the README's tables are written from."""


class UncommittedError(RuntimeError):
    """What would be measured is in no commit; the message says what to do."""


@cache
def ships() -> dict[str, str]:
    """Digests of the weights that ship and of the settings that they run with."""
    files = sorted(path for path in WEIGHTS.iterdir() if path.suffix in (".safetensors", ".json"))
    weights = hashlib.sha256()
    for path in files:
        weights.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    settings = {"prior": asdict(PriorSettings()), "trajectory": asdict(TrajectorySettings())}
    return {
        "weights": weights.hexdigest()[:16],
        "settings": hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16],
    }


def stale(result: Mapping[str, Any]) -> list[str]:
    """What has changed since a result was measured: some of ``weights`` and ``settings``; nothing where it holds.

    A result's ``measured`` has the digests of that time; one that depends on neither has none in it.
    """
    measured = result.get("measured")
    if measured is None:
        return list(ships())
    return [part for part, digest in measured.items() if ships().get(part) != digest]


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
