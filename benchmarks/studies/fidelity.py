"""Fidelity: error of cleaned motion by a joint's true speed, its noise, and the delay.

A noise-free input must stay unchanged. Bodies stand 3 m before a camera at the origin. Noise is white and isotropic, or
three times as large along the line of sight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks import figures as pictures
from steadypose.benchmarks.baselines.filters import FILTERS
from steadypose.benchmarks.bench import TUNED_ON, Answer, Bench, Methods, answers, tune_on, tuning_log
from steadypose.benchmarks.corruption import along_sight, gaussian
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.product import PRODUCT
from steadypose.benchmarks.provenance import CLEAN_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import (
    acceleration_error,
    errors_mm,
    mean_mm,
    pivot,
    position_error,
    sigma_ratio,
    source_table,
)
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import J
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = CLEAN_22

DELAYS = (0, 2, 4, 8, 16)
SPEEDS = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, np.inf)  # edges of the speed bins, m/s
CLIPS, FRAMES = 24, 90
NOISES_M = (0.0, 0.002, 0.01, 0.02, 0.04)
CAMERA = (3.0, 0.0, 1.2)  # camera position relative to the point below the pelvis in the middle of a clip, metres


def conditions(quick: bool) -> dict[str, Callable[[Floats, np.random.Generator], Floats]]:
    """Return corruptions of joints (T, C, 22, 3) before a camera at the origin, by name."""
    levels = (0.0, 0.01) if quick else NOISES_M
    same = {_noise_name(level): lambda truth, rng, level=level: gaussian(truth, level, rng) for level in levels}
    more = {
        f"{_noise_name(level)}, depth x3": lambda truth, rng, level=level: along_sight(truth, level, rng)
        for level in levels
        if level
    }
    return {**same, **({} if quick else more)}


def _noise_name(level: float) -> str:
    return "none" if not level else f"{1000 * level:g} mm" if level < 0.01 else f"{100 * level:g} cm"


def methods(bench: Bench) -> Methods:
    """Return the filters and what ships. Other studies have the other variants."""
    return Methods(FILTERS, {"steadypose": PRODUCT["steadypose"]}, (0, 4) if bench.quick else DELAYS, networks=False)


def run(bench: Bench) -> Result:
    clips = bench.clips(FRAMES, 6 if bench.quick else CLIPS)
    middle = clips.positions[FRAMES // 2, :, J["pelvis"]] * (1.0, 1.0, 0.0)
    truth = clips.positions - (middle + CAMERA)[:, None]
    speed = np.linalg.norm(np.gradient(truth, 1 / FPS, axis=0), axis=-1)
    compared, records, tried = methods(bench), [], {}
    stamps, some = np.arange(FRAMES) / FPS, truth[:, ::TUNED_ON]
    for number, (name, corrupt) in enumerate(conditions(bench.quick).items()):
        other = corrupt(some, np.random.default_rng((number, 1)))
        tuned = tune_on(bench, other, some, stamps, name, compared.baselines, compared.delays)
        tried[name] = tuning_log(tuned)
        seen = corrupt(truth, np.random.default_rng((number, 0)))
        records += [
            {"condition": name, **_by_speed(answer, truth, speed), **_by_clip(answer, truth)}
            for answer in answers(bench, seen, stamps, tuned, name, compared)
        ]
    data = {
        "data": clips.source, "person": clips.person.tolist(), "data_set": clips.data_set.tolist(),
        "records": records, "tuning": tried,
        "speeds": {name: round(float(mask.mean()), 4) for name, mask in _bins(speed).items()},
    }  # fmt: skip
    return Result(_tables(records, bench, clips), data, _pictures(records))


def _bins(speed: Floats) -> dict[str, NDArray[np.bool_]]:
    return {
        f"{low:g}-{high:g} m/s" if np.isfinite(high) else f"above {low:g}": (speed >= low) & (speed < high)
        for low, high in pairwise(SPEEDS)
    }


def _by_speed(answer: Answer, truth: Floats, speed: Floats) -> dict[str, Any]:
    """Return one method's figures; ``by_speed`` has position, acceleration, and the error-to-sigma ratio."""
    error, jerk = position_error(answer.positions, truth), acceleration_error(answer.positions, truth)
    bins: dict[str, dict[str, float]] = {}
    for name, mask in _bins(speed).items():
        if mask.sum() < 20:
            continue
        bins[name] = {"position_mm": mean_mm(error[mask]), "acceleration_mm": mean_mm(jerk[mask[1:-1]])}
        if answer.sigma is not None:
            bins[name]["found_by_stated"] = round(sigma_ratio(error[mask], answer.sigma[mask]), 3)
    record: dict[str, Any] = {
        "method": answer.method, "delay": answer.delay, "parameters": dict(answer.parameters),
        **errors_mm(answer.positions, truth), "by_speed": bins,
    }  # fmt: skip
    if answer.sigma is not None:
        record["found_by_stated"] = round(sigma_ratio(error, answer.sigma), 3)
    return record


