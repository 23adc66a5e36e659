"""Fidelity: error of cleaned motion by a joint's true speed, its noise, and the delay.

A noise-free input must stay unchanged. Bodies stand 3 m before a camera at the origin. Noise is white and isotropic, or
three times as large along the line of sight. Swings of a forearm and of a leg measure the gain at single frequencies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.benchmarks import figures as pictures
from steadypose.benchmarks.baselines.filters import FILTERS, Baseline
from steadypose.benchmarks.bench import Answer, Bench, Methods, answers, tune, tuning_log
from steadypose.benchmarks.corruption import along_sight, gaussian
from steadypose.benchmarks.metrics import acceleration_error, position_error, sigma_ratio
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.product import PRODUCT
from steadypose.benchmarks.provenance import CLEAN_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import pivot, source_table
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = CLEAN_22

DELAYS = (0, 2, 4, 8, 16)
SPEEDS = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, np.inf)
"""Edges of the speed bins, m/s."""
CLIPS, FRAMES = 24, 90
NOISES_M = (0.0, 0.002, 0.01, 0.02, 0.04)
CAMERA = (3.0, 0.0, 1.2)
"""Camera position relative to the point below the pelvis in the middle of a clip, metres."""
FREQUENCIES_HZ = (0.5, 1.0, 2.0, 3.0, 4.0)
SWING_RAD = 0.5
SWING_FRAMES, SWING_SCORED = 180, slice(45, 165)
SWING_NOISES_M = (0.0, 0.01)


class Swing(NamedTuple):
    """A limb that swings about a joint."""

    pivot: str
    """the joint that rotates"""
    moves: tuple[str, ...]
    """the joints below it"""
    axis: tuple[float, float, float]
    """axis of rotation in the frame of the bone above, which in the rest pose has x forward and z up"""


SWINGS = {
    "forearm": Swing("right_elbow", ("right_wrist",), (0.0, 0.0, 1.0)),
    "leg": Swing("left_hip", ("left_knee", "left_ankle", "left_foot"), (0.0, 1.0, 0.0)),
}


def conditions(quick: bool) -> dict[str, Callable[[Floats, np.random.Generator], Floats]]:
    """Return corruptions of joints (T, C, 22, 3) before a camera at the origin, by name."""
    levels = (0.0, 0.01) if quick else NOISES_M
    same = {_noise_name(level): partial(_independent, level) for level in levels}
    more = {f"{_noise_name(level)}, depth x3": partial(_deep, level) for level in levels if level}
    return {**same, **({} if quick else more)}


def _independent(level: float, truth: Floats, rng: np.random.Generator) -> Floats:
    return gaussian(truth, level, rng)


def _deep(level: float, truth: Floats, rng: np.random.Generator) -> Floats:
    return along_sight(truth, level, rng)


def _noise_name(level: float) -> str:
    return "none" if not level else f"{1000 * level:g} mm" if level < 0.01 else f"{100 * level:g} cm"


def methods(bench: Bench) -> Methods:
    """Return the filters and what ships. Other studies have the other variants."""
    return Methods(FILTERS, {"steadypose": PRODUCT["steadypose"]}, (0, 4) if bench.quick else DELAYS, networks=False)


def run(bench: Bench) -> Result:
    """Measure errors by speed, then swings."""
    clips = bench.clips(FRAMES, 6 if bench.quick else CLIPS)
    middle = clips.positions[FRAMES // 2, :, J["pelvis"]] * (1.0, 1.0, 0.0)
    truth = clips.positions - (middle + CAMERA)[:, None]
    speed = np.linalg.norm(np.gradient(truth, 1 / FPS, axis=0), axis=-1)
    compared, records, tried = methods(bench), [], {}
    for number, (name, corrupt) in enumerate(conditions(bench.quick).items()):
        answered, tried[name] = _answered(bench, compared, truth, corrupt, number, name)
        records += [
            {"condition": name, **_by_speed(answer, truth, speed), **_by_clip(answer, truth)} for answer in answered
        ]
    swung, swings_tried = _swings(bench, compared)
    data = {
        "data": clips.source, "person": clips.person.tolist(), "data_set": clips.data_set.tolist(),
        "records": records, "tuning": tried, "swings": swung, "swings tuning": swings_tried,
        "speeds": {name: round(float(mask.mean()), 4) for name, mask in _bins(speed).items()},
    }  # fmt: skip
    return Result(_tables(records, swung, bench, clips), data, _pictures(records, swung))


def _answered(
    bench: Bench,
    compared: Methods,
    truth: Floats,
    corrupt: Callable[[Floats, np.random.Generator], Floats],
    number: int,
    title: str,
) -> tuple[list[Answer], list[dict[str, Any]]]:
    """Run all methods, with baselines tuned on every third clip with other noise; also return the evaluated
    parameters."""
    stamps = np.arange(len(truth)) / FPS
    some = truth[:, ::3]
    tuning_observed = corrupt(some, np.random.default_rng((number, 1)))

    def evaluate(baseline: Baseline, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
        return _errors(baseline.run(tuning_observed, stamps, delay, **parameters), some)

    tuned = tune(bench, evaluate, title, compared.baselines, compared.delays)
    seen = corrupt(truth, np.random.default_rng((number, 0)))
    return list(answers(bench, seen, stamps, tuned, title, compared)), tuning_log(tuned)


def _errors(answer: Floats, truth: Floats) -> dict[str, float]:
    return {
        "position_mm": _mm(position_error(answer, truth)),
        "acceleration_mm": _mm(acceleration_error(answer, truth)),
    }


def _mm(values: Floats) -> float:
    return round(1e3 * float(np.nanmean(values)), 4) if np.isfinite(values).any() else float("nan")


def _bins(speed: Floats) -> dict[str, NDArray[np.bool_]]:
    """Return the masks of the speed bins, by name."""
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
        bins[name] = {"position_mm": _mm(error[mask]), "acceleration_mm": _mm(jerk[mask[1:-1]])}
        if answer.sigma is not None:
            bins[name]["found_by_stated"] = round(sigma_ratio(error[mask], answer.sigma[mask]), 3)
    record: dict[str, Any] = {
        "method": answer.method, "delay": answer.delay, "parameters": dict(answer.parameters),
        **_errors(answer.positions, truth), "by_speed": bins,
    }  # fmt: skip
    if answer.sigma is not None:
        record["found_by_stated"] = round(sigma_ratio(error, answer.sigma), 3)
    return record


def _by_clip(answer: Answer, truth: Floats) -> dict[str, list[float]]:
    """Return the mean errors of each clip for the table of sources."""
    if answer.method not in UNTUNED or answer.delay not in SUMMARISED:
        return {}
    error = position_error(answer.positions, truth)
    return {"clips_mm": [_mm(error[:, clip]) for clip in range(error.shape[1])]}


def swinging(swing: Swing, frequency_hz: float) -> Floats:
    """Return the rest skeleton standing before the camera, arms hanging and bent, one limb swinging, (T, 22, 3)
    metres."""
    turns = np.tile(np.eye(3), (SWING_FRAMES, len(PARENTS), 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turns[:, J[f"{side}_shoulder"]] = Rotation.from_rotvec((-sign * 1.3, 0.0, 0.0)).as_matrix()
        turns[:, J[f"{side}_elbow"]] = Rotation.from_rotvec((0.0, 0.0, -sign * 1.4)).as_matrix()
    angle = SWING_RAD * np.sin(2 * np.pi * frequency_hz * np.arange(SWING_FRAMES) / FPS)
    pivot = J[swing.pivot]
    turns[:, pivot] = Rotation.from_rotvec(angle[:, None] * swing.axis).as_matrix() @ turns[:, pivot]
    placed, world = np.zeros((SWING_FRAMES, len(PARENTS), 3)), turns.copy()
    placed[:, 0] = (0.0, 0.0, 0.95)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ turns[:, joint]
            placed[:, joint] = placed[:, parent] + world[:, parent] @ REST_OFFSETS[joint]
    return placed - CAMERA


def left_of_swing(answer: Floats, truth: Floats, frequency_hz: float) -> float:
    """Return the amplitude of (T, ..., 3) at this frequency relative to the truth, whatever the phase."""
    wave = np.exp(-2j * np.pi * frequency_hz * np.arange(len(truth)) / FPS)
    found, wanted = (np.linalg.norm(np.tensordot(wave, x - x.mean(axis=0), axes=1)) for x in (answer, truth))
    return float(found / wanted)


def _swings(bench: Bench, compared: Methods) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Measure every method's gain for every swing, side by side as clips."""
    asked = [(limb, f) for limb in SWINGS for f in ((1.0, 3.0) if bench.quick else FREQUENCIES_HZ)]
    truth = np.stack([swinging(SWINGS[limb], f) for limb, f in asked], axis=1)
    records, tried = [], {}
    for number, level in enumerate(SWING_NOISES_M):
        noise = _noise_name(level)
        title = f"swings, noise {noise}"
        answered, tried[noise] = _answered(bench, compared, truth, partial(_independent, level), 100 + number, title)
        for answer in answered:
            for clip, (limb, frequency) in enumerate(asked):
                moved = [J[name] for name in SWINGS[limb].moves]
                found, wanted = (x[SWING_SCORED, clip][:, moved] for x in (answer.positions, truth))
                records.append({
                    "noise": noise, "limb": limb, "frequency_hz": frequency, "swing": f"{limb} {frequency:g} Hz",
                    "method": answer.method, "delay": answer.delay,
                    "left_percent": round(100 * left_of_swing(found, wanted, frequency), 2),
                    "error_mm": _mm(position_error(found, wanted)),
                })  # fmt: skip
    return records, tried


