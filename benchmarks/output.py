"""Outputs of the pipeline and of completion on the bundled streams, reduced to a few numbers that reveal a change."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np

from steadypose import PACKAGE
from steadypose.msgs.types import CleanBody, PoseClean, PoseRaw, PoseWorld, WorldBody
from steadypose.nodes.driving import stream
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.complete.body import Uncertainty
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.stream import complete_raws
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

FRAMES = 120
"""Number of frames of each bundled stream that are processed."""
PROJECTIONS = 8
"""Number of projections kept of each output."""


@cache
def outputs() -> dict[str, list[float]]:
    """Return random projections of outputs by name: with default settings, with HM-VAE's refinement, and of `complete`.

    A projection has weights of 1 and -1, divided by the root of their number. It changes by about the root mean square
    change of the output, so eight numbers measure how much 100,000 differ.
    """
    paths = sorted(path.parent for path in (PACKAGE / "sim_data").glob("*/metadata.yaml"))
    default = [part for path in paths for part in _answers(path, PriorSettings())]
    refining = PriorSettings.from_dict({"refine": {"enabled": True}})
    return {
        "pose/clean": projections(values for kind, values in default if kind is PoseClean),
        "pose/world": projections(values for kind, values in default if kind is PoseWorld),
        "pose/clean, HM-VAE": projections(values for kind, values in _answers(paths[0], refining) if kind is PoseClean),
        "complete": projections(_completed(path) for path in paths[:2]),
    }


def _completed(path: Path) -> np.ndarray:
    """Complete every body of a stream with a gap of one second."""
    raws = [message for _, message in islice(open_recording(path), FRAMES) if isinstance(message, PoseRaw)]
    del raws[40:70]
    completer = LiveCompleter.load("default")
    done = complete_raws(path.name, raws, PartsCompleter(completer), Uncertainty(completer.config.never_sigma, 1)).done
    return np.concatenate([np.ravel(completed.positions[np.isfinite(completed.positions)]) for _, completed in done])


def _answers(path: Path, settings: PriorSettings) -> Iterator[tuple[type, np.ndarray]]:
    raw = (item for item in open_recording(path) if isinstance(item[1], PoseRaw))
    pipelines = PriorPipeline(settings), TrajectoryPipeline(TrajectorySettings())
    for _, message in stream(islice(raw, FRAMES), *pipelines):
        if isinstance(message, PoseClean | PoseWorld):
            yield type(message), np.concatenate([np.empty(0), *(_numbers(body) for body in message.bodies)])


def _numbers(body: CleanBody | WorldBody) -> np.ndarray:
    """Return positions, rotations, deviations, and contacts or the anomaly, in a row."""
    last = body.contacts if isinstance(body, WorldBody) else [body.anomaly]
    parts = body.positions, body.rotations, body.sigma, last
    return np.nan_to_num(np.concatenate([np.ravel(part) for part in parts]), posinf=1.0).astype(np.float64)


def projections(parts: Iterable[np.ndarray]) -> list[float]:
    """Project an output that is given in parts."""
    values = np.concatenate(list(parts))
    signs = np.random.default_rng(0).integers(0, 2, (PROJECTIONS, len(values)), dtype=np.int8) * 2.0 - 1.0
    return [round(float(p), 7) for p in signs @ values / np.sqrt(len(values))]
