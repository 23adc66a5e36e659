"""What a fit owes to HuMoR: to its third stage, to each term of its energy (the paper's Table 6), and to its variables.

Methods are paired by clip. A stage 2 with the steps of both stages is searched as hard; latents are rolled out by
`humor_rollout`.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from steadypose.benchmarks import product
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.intervals import interval
from steadypose.benchmarks.metrics import position_error
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import CLEAN_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.humor_fits import (
    CAMERA_HEIGHT,
    HIDDEN_BELOW,
    NOISE,
    Answer,
    camera_settings,
    corrupted,
    fitted,
    load_labels,
    pictures,
    scores,
    seen_joints,
    shipped,
    starts_of,
)
from steadypose.benchmarks.studies.humor_rollout import PHASES, fit_rolled_out
from steadypose.prior.arrays import Floats
from steadypose.prior.fit.energy import Standing, Transitions
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.solve import FitSettings, Start

DEPENDS_ON = (*CLEAN_22, "humor weights", "prior.fit")

SMOOTH = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Smoothness of stage 2, m/s²."""
DELAY = 8
"""Delay of the live output from which fits start, frames."""
CLIPS, FRAMES = 24, 90
"""Number of clips, taken evenly from all sources of the split, and their length, frames."""
KEY_POINTS, ROLLED = 2, 3
"""Every second clip is fitted to key points, every third with latents that are rolled out."""
CONDITIONS = {"4 cm of noise": (NOISE, 0.0), "hidden below 0.9 m": (0.0, HIDDEN_BELOW)}
AS_IT_SHIPS, STAGE_2, CLEANED = "as it ships", "stage 2 alone, tuned", "`clean`, from which fits start"
FULL, ROLLED_OUT = "full energy", "latents rolled out"

_OFF = 1e6
_NO_CVAE = FitSettings(transitions=Transitions(_OFF, _OFF, _OFF))
VARIANTS: Mapping[str, FitSettings] = {
    AS_IT_SHIPS: FitSettings(),
    "stage 3 always": FitSettings(discrepancy=np.inf),
    "no CVAE": _NO_CVAE,
    "no CVAE, no contacts": replace(_NO_CVAE, standing=Standing(_OFF, _OFF)),
}
TERMS: Mapping[str, Mapping[str, Any]] = {
    FULL: {},
    "no E_init": {"first_sigma": _OFF},
    "no E_CVAE": {"transitions": Transitions(latent_sigma=_OFF)},
    "no E_c (joints of a step)": {"transitions": Transitions(joints_sigma=_OFF)},
    "no E_skel (joints and rotations)": {"transitions": Transitions(_OFF, _OFF)},
    "no E_env": {"standing": Standing(_OFF, _OFF)},
    "no E_shape": {"bones_sigma": _OFF},
    "no smoothness (not in the paper)": {"motion_smooth_sigma": _OFF},
}
"""Settings of stage 3 without each term. The paper's E_b, bones of constant length, holds by construction."""


def run(bench: Bench) -> Result:
    """Make all tables."""
    clips = bench.clips(FRAMES, 2 if bench.quick else CLIPS)
    model, count = shipped(), len(clips.offsets)
    phases = [(1, poses) for _, poses in PHASES] if bench.quick else PHASES
    records = {
        "credit": credit(bench, model, clips),
        "terms": terms(bench, model, clips, range(0, count, KEY_POINTS)),
        "rolled": rolled(model, clips, range(0, count, ROLLED), phases),
    }
    tables = [credit_table(records["credit"], count), terms_table(records["terms"]), rolled_table(records["rolled"])]
    return Result(tables, {"data": clips.source, "records": records})


def cleaned(clips: MotionClips, seen: Floats) -> product.Cleaned:
    """Return `clean`'s live output for clips (T, C, 22, 3), metres, from which fits start."""
    return product.run(product.PRODUCT["steadypose"], seen, clips.stamps_s, DELAY)