def _tables(
    records: list[dict[str, Any]], swings: list[dict[str, Any]], bench: Bench, clips: MotionClips
) -> list[Table]:
    note = (
        f"{len(clips.offsets)} clips of {FRAMES} frames of the {bench.split} split, by the true speed of the joint. "
        "Baselines tuned for each noise and delay on every third of these clips with other noise; the banks have no "
        "setting. Best filter: the tuned one of the least error in that very cell, of at most that delay."
    )
    tables = [_summary_table(records, note), *(_source_table(records, delay, clips) for delay in SUMMARISED)]
    tables += [*(_speed_table(records, delay, note) for delay in (4, 0))]
    sums = ("fidelity", "Fidelity: MPJPE by noise, mm", "position_mm", 1), (
        "fidelity-acceleration", "Fidelity: acceleration error by noise, mm/frame²", "acceleration_mm", 2
    )  # fmt: skip
    tables += [pivot(records, "condition", key, name, title, note, digits) for name, title, key, digits in sums]
    for noise in dict.fromkeys(s["noise"] for s in swings):
        tables.append(
            pivot(
                [s for s in swings if s["noise"] == noise], "swing", "left_percent", f"fidelity-swings-{_slug(noise)}",
                f"Fidelity: what is left of a swing's amplitude, %, noise {noise}",
                f"±{SWING_RAD} rad, the forearm about the elbow and the leg about the hip.", 0,
            )
        )  # fmt: skip
    return tables


