"""What a fit owes to HuMoR: the same fit without its transition model and contacts, paired by clip.

A stage 2 with the steps of both stages is searched as hard.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from steadypose.benchmarks import product
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.intervals import interval
from steadypose.benchmarks.metrics import position_error
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.humor_fits import (
    HIDDEN_BELOW,
    NOISE,
    corrupted,
    fitted,
    seen_joints,
    shipped,
    start_of,
)
from steadypose.prior.arrays import Floats
from steadypose.prior.fit.energy import Standing, Transitions
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.solve import FitSettings

DEPENDS_ON = (*CLEAN, "humor weights", "prior.fit")

SMOOTH = (4.0, 8.0, 16.0, 32.0, 64.0)
"""Smoothness of stage 2, m/s²."""
DELAY = 8
"""Delay of the live output from which fits start, frames."""
CLIPS, FRAMES = 24, 90
"""Number of clips, taken evenly from all sources of the split, and their length, frames."""
CONDITIONS = {"4 cm of noise": (NOISE, 0.0), "hidden below 0.9 m": (0.0, HIDDEN_BELOW)}
AS_IT_SHIPS, STAGE_2 = "as it ships", "stage 2 alone, tuned"

_OFF = 1e6
_NO_CVAE = FitSettings(transitions=Transitions(_OFF, _OFF, _OFF))
VARIANTS: Mapping[str, FitSettings] = {
    AS_IT_SHIPS: FitSettings(),
    "no CVAE": _NO_CVAE,
    "no CVAE, no contacts": replace(_NO_CVAE, standing=Standing(_OFF, _OFF)),
}


def run(bench: Bench) -> Result:
    """Fit every clip with and without each part."""
    clips = bench.clips(FRAMES, 2 if bench.quick else CLIPS)
    records = credit(bench, shipped(), clips)
    return Result([credit_table(records, len(clips.offsets))], {"data": clips.source, "records": records})


def credit(bench: Bench, model: HumorNet, clips: MotionClips) -> list[dict[str, Any]]:
    """Return a record for each condition and variant: millimetres per person, and the difference from the fit as it
    ships."""
    records = []
    for condition, (noise, below) in CONDITIONS.items():
        seen, tuning = (corrupted(clips.positions, noise, below, seed) for seed in (0, 1))
        some = range(0, len(clips.offsets), 3)
        starts, tuning_starts = (
            product.run(product.PRODUCT["steadypose"], one, clips.stamps_s, DELAY).positions[-len(one) :]
            for one in (seen, tuning)
        )
        stage_2 = min(
            (
                replace(
                    FitSettings(), smooth_sigma=smooth, pose_steps=FitSettings().pose_steps + FitSettings().motion_steps
                )
                for smooth in SMOOTH
            ),
            key=lambda settings: errors(model, clips, tuning_starts, tuning, settings, 2, some).mean(),
        )
        fits = {name: (settings, 3) for name, settings in VARIANTS.items()} | {STAGE_2: (stage_2, 2)}
        found = {
            name: errors(model, clips, starts, seen, settings, stages, range(len(clips.offsets)))
            for name, (settings, stages) in bench.progress.track(fits.items(), description=f"credit, {condition}")
        }
        for name, (settings, _) in fits.items():
            own = interval(found[name], clips.person)
            more = interval(found[name] - found[AS_IT_SHIPS], clips.person)
            records.append({
                "condition": condition, "method": name, "smooth_sigma": settings.smooth_sigma,
                "mm": [round(1e3 * value, 3) for value in own[:3]],
                "more_mm": [round(1e3 * value, 3) for value in more[:3]], "people": own.people,
                "clips_mm": [round(1e3 * value, 3) for value in found[name].tolist()],
            })  # fmt: skip
    return records


def errors(
    model: HumorNet, clips: MotionClips, starts: Floats, seen: Floats, settings: FitSettings, stages: int,
    which: Iterable[int],
) -> Floats:  # fmt: skip
    """Return the errors of each clip, metres: of the hidden joints if there are any, otherwise of all."""
    found = []
    for c in which:
        answer = fitted(model, [start_of(starts[:, c])], seen_joints(seen[:, c]), stages, settings)
        error, hidden = position_error(answer.joints, clips.positions[:, c]), np.isnan(seen[:, c, :, 0])
        found.append(error[hidden].mean() if hidden.any() else error.mean())
    return np.array(found)


def credit_table(records: Sequence[Mapping[str, Any]], clips: int) -> Table:
    """Build a table with a row for each condition and variant."""
    return Table(
        "humor_credit",
        "What the fit owes to HuMoR: error of joints, of hidden ones where some are, mm",
        ["method", "mean over people", "more than as it ships"],
        [
            [
                f"{r['condition']}: {r['method']}",
                *(f"{m:.1f} ({low:.1f} to {high:.1f})" for m, low, high in (r["mm"], r["more_mm"])),
            ]
            for r in records
        ],
        f"{clips} clips of 3 s, {records[0]['people']} people; in brackets, the 95 % interval over people, of "
        "the second column of paired differences. Stage 2 has the steps of both stages; its smoothness was searched.",
    )
