"""Gaps in noisy recordings: the whole body, an arm, a wrist or a foot is away for 5 to 30 frames of a clip.

Only joints are given, with noise. Baselines are cubic splines through each joint, as given and as the whole-body bank
smooths it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from steadypose.benchmarks.baselines.kalman import whole_body_bank
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import correlated, gaussian
from steadypose.benchmarks.results import Table
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.skeleton import J
from steadypose.prior.complete.body import complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.timing.rate import FPS

FRAMES, GAPS = 75, (5, 15, 30)
NOISES: dict[str, Callable[[Floats, np.random.Generator], Floats]] = {
    "none": lambda truth, rng: truth,
    "white, 1 cm": lambda truth, rng: gaussian(truth, 0.01, rng),
    "correlated, 2 cm": lambda truth, rng: correlated(truth, 0.02, rng),
}
AWAY = {
    "the body": list(range(22)),
    "an arm": [J["left_shoulder"], J["left_elbow"], J["left_wrist"]],
    "a wrist": [J["right_wrist"]],
    "a foot": [J["right_ankle"], J["right_foot"]],
}


def in_noise(bench: Bench, parts: PartsCompleter) -> tuple[list[dict[str, Any]], Table]:
    """Return the error of hidden joints by every method in every condition, and its table."""
    clips = bench.clips(FRAMES, 32)
    stamps = np.arange(FRAMES) / FPS

    def smoothed(seen: Floats) -> Floats:
        return np.where(np.isfinite(seen), whole_body_bank(seen, stamps, 8), np.nan)

    def alone(seen: Floats) -> Floats:
        offsets = np.stack([estimate_offsets(seen[:, clip]) for clip in range(seen.shape[1])])
        rotations, root = parts(seen.swapaxes(0, 1), offsets)
        return (place_joints(rotations, offsets[:, None]) + root[:, :, None]).swapaxes(0, 1)

    def whole(seen: Floats) -> Floats:
        one = (complete(parts, seen[:, c], estimate_offsets(seen[:, c])).positions for c in range(seen.shape[1]))
        return np.stack(list(one), axis=1)

    methods: dict[str, Callable[[Floats], Floats]] = {
        "cubic spline": through,
        "whole-body bank, cubic spline": lambda seen: through(smoothed(seen)),
        "complete, joints not smoothed first": alone,
        "complete": whole,
    }
    records: list[dict[str, Any]] = []
    for noise in bench.progress.track(NOISES, description="gaps in noise"):
        for away, joints in AWAY.items():
            for gap in GAPS:
                seen = NOISES[noise](clips.positions, np.random.default_rng(gap)).copy()
                rows = slice((FRAMES - gap) // 2, (FRAMES + gap) // 2)
                seen[rows, :, joints] = np.nan
                for name, method in methods.items():
                    off = np.linalg.norm(method(seen) - clips.positions, axis=-1)[rows][:, :, joints].mean(axis=(0, 2))
                    records.append({
                        "method": name, "noise": noise, "away": away, "gap": gap,
                        "hidden_mm": round(1e3 * float(off.mean()), 2),
                    })  # fmt: skip
    return records, _table(records, clips.positions.shape[1])


def through(seen: Floats) -> Floats:
    """Fit a cubic spline to every coordinate of joints (T, C, 22, 3), NaN where unknown."""
    flat = seen.reshape(len(seen), -1)
    times, filled = np.arange(len(seen)), np.empty_like(flat)
    for column, known in enumerate(np.isfinite(flat).T):
        filled[:, column] = CubicSpline(times[known], flat[known, column])(times)
    return filled.reshape(seen.shape)


def _table(records: list[dict[str, Any]], clips: int) -> Table:
    conditions = list(dict.fromkeys((r["noise"], r["away"]) for r in records))
    methods = list(dict.fromkeys(r["method"] for r in records))
    cells = {(r["method"], r["noise"], r["away"], r["gap"]): f"{r['hidden_mm']:.1f}" for r in records}
    rows = [
        [noise, away, method, *(cells[method, noise, away, gap] for gap in GAPS)]
        for noise, away in conditions
        for method in methods
    ]
    return Table(
        "interpolation-noise", "Gaps in noisy recordings: error of hidden joints, mm",
        ["noise", "away", "method", *(f"{gap} frames" for gap in GAPS)], rows,
        f"{clips} clips of {FRAMES} frames, a gap in the middle. Splines are of each coordinate.",
    )  # fmt: skip