def credit(bench: Bench, model: HumorNet, clips: MotionClips) -> list[dict[str, Any]]:
    """Return a record for each condition and variant: millimetres per person, and the difference from the fit as it
    ships."""
    records = []
    for condition, (noise, below) in CONDITIONS.items():
        seen, tuning = (corrupted(clips.positions, noise, below, seed) for seed in (0, 1))
        some = range(0, len(clips.offsets), 3)
        live = cleaned(clips, seen)
        starts, tuning_starts = (starts_of(each, len(seen)) for each in (live, cleaned(clips, tuning)))
        steps = FitSettings().pose_steps + FitSettings().motion_steps
        stage_2 = min(
            (replace(FitSettings(), smooth_sigma=smooth, pose_steps=steps) for smooth in SMOOTH),
            key=lambda settings: errors(model, clips, tuning_starts, tuning, settings, 2, some).mean(),
        )
        fits = {name: (settings, 3) for name, settings in VARIANTS.items()} | {STAGE_2: (stage_2, 2)}
        found = {
            name: errors(model, clips, starts, seen, settings, stages, range(len(clips.offsets)))
            for name, (settings, stages) in bench.progress.track(fits.items(), description=f"credit, {condition}")
        }
        each = (values.swapaxes(0, 1) for values in (live.positions[-len(seen) :], clips.positions, seen))
        found[CLEANED] = np.array([_error(*one) for one in zip(*each, strict=True)])
        for name, each in found.items():
            records.append({
                "condition": condition, "method": name,
                "smooth_sigma": stage_2.smooth_sigma if name == STAGE_2 else FitSettings().smooth_sigma,
                **_paired(each, found[AS_IT_SHIPS], clips.person),
            })  # fmt: skip
    return records


def _paired(each: Floats, other: Floats, person: Any) -> dict[str, Any]:
    """Means over people and 95 % intervals of errors (C,), metres, and of their differences from other ones."""
    own, more = interval(each, person), interval(each - other, person)
    return {
        "mm": [round(1e3 * value, 3) for value in own[:3]],
        "more_mm": [round(1e3 * value, 3) for value in more[:3]],
        "people": own.people,
        "clips_mm": [round(1e3 * value, 3) for value in each.tolist()],
    }


def errors(
    model: HumorNet, clips: MotionClips, starts: Sequence[Start], seen: Floats, settings: FitSettings, stages: int,
    which: Iterable[int],
) -> Floats:  # fmt: skip
    """Return the errors of each clip, metres: of the hidden joints if there are any, otherwise of all."""
    found = []
    for c in which:
        answer = fitted(model, [starts[c]], seen_joints(seen[:, c]), stages, settings)
        found.append(_error(answer.joints, clips.positions[:, c], seen[:, c]))
    return np.array(found)


def _error(joints: Floats, truth: Floats, seen: Floats) -> float:
    error, hidden = position_error(joints, truth), np.isnan(seen[..., 0])
    return float(error[hidden].mean() if hidden.any() else error.mean())


def terms(bench: Bench, model: HumorNet, clips: MotionClips, which: Sequence[int]) -> list[dict[str, Any]]:
    """Fit key points of a simulated detector by stage 3, always kept, without each term of its energy."""
    taken = [pictures(clips, c, np.random.default_rng((1, c))) for c in which]
    truth, seen = (np.stack([getattr(one, name) for one in taken], axis=1) for name in ("truth", "seen"))
    load, person = load_labels(clips)[:, which], clips.person[which]
    records: list[dict[str, Any]] = []
    full = np.zeros(len(taken))
    for name, changed in bench.progress.track(TERMS.items(), description="terms"):
        settings = replace(camera_settings(), discrepancy=np.inf, **changed)
        answers = [fitted(model, one.flat.starts, one.flat.observed, 3, settings) for one in taken]
        each = np.array([position_error(a.joints, one.truth).mean() for a, one in zip(answers, taken, strict=True)])
        full = each if name == FULL else full
        figures = scores(answers, truth, ~seen, load, -CAMERA_HEIGHT)
        records.append({"method": name, **_paired(each, full, person), **figures})
    return records


