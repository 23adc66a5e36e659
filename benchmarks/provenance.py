"""What a result was measured with, so that none outlives it: weights and default settings, as digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from steadypose.benchmarks.machine import uncommitted
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.models.weights_io import WEIGHTS
from steadypose.prior.offline.solve import FitSettings
from steadypose.prior.world.pipeline import TrajectorySettings

RESULTS = Path(__file__).parent / "results"
"""Where the results lie that the README's tables are written from."""


OF_CLEAN = ("prior weights", "prior settings")
OF_WORLD = (*OF_CLEAN, "trajectory weights", "trajectory settings")
OF_FIT = (*OF_CLEAN, "offline weights", "offline settings")
"""what `pose/clean`, `pose/world` and ``steadypose fit`` depend on, of what `ships`"""
OF_COMPLETION = ("completion weights", "trajectory weights", "prior weights")
"""what ``steadypose complete`` depends on"""

_PRIOR_MODELS = ("correction", "hgvae", "hmvae-", "mixture", "occlusion")
_TRAJECTORY_MODELS = ("contacts", "trajectory")
_OFFLINE_MODELS = ("humor",)
_COMPLETION_MODELS = ("completer", "hmvae64")


class UncommittedError(RuntimeError):
    """What would be measured is in no commit; the message says what to do."""


@cache
def ships() -> dict[str, str]:
    """Digests of the weights that ship and of the settings that they run with, of prior, trajectory and offline."""
    files = [path for path in WEIGHTS.iterdir() if path.suffix in (".safetensors", ".json")]
    of_prior, of_trajectory, of_fit, of_completion = (
        [path for path in files if path.name.startswith(models)]
        for models in (_PRIOR_MODELS, _TRAJECTORY_MODELS, _OFFLINE_MODELS, _COMPLETION_MODELS)
    )
    return {
        "prior weights": _digest_of_files(of_prior),
        "prior settings": _digest_of_settings(asdict(PriorSettings())),
        "trajectory weights": _digest_of_files(of_trajectory),
        "completion weights": _digest_of_files(of_completion),
        "trajectory settings": _digest_of_settings(asdict(TrajectorySettings())),
        "offline weights": _digest_of_files(of_fit),
        "offline settings": _digest_of_settings(asdict(FitSettings())),
    }


def _digest_of_files(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def _digest_of_settings(settings: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]


def stale(result: Mapping[str, Any]) -> list[str]:
    """What has changed since a result was measured, of what `ships`; nothing where it holds.

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