def _slug(noise: str) -> str:
    return noise.replace(" ", "")


UNTUNED = ("raw", "bank of smoothers", "whole-body bank", "steadypose")
SUMMARISED = (0, 4)
"""Delays in the README's table, frames; the table of all has the others."""


def _summary_table(records: Sequence[Mapping[str, Any]], note: str) -> Table:
    """Build a table of the best tuned filter, the banks and steadypose, by noise and delay: position / acceleration."""
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
                cells.append(
                    " / ".join(f"{min(r[key] for r in mine):.1f}" for key in ("position_mm", "acceleration_mm"))
                )
            rows.append([f"delay {delay}: {name}", *cells])
    title = "Fidelity: MPJPE, mm / acceleration error, mm/frame², by independent noise along each axis"
    return Table("fidelity-summary", title, ["method", *noises], rows, note)


def _source_table(records: Sequence[Mapping[str, Any]], delay: int, clips: MotionClips) -> Table:
    """Build a table of the banks and steadypose by source."""
    errors = {
        (r["condition"], r["method"]): 1e-3 * np.array(r["clips_mm"])
        for r in records
        if r["method"] in UNTUNED[1:] and r["delay"] == delay
    }
    title = f"Fidelity: MPJPE by source, mm, delay {delay}"
    return source_table(f"fidelity-sources-{delay}", title, errors, clips, "whole-body bank")


def _speed_table(records: Sequence[Mapping[str, Any]], delay: int, note: str) -> Table:
    """Build a table of raw, the best tuned filter, the banks and steadypose, by noise and speed."""
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


def _pictures(records: list[dict[str, Any]], swings: list[dict[str, Any]]) -> dict[str, Any]:
    plain = [r for r in records if r["condition"] in ("none", "1 cm") and r["delay"] >= 0]
    flat = [{**r, f"{r['condition']}": r["position_mm"]} for r in plain]
    none = [s for s in swings if s["noise"] == "none" and s["limb"] == "forearm" and s["delay"] == 4]
    return {
        "fidelity_delays": pictures.curves(
            flat, "delay", {"none": "MPJPE, mm, no noise", "1 cm": "MPJPE, mm, 1 cm"}, "delay, frames", "Fidelity"
        ),
        "fidelity_swings": pictures.curves(
            none, "frequency_hz", {"left_percent": "amplitude left, %", "error_mm": "error, mm"}, "Hz",
            "A forearm that swings without noise, delay 4",
        ),
    }  # fmt: skip
