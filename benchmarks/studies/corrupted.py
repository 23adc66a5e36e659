"""Shared code of the studies of corrupted joints: run every method in each condition over validation motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import BASELINES, Baseline, missing
from steadypose.benchmarks.bench import (
    RECURRENT,
    TUNED_ON,
    Answer,
    Bench,
    Methods,
    answers,
    over_seeds,
    tune_on,
    tuning_log,
)
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.scores import (
    Scores,
    figures,
    pivot,
    position_error,
    reliability,
    score,
    sigma_ratio,
    source_table,
)
from steadypose.prior.arrays import Floats

Condition = Callable[[Floats, np.random.Generator], Floats]  # maps true joints (T, C, 22, 3) to observed ones

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

    Records have ``condition``, ``method``, ``delay``, and `figures`.
    """
    records: list[dict[str, Any]] = []
    calibration: list[dict[str, Any]] = []
    tried: dict[str, Any] = {}
    some, methods = clips.every(TUNED_ON), Methods(baselines, product.PRODUCT, bench.delays)
    for number, (name, corrupt) in enumerate(conditions.items()):
        other = corrupt(some.positions, np.random.default_rng((number, 1)))
        tuned = tune_on(bench, other, some.positions, clips.stamps_s, name, baselines)
        tried[name] = tuning_log(tuned)
        seen = corrupt(clips.positions, np.random.default_rng((number, 0)))
        hidden = missing(seen)
        scored: list[dict[str, Any]] = []
        for answer in answers(bench, seen, clips.stamps_s, tuned, name, methods):
            scored.append(_record(name, answer, score(answer.positions, clips.positions, hidden)))
            if answer.sigma is not None:
                error = position_error(answer.positions, clips.positions)
                row = {"condition": name, "method": answer.method, "delay": answer.delay}
                calibration.append({**row, **_calibration(error, answer.sigma, hidden)})
        records += over_seeds(scored)
    return {"records": records, "calibration": calibration, "tuning": tried}


def _record(condition: str, answer: Answer, scores: Scores) -> dict[str, Any]:
    record: dict[str, Any] = {
        "condition": condition,
        "method": answer.method,
        "delay": answer.delay,
        "parameters": dict(answer.parameters),
        **figures(scores),
    }
    if answer.method in BY_SOURCE:
        by_clip = {"position": scores.position, "hidden": scores.hidden}
        record["clips_mm"] = {key: np.round(1e3 * values, 3).tolist() for key, values in by_clip.items()}
    return record


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
        records, "condition", "cell", name,
        "Error-to-sigma ratio" + (": observed / hidden joints" if hidden else ""),
        "Root mean square of their ratio along an axis: 1 is honest, above is too sure of itself.",
    )  # fmt: skip
