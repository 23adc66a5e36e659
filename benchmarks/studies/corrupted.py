"""Shared code of the studies of corrupted joints: run every method in each condition over validation motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.baselines.filters import BASELINES, OFFLINE, Baseline, missing
from steadypose.benchmarks.bench import RECURRENT, Answer, Bench, Methods, answers, over_seeds, tune, tuning_log
from steadypose.benchmarks.intervals import ratio
from steadypose.benchmarks.metrics import position_error, reliability, sigma_ratio
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.product import PRODUCT
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.scores import Scores, figures, pivot, score, source_table
from steadypose.prior.arrays import Floats

Condition = Callable[[Floats, np.random.Generator], Floats]
"""Maps true joints (T, C, 22, 3) to observed ones."""

TUNED_ON = 3
"""Step between the clips on which baselines are tuned. They are among the clips that are scored, with other noise,
which favours the baselines."""

HOW = (
    "Baselines are tuned on every third of these clips with other noise, each with the same number of evaluations, for "
    "the least sum of position error (mm) and acceleration error (mm/frame²); steadypose runs as it ships. A "
    "delayed Kalman filter is a fixed-lag RTS smoother. SmoothNet-style and GRU: trained on motion that steadypose is "
    "trained on, corrupted in these ways; the first a mean over seeds."
)


WHOLE_BODY = "whole-body bank"
BY_SOURCE = ("bank of smoothers", WHOLE_BODY, RECURRENT, "conditional Gaussian", "steadypose")
"""Methods in the tables by source, as far as a study has them."""


def by_source(
    records: Sequence[Mapping[str, Any]], error: str, delay: int, clips: MotionClips, name: str, title: str
) -> Table:
    """Build a table by source of motion from `run_conditions`: ``error`` is ``position`` or ``hidden``."""
    found = {
        (r["condition"], r["method"]): 1e-3 * np.array(r["clips_mm"][error], dtype=float)
        for r in records
        if r["method"] in BY_SOURCE and r["delay"] in (delay, 0)
    }
    return source_table(name, f"{title}, by source, mm, delay {delay}", found, clips, WHOLE_BODY)


def run_conditions(
    bench: Bench, clips: MotionClips, conditions: Mapping[str, Condition], baselines: Sequence[Baseline] = BASELINES
) -> dict[str, Any]:
    """Run every method in every condition; return records, calibration and the evaluated parameters.

    Records have ``condition``, ``method``, ``delay``, and `figures`. If a baseline runs at their delay, steadypose's
    records also have the ratio of their errors to those of the best such baseline.
    """
    records: list[dict[str, Any]] = []
    calibration: list[dict[str, Any]] = []
    tried: dict[str, Any] = {}
    for number, (name, corrupt) in enumerate(conditions.items()):
        some = clips.every(TUNED_ON)
        tuning_observed = corrupt(some.positions, np.random.default_rng((number, 1)))

        def evaluate(
            baseline: Baseline,
            delay: int,
            parameters: Mapping[str, float],
            truth: Floats = some.positions,
            tuning_observed: Floats = tuning_observed,
        ) -> dict[str, float]:
            answer = baseline.run(tuning_observed, clips.stamps_s, delay, **parameters)
            found = figures(score(answer, truth, missing(tuning_observed), align=False))
            return {key: found[key] for key in ("position_mm", "acceleration_mm")}

        tuned = tune(bench, evaluate, name, baselines)
        tried[name] = tuning_log(tuned)
        seen = corrupt(clips.positions, np.random.default_rng((number, 0)))
        hidden = missing(seen)
        scored: list[tuple[Answer, Scores]] = []
        for answer in answers(bench, seen, clips.stamps_s, tuned, name, Methods.all(bench, baselines)):
            scored.append((answer, score(answer.positions, clips.positions, hidden)))
            if answer.sigma is not None:
                error = position_error(answer.positions, clips.positions)
                row = {"condition": name, "method": answer.method, "delay": answer.delay}
                calibration.append({**row, **_calibration(error, answer.sigma, hidden)})
        records += over_seeds([_record(name, *one, scored, clips.person) for one in scored])
    return {"records": records, "calibration": calibration, "tuning": tried}


def _record(
    condition: str, answer: Answer, scores: Scores, scored: Sequence[tuple[Answer, Scores]], people: NDArray[np.str_]
) -> dict[str, Any]:
    record: dict[str, Any] = {
        "condition": condition,
        "method": answer.method,
        "delay": answer.delay,
        "parameters": dict(answer.parameters),
        **figures(scores, people),
    }
    if answer.method in BY_SOURCE:
        by_clip = {"position": scores.position, "hidden": scores.hidden}
        record["clips_mm"] = {key: np.round(1e3 * values, 3).tolist() for key, values in by_clip.items()}
    if answer.method in PRODUCT:
        record["against_best_baseline"] = against_best(answer, scores, scored, people)
    return record


def against_best(
    answer: Answer, scores: Scores, scored: Sequence[tuple[Answer, Scores]], people: NDArray[np.str_]
) -> dict[str, Any]:
    """Return ratios of errors, with their 95 % intervals over people, to the best baseline that needs no longer delay.

    The best baseline is the one with the least error of that kind, so it may differ between errors.
    """
    rivals = [(a, s) for a, s in scored if a.method not in PRODUCT and a.delay <= answer.delay and a.delay != OFFLINE]
    ratios: dict[str, Any] = {}
    for name in ("position", "seen", "hidden", "acceleration_error"):
        mine = getattr(scores, name)
        usable = [(a, getattr(s, name)) for a, s in rivals]
        known = np.isfinite(mine)
        # a baseline without an estimate for some joints does not count as the best
        usable = [(a, theirs) for a, theirs in usable if known.any() and np.isfinite(theirs[known]).all()]
        if usable:
            rival, theirs = min(usable, key=lambda pair: float(pair[1][known].mean()))
            found = ratio(mine, theirs, people)[:3]
            ratios[name] = {"baseline": f"{rival.method}, delay {rival.delay}", "ratio": [round(v, 4) for v in found]}
    return ratios


def _calibration(error: Floats, sigma: Floats, hidden: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the error-to-sigma ratio of observed and hidden joints, and the points of a reliability plot."""
    return {
        group: {
            "ratio": round(sigma_ratio(error[mask], sigma[mask]), 3),
            "bins_m": reliability(error[mask], sigma[mask]),
        }
        for group, mask in (("seen", ~hidden), ("hidden", hidden))
        if mask.any()
    }


def reliability_bins(calibration: Sequence[Mapping[str, Any]], method: str, delay: int) -> dict[str, Any]:
    """Return one method's points of the reliability plot by condition and group."""
    return {
        f"{row['condition']}, {group}": row[group]["bins_m"]
        for row in calibration
        if (row["method"], row["delay"]) == (method, delay)
        for group in ("seen", "hidden")
        if group in row
    }


def calibration_table(calibration: Sequence[Mapping[str, Any]], name: str) -> Table:
    """Build a table of the error-to-sigma ratio by condition: observed joints, and after a slash hidden ones."""
    records = [
        {**row, "cell": " / ".join(f"{row[group]['ratio']:.2f}" for group in ("seen", "hidden") if group in row)}
        for row in calibration
    ]
    hidden = any("hidden" in row for row in calibration)
    return pivot(
        records,
        "condition",
        "cell",
        name,
        "Error found by standard deviation stated" + (": seen / hidden joints" if hidden else ""),
        "Root mean square of their ratio along an axis: 1 is honest, above is too sure of itself.",
    )
