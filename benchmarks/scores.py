"""Scores of a method over clips: one number per clip, means over people with their intervals, and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.intervals import interval, ratio
from steadypose.benchmarks.metrics import acceleration_error, length_variation, position_error, procrustes
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import NONE, Table
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import JOINTS, PARENTS
from steadypose.prior.timing.rate import FPS

LIMBS: Mapping[str, NDArray[np.intp]] = {
    limb: np.array([j for j, name in enumerate(JOINTS) if name.rpartition("_")[2] in parts])
    for limb, parts in {
        "trunk": {"pelvis", "spine1", "spine2", "spine3", "neck", "head", "collar"},
        "arms": {"shoulder", "elbow", "wrist"},
        "legs": {"hip", "knee", "ankle", "foot"},
    }.items()
}
_BONES = tuple((joint, parent) for joint, parent in enumerate(PARENTS) if parent >= 0)

MPS2 = FPS**2 * 1e-3
"""Acceleration in m/s² of one mm/frame²."""


@dataclass(frozen=True)
class Scores:
    """One number per clip, (C,), NaN where a clip has no such joint."""

    position: Floats  # metres: MPJPE
    seen: Floats  # metres, of observed joints
    hidden: Floats  # metres, of hidden joints
    aligned: Floats  # metres: PA-MPJPE, each frame rotated, translated and scaled
    acceleration: Floats  # metres/frame²
    acceleration_error: Floats  # metres/frame²
    variation: Floats  # of bone lengths, relative
    answered: Floats  # share of the hidden joints that have an estimate
    limbs: Mapping[str, Floats]  # metres


def score(answer: Floats, truth: Floats, hidden: NDArray[np.bool_], align: bool = True) -> Scores:
    """Compare (T, C, 22, 3) metres; ``hidden`` (T, C, 22). Without ``align``, PA-MPJPE and bones are left out."""
    error = position_error(answer, truth)
    unknown = np.full(answer.shape[1], np.nan)
    return Scores(
        position=_mean(error),
        seen=_mean(np.where(hidden, np.nan, error)),
        hidden=_mean(np.where(hidden, error, np.nan)),
        aligned=_mean(position_error(procrustes(answer, truth), truth)) if align else unknown,
        acceleration=_mean(np.linalg.norm(np.diff(answer, n=2, axis=0), axis=-1)),
        acceleration_error=_mean(acceleration_error(answer, truth)),
        variation=np.array([length_variation(clip, _BONES) for clip in answer.swapaxes(0, 1)]) if align else unknown,
        answered=_mean(np.where(hidden, np.isfinite(error).astype(float), np.nan)),
        limbs={limb: _mean(error[..., joints]) for limb, joints in LIMBS.items()},
    )  # fmt: skip


def figures(scores: Scores, people: NDArray[np.str_] | None = None) -> dict[str, Any]:
    """Return means over C clips: mm, mm/frame², m/s², per cent; with 95 % intervals over ``people`` (C,) of the main
    figures.
    """
    deciding = {"position": scores.position, "hidden": scores.hidden, "acceleration": scores.acceleration_error}
    intervals = {} if people is None else {f"{name}_ci_mm": ends_mm(v, people) for name, v in deciding.items()}
    result: dict[str, Any] = {
        "position_mm": _mm(scores.position),
        "seen_mm": _mm(scores.seen),
        "hidden_mm": _mm(scores.hidden),
        "hidden_answered_percent": _percent(scores.answered),
        "pa_mm": _mm(scores.aligned),
        "acceleration_mm": _mm(scores.acceleration_error),
        "acceleration_m_s2": round(_mm(scores.acceleration_error) * MPS2, 3),
        "own_acceleration_mm": _mm(scores.acceleration),
        "bone_variation_percent": _percent(scores.variation),
        "limbs_mm": {limb: _mm(values) for limb, values in scores.limbs.items()},
        **intervals,
    }
    return {name: value for name, value in result.items() if not (isinstance(value, float) and np.isnan(value))}


def ends_mm(values: Floats, people: NDArray[np.str_]) -> list[float] | None:
    """Return the 95 % interval over people of the mean of (C,) metres, mm; None where there is no value."""
    found = interval(values, people)
    return [round(end * 1e3, 3) for end in (found.low, found.high)] if found.people else None


def pivot(
    records: Sequence[Mapping[str, Any]], column: str, figure: str, name: str, title: str, note: str, digits: int = 1
) -> Table:
    """Build a table with a row for each method and delay, and a column for each value of ``column``; text is kept as it
    is."""
    columns = list(dict.fromkeys(record[column] for record in records))
    rows: dict[tuple[str, int], dict[str, str]] = {}
    for record in records:
        value = record.get(figure)
        cell = "–" if value is None else value if isinstance(value, str) else f"{value:.{digits}f}"
        rows.setdefault((record["method"], record["delay"]), {})[record[column]] = cell
    return Table(
        name=name,
        title=title,
        columns=["method", "delay, frames", *columns],
        rows=[
            [method, "offline" if delay < 0 else str(delay), *(cells.get(c, "–") for c in columns)]
            for (method, delay), cells in sorted(rows.items(), key=lambda item: _order(records, item[0]))
        ],
        note=note,
    )


def _order(records: Sequence[Mapping[str, Any]], row: tuple[str, int]) -> tuple[int, int]:
    """Order methods as they were run, each by delay."""
    return list(dict.fromkeys(record["method"] for record in records)).index(row[0]), row[1]


def _mean(values: Floats) -> Floats:
    """Return the mean over the frames and joints of every clip: (T, C, J) to (C,)."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=(0, 2)), known.sum(axis=(0, 2))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mm(values: Floats) -> float:
    return round(_over_clips(values) * 1e3, 3)


def _percent(values: Floats) -> float:
    return round(_over_clips(values) * 1e2, 3)


def _over_clips(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


_LEAST = 1e-6
"""Lower bound of the errors in a ratio, metres."""


def source_table(
    name: str, title: str, errors: Mapping[tuple[str, str], NDArray[np.float64]], clips: MotionClips, baseline: str
) -> Table:
    """Build a table with a column for each source, the mean over people, and its ratio to ``baseline`` in the same
    condition.

    ``errors`` are (C,) metres by condition and method, NaN for a clip without such an error.
    """
    sources = list(dict.fromkeys(clips.data_set.tolist()))
    rows = []
    for (condition, method), found in errors.items():
        by_source = [interval(found[clips.data_set == s], clips.person[clips.data_set == s]).mean for s in sources]
        of_baseline = ratio(np.maximum(found, _LEAST), np.maximum(errors[condition, baseline], _LEAST), clips.person)
        rows.append([
            f"{condition}: {method}", *(NONE if np.isnan(mean) else f"{1e3 * mean:.1f}" for mean in by_source),
            interval(found, clips.person).text(1, 1e3), of_baseline.text(2),
        ])  # fmt: skip
    note = (
        f"{len(clips.offsets)} clips of {len(set(clips.person.tolist()))} people, each of whom counts once; in "
        "brackets, the 95 % interval over people."
    )
    return Table(name, title, ["", *sources, "mean over people", f"of: {baseline}"], rows, note)
