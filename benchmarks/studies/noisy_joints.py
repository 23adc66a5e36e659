"""Noisy joints: HuMoR's protocol (90 frames, 4 cm) at several levels, and noise like that of real sensors.

HuMoR adds independent noise to every joint (Rempe et al. 2021, section 5.2). Independent noise favours low-pass
filters, so the other conditions have correlated noise, spikes, and swapped limbs. FLK, a Kalman filter with learned
motion (Martini et al. 2024), is a baseline in this study only: it was made for such noise, and has no delay.
"""

from __future__ import annotations

from functools import partial

from steadypose.benchmarks import figures
from steadypose.benchmarks.baselines import flk
from steadypose.benchmarks.baselines.filters import FILTERS, Baseline
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import correlated, gaussian, sides_exchanged, spiked, swapped
from steadypose.benchmarks.provenance import VARIANTS_22
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.scores import pivot
from steadypose.benchmarks.studies.corrupted import (
    HOW,
    Condition,
    by_source,
    calibration_table,
    reliability_bins,
    run_conditions,
)

DEPENDS_ON = VARIANTS_22

LEVELS_CM = (1, 2, 4, 8)


CONDITIONS: dict[str, Condition] = {
    **{f"{cm} cm": lambda truth, rng, cm=cm: gaussian(truth, cm / 100, rng) for cm in LEVELS_CM},
    "correlated 2 cm": lambda truth, rng: correlated(truth, 0.02, rng),
    "1 cm, spikes": lambda truth, rng: spiked(gaussian(truth, 0.01, rng), rng),
    "1 cm, swaps": lambda truth, rng: swapped(gaussian(truth, 0.01, rng), rng),
    "1 cm, sides": lambda truth, rng: sides_exchanged(gaussian(truth, 0.01, rng), rng),
    "correlated 2 cm, spikes, swaps": lambda truth, rng: spiked(swapped(correlated(truth, 0.02, rng), rng), rng),
}
"""Conditions by standard deviation along an axis; "correlated": by 0.9 between frames; "swaps": limbs exchanged
for a few frames; "sides": the whole body exchanged for a second."""


def run(bench: Bench) -> Result:
    clips = bench.clips()
    kept = ("4 cm", "correlated 2 cm, spikes, swaps") if bench.quick else tuple(CONDITIONS)
    track = partial(bench.progress.track, description="FLK")
    net = flk.train(bench.training_clips(), 50 if bench.quick else 3000, 0, track)
    filters = (*FILTERS, Baseline("FLK", partial(flk.filtered, net), (0,), flk.SPACE, whole_body=True))
    data = run_conditions(bench, clips, {name: CONDITIONS[name] for name in kept}, filters)
    records = data["records"]
    note = f"{clips.positions.shape[1]} clips of {len(clips.positions)} frames, 22 joints. {HOW}"
    tables = [
        pivot(records, "condition", "position_mm", "noisy_joints", "Noisy joints: MPJPE, mm", note),
        pivot(records, "condition", "acceleration_mm", "noisy_joints-acceleration",
              "Noisy joints: acceleration error, mm/frame² (times 0.9: m/s²)", note, digits=2),
    ]  # fmt: skip
    tables += [
        by_source(records, "position", delay, clips, f"noisy_joints-sources-{delay}", "Noisy joints: MPJPE")
        for delay in (4, 0)
    ]
    tables.append(calibration_table(data["calibration"], "noisy_joints-calibration"))
    levels = [
        {**record, "level": level}
        for record in records
        for level in LEVELS_CM
        if record["condition"] == f"{level} cm" and record["delay"] in (0, 4)
    ]
    panels = {"position_mm": "MPJPE, mm", "acceleration_mm": "acceleration error, mm/frame²"}
    pictures = {
        "noise_levels": figures.curves(
            [r for r in levels if r["delay"] == 4 or r["method"] in ("raw", "One-Euro")],
            "level", panels, "noise, cm", "Noisy joints, delay of at most 4 frames", log=True,
        ),
        "noise_delays": figures.curves(
            [r for r in records if r["condition"] == "4 cm" and r["delay"] >= 0], "delay", panels,
            "delay, frames", "Noise of 4 cm",
        ),
    }  # fmt: skip
    bins = reliability_bins(data["calibration"], "steadypose", 4)
    if bins:
        pictures["noise_reliability"] = figures.reliability(bins, "steadypose, delay 4: noisy joints")
    return Result(tables, {"data": clips.source, **data}, pictures)
