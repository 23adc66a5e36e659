"""steadypose's variants in the benchmarks. Clips are processed side by side, as bodies of one stream."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.baselines.filters import missing
from steadypose.msgs.types import Pose, PoseClean, PoseRaw, RawBody
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import (
    DenoiseSettings,
    FuseSettings,
    ImputeSettings,
    OrientSettings,
    PostureSettings,
    PriorSettings,
    RefineSettings,
    ScoreSettings,
    SteadySettings,
)

PRODUCT: Mapping[str, PriorSettings] = {
    "HM-VAE": PriorSettings(
        denoise=DenoiseSettings(enabled=False),
        score=ScoreSettings(enabled=False),
        impute=ImputeSettings(enabled=False),
        refine=RefineSettings(enabled=True),
        fuse=FuseSettings(enabled=False),
        posture=PostureSettings(enabled=False),
        steady=SteadySettings(enabled=False),
        orient=OrientSettings(enabled=False),
    ),
    "steadypose": PriorSettings(),
}
"""Variants that each study runs; add one in one line. HM-VAE is the paper's refinement alone, without fusion."""

SIDE_BY_SIDE = 64
"""Number of clips in one stream. Bodies do not affect each other, and many together take a fraction of the time."""

SLOTS_A_CLIP = 4
"""Number of slots per clip, so that each is treated as a person alone. If all slots are taken, people take turns to be
imputed."""


@dataclass(frozen=True)
class Cleaned:
    """The content of ``pose/clean``."""

    stamps_s: Floats  # (T',) seconds, on the prior's 30 Hz grid
    positions: Floats  # (T', C, 22, 3) metres; NaN without an estimate
    sigma: Floats  # (T', C, 22) metres, the predicted standard deviation along an axis
    anomaly: Floats  # (T', C) score, NaN without an estimate
    flagged: NDArray[np.bool_]  # (T', C) whether it was flagged as an anomaly
    rotations: Floats  # (T', C, 22, 4) local, xyzw


def run(settings: PriorSettings, seen: Floats, stamps_s: Floats, delay: int, skeleton: str = "smpl22") -> Cleaned:
    """Clean clips (T, C, J, 3) metres, z up, NaN where missing, in the layout ``skeleton`` by ``PriorPipeline``, with
    these settings but this delay.

    A clip ends after its last frame with a joint. A frame without any joint in any clip counts as lost.
    """
    slots = SLOTS_A_CLIP * min(SIDE_BY_SIDE, seen.shape[1])
    prior = PriorPipeline(replace(settings, delay=delay, max_bodies=slots))
    parts = [
        list(stream(prior, seen[:, start : start + SIDE_BY_SIDE], stamps_s, skeleton))
        for start in range(0, seen.shape[1], SIDE_BY_SIDE)
    ]
    grid = np.unique([message.stamp_ns for messages in parts for message in messages])
    positions = np.full((len(grid), seen.shape[1], 22, 3), np.nan)
    sigma = np.full(positions.shape[:-1], np.inf)
    anomaly = np.full(sigma.shape[:-1], np.nan)
    flagged = np.zeros(anomaly.shape, dtype=bool)
    rotations = np.full((*sigma.shape, 4), np.nan)
    for number, messages in enumerate(parts):
        for message in messages:
            row = np.searchsorted(grid, message.stamp_ns)
            for body in message.bodies:
                clip = number * SIDE_BY_SIDE + body.id
                positions[row, clip], sigma[row, clip] = body.positions, body.sigma
                anomaly[row, clip], flagged[row, clip] = body.anomaly, body.anomaly_flag
                rotations[row, clip] = body.rotations
    return Cleaned(grid * 1e-9, positions, sigma, anomaly, flagged, rotations)


def stream(
    prior: PriorPipeline, seen: Floats, stamps_s: Floats, skeleton: str = "smpl22", calibrated: bool = False
) -> Iterator[PoseClean]:
    """Return the prior's output for clips (T, C, J, 3) side by side, as the bodies 0 to C - 1 of one stream."""
    joints = ~missing(seen)
    any_seen = np.asarray(joints.any(axis=2))
    frames = len(seen) - any_seen[::-1].argmax(axis=0)
    for t in np.flatnonzero(any_seen.any(axis=1)):
        bodies = [RawBody(int(c), seen[t, c], joints[t, c].astype(float)) for c in np.flatnonzero(t < frames)]
        stamp_ns = round(stamps_s[t] * 1e9)
        yield from prior.process(PoseRaw(stamp_ns, "world", "bench", skeleton, Pose.identity(), calibrated, bodies))
    yield from prior.flush()
