"""What the fit owes to the model of motion: the same fit without it, paired clip by clip, each person once.

Stage 2 alone has the steps of both stages, and the smoothness that is best of `SMOOTH` on every third clip with other
noise. Without the CVAE, latents only move what the decoder takes for contacts; without both, feet are not held at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks import ours
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.intervals import interval
from steadypose.benchmarks.metrics import position_error
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.studies.humor_fits import HIDDEN_BELOW, NOISE, fitted, seen_joints, start_of
from steadypose.prior.fit.energy import Standing, Transitions
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.solve import FitSettings

Floats = NDArray[np.float64]

SMOOTH = (4.0, 8.0, 16.0, 32.0, 64.0)
"""m/s², of stage 2."""
DELAY = 8
CONDITIONS = {"4 cm of noise": (NOISE, 0.0), "hidden below 0.9 m": (0.0, HIDDEN_BELOW)}
AS_IT_SHIPS, STAGE_2 = "as it ships", "stage 2 alone, tuned"

_OFF = 1e6
_NO_CVAE = FitSettings(transitions=Transitions(_OFF, _OFF, _OFF))
VARIANTS: Mapping[str, FitSettings] = {
    AS_IT_SHIPS: FitSettings(),
    "no CVAE": _NO_CVAE,
    "no CVAE, no contacts": replace(_NO_CVAE, standing=Standing(_OFF, _OFF)),
}


def credit(bench: Bench, model: HumorNet, clips: MotionClips) -> list[dict[str, Any]]:
    """A record for each condition and variant: millimetres a person, and what it adds to the fit as it ships."""
    records = []
    for condition, (noise, below) in CONDITIONS.items():
        seen, tuning = (spoiled(clips.positions, noise, below, seed) for seed in (0, 1))
        some = range(0, len(clips.offsets), 3)
        starts, tuning_starts = (
            ours.run(ours.OURS["steadypose"], one, clips.stamps_s, DELAY).positions[-len(one) :]
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


def spoiled(truth: Floats, noise: float, below: float, seed: int) -> Floats:
    """(T, C, 22, 3) with noise, metres, and NaN where truth is lower than ``below``, metres."""
    seen = truth + noise * np.random.default_rng(seed).standard_normal(truth.shape)
    seen[truth[..., 2] < below] = np.nan
    return seen


def errors(
    model: HumorNet, clips: MotionClips, starts: Floats, seen: Floats, settings: FitSettings, stages: int,
    which: Iterable[int],
) -> Floats:  # fmt: skip
    """Metres, of each of some clips: of the joints that were hidden where any are, else of all."""
    found = []
    for c in which:
        answer = fitted(model, [start_of(starts[:, c])], seen_joints(seen[:, c]), stages, settings)
        error, hidden = position_error(answer.joints, clips.positions[:, c]), np.isnan(seen[:, c, :, 0])
        found.append(error[hidden].mean() if hidden.any() else error.mean())
    return np.array(found)


def credit_table(records: Sequence[Mapping[str, Any]], clips: int) -> Table:
    """A row a condition and variant."""
    return Table(
        "humor-credit",
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