def _by_clip(answer: Answer, truth: Floats) -> dict[str, list[float]]:
    """Return the mean errors of each clip for the table of sources."""
    if answer.method not in UNTUNED or answer.delay not in SUMMARISED:
        return {}
    error = position_error(answer.positions, truth)
    return {"clips_mm": [mean_mm(error[:, clip]) for clip in range(error.shape[1])]}


def _tables(records: list[dict[str, Any]], bench: Bench, clips: MotionClips) -> list[Table]:
    note = (
        f"{len(clips.offsets)} clips of {FRAMES} frames of the {bench.split} split, by the true speed of the joint. "
        "Baselines tuned for each noise and delay on every third of these clips with other noise; the banks have no "
        "setting. Best filter: the tuned one of the least error in that very cell, of at most that delay."
    )
    return [
        _summary_table(records, note),
        *(_source_table(records, delay, clips) for delay in SUMMARISED),
        *(_speed_table(records, delay, note) for delay in (4, 0)),
        pivot(records, "condition", "position_mm", "fidelity", "Fidelity: MPJPE by noise, mm", note),
        pivot(records, "condition", "acceleration_mm", "fidelity-acceleration",
              "Fidelity: acceleration error by noise, mm/frame²", note, digits=2),
    ]  # fmt: skip


UNTUNED = ("raw", "bank of smoothers", "whole-body bank", "steadypose")
SUMMARISED = (0, 4)  # delays in the README's table, frames; the table of all has the others


def _summary_table(records: Sequence[Mapping[str, Any]], note: str) -> Table:
    noises = [name for name in dict.fromkeys(r["condition"] for r in records) if "depth" not in name]
    rows: list[list[str]] = []
    for delay in SUMMARISED:
        for name in ("best filter", *UNTUNED[1:]):
            cells = []
            for noise in noises:
                mine = [r for r in records if r["condition"] == noise and 0 <= r["delay"] <= delay]
                if name in UNTUNED:
                    mine = [r for r in mine if r["method"] == name and r["delay"] == delay]
                else:
                    mine = [r for r in mine if r["method"] not in UNTUNED]
                least = (min(r[key] for r in mine) for key in ("position_mm", "acceleration_mm"))
                cells.append(" / ".join(f"{value:.1f}" for value in least))
            rows.append([f"delay {delay}: {name}", *cells])
    title = "Fidelity: MPJPE, mm / acceleration error, mm/frame², by independent noise along each axis"
    return Table("fidelity-summary", title, ["method", *noises], rows, note)


def _source_table(records: Sequence[Mapping[str, Any]], delay: int, clips: MotionClips) -> Table:
    errors = {
        (r["condition"], r["method"]): 1e-3 * np.array(r["clips_mm"])
        for r in records
        if r["method"] in UNTUNED[1:] and r["delay"] == delay
    }
    title = f"Fidelity: MPJPE by source, mm, delay {delay}"
    return source_table(f"fidelity-sources-{delay}", title, errors, clips, "whole-body bank")


def _speed_table(records: Sequence[Mapping[str, Any]], delay: int, note: str) -> Table:
    bins = list(dict.fromkeys(name for record in records for name in record["by_speed"]))
    rows: list[list[str]] = []
    for condition in dict.fromkeys(record["condition"] for record in records):
        mine = [r for r in records if r["condition"] == condition and 0 <= r["delay"] <= delay]
        rivals = [r for r in mine if r["method"] not in UNTUNED]
        fixed = {r["method"]: r for r in mine if r["method"] in UNTUNED and r["delay"] in (delay, 0)}
        cells = {name: [r["by_speed"][b]["position_mm"] for b in bins] for name, r in fixed.items()}
        cells["best filter"] = [min(r["by_speed"][b]["position_mm"] for r in rivals) for b in bins]
        for name in ("raw", "best filter", *UNTUNED[1:]):
            rows.append([f"{condition}: {name}", *(f"{value:.1f}" for value in cells[name])])
    title = f"Fidelity: MPJPE by speed of the joint, mm, delay {delay}"
    return Table(f"fidelity-speed-{delay}", title, ["noise: method", *bins], rows, note)


def _pictures(records: list[dict[str, Any]]) -> dict[str, Any]:
    plain = [r for r in records if r["condition"] in ("none", "1 cm") and r["delay"] >= 0]
    flat = [{**r, f"{r['condition']}": r["position_mm"]} for r in plain]
    panels = {"none": "MPJPE, mm, no noise", "1 cm": "MPJPE, mm, 1 cm"}
    return {"fidelity_delays": pictures.curves(flat, "delay", panels, "delay, frames", "Fidelity")}