def rolled(
    model: HumorNet, clips: MotionClips, which: Sequence[int], phases: Sequence[tuple[int, bool]]
) -> list[dict[str, Any]]:
    """Fit noisy joints by stage 3 with all poses as variables, and with the first state and latents."""
    seen, settings = corrupted(clips.positions, NOISE, 0.0, 0), FitSettings(discrepancy=np.inf)
    every = starts_of(cleaned(clips, seen), len(seen))
    starts = [every[c] for c in which]
    observed = [seen_joints(seen[:, c]) for c in which]
    fits = [fitted(model, [start], one, 3, settings) for start, one in zip(starts, observed, strict=True)]
    began = time.process_time()
    motions = fit_rolled_out(model, starts, observed, settings, phases)
    seconds = (time.process_time() - began) / len(motions)
    found = {FULL: fits, ROLLED_OUT: [Answer(m.world_joints.double().numpy(), None, seconds) for m in motions]}
    truth, load = clips.positions[:, which], load_labels(clips)[:, which]
    each = {
        name: np.array([position_error(a.joints, truth[:, c]).mean() for c, a in enumerate(answers)])
        for name, answers in found.items()
    }
    return [
        {
            "method": name,
            **_paired(each[name], each[FULL], clips.person[which]),
            **scores(answers, truth, np.isnan(seen[..., 0])[:, which], load),
        }
        for name, answers in found.items()
    ]


def credit_table(records: Sequence[Mapping[str, Any]], clips: int) -> Table:
    """Build a table with a row for each condition and variant."""
    return Table(
        "humor_credit",
        "What the fit owes to HuMoR: error of joints, of hidden ones where some are, mm",
        ["method", "mean over people", "more than as it ships"],
        [[f"{r['condition']}: {r['method']}", *_cells(r)] for r in records],
        f"{clips} clips of 3 s, {records[0]['people']} people; in brackets, the 95 % interval over people, of "
        "the second column of paired differences. Stage 2 has the steps of both stages; its smoothness was searched.",
    )


def terms_table(records: Sequence[Mapping[str, Any]]) -> Table:
    """Build the paper's Table 6."""
    return Table(
        "humor_terms",
        "Stage 3 from key points of a simulated detector, without each term of its energy (HuMoR's Table 6)",
        ["method", "all, mm", "more than full", "hidden, mm", "legs, mm", "from the root, mm", "acceleration, m/s²",
         "penetration, %", "contact accuracy"],
        [
            [r["method"], *_cells(r), *(f"{r[key]:.1f}" for key in (
                "hidden_mm", "legs_mm", "rooted_mm", "acceleration_m_s2", "penetration_percent")),
             f"{r['contact_accuracy']:.3f}"]
            for r in records
        ],
        f"{len(records[0]['clips_mm'])} clips of 3 s, {records[0]['people']} people. Stage 3 is kept always. The "
        "paper's E_b holds by construction, for bones are constant; E_c and E_skel tie poses to the decoder's.",
    )  # fmt: skip


def rolled_table(records: Sequence[Mapping[str, Any]]) -> Table:
    """Build the comparison of both kinds of variables."""
    return Table(
        "humor_rollout",
        f"{NOISE * 100:.0f} cm of noise: the same energy with all poses as variables, and with latents rolled out",
        ["method", "all, mm", "more", "acceleration, m/s²", "penetration, %", "s a clip"],
        [
            [r["method"], *_cells(r), *(f"{r[key]:.1f}" for key in (
                "acceleration_m_s2", "penetration_percent", "seconds"))]
            for r in records
        ],
        f"{len(records[0]['clips_mm'])} clips of 3 s, {records[0]['people']} people. Rolled out as in the official "
        f"code: all clips at once, {sum(steps for steps, _ in PHASES)} steps of up to 20 iterations. Seconds are of a "
        "processor.",
    )  # fmt: skip


def _cells(record: Mapping[str, Any]) -> list[str]:
    return [f"{m:.1f} ({low:.1f} to {high:.1f})" for m, low, high in (record["mm"], record["more_mm"])]
