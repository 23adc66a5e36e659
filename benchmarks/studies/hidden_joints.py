"""Hidden joints: below 0.9 m (HuMoR's occlusion), an arm behind the trunk, limbs missing for 0.2 to 2 seconds, and
joints never observed.

Observed joints carry 1 cm of noise. Each clip begins with half a second in which everything is observed, except for
joints never observed, which a filter cannot estimate. HuMoR scores 43 points on the body's surface; this study scores
22 joints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks import figures
from steadypose.benchmarks.baselines.body import ConditionalGaussian, beside
from steadypose.benchmarks.baselines.filters import BASELINES, Baseline
from steadypose.benchmarks.baselines.kalman import whole_body_bank, whole_body_kalman
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import arm_behind, below, bursts, gaussian, hide
from steadypose.benchmarks.product import PRODUCT
from steadypose.benchmarks.provenance import VARIANTS_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import pivot
from steadypose.benchmarks.studies.corrupted import (
    HOW,
    Condition,
    by_source,
    calibration_table,
    reliability_bins,
    run_conditions,
)
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, SHOULDERS, limbs
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = VARIANTS_22

BESIDE = "held in the body frame"
GAUSSIAN = "conditional Gaussian"
FILTER = "Kalman, whole body"
KNOW_THE_BODY = (BESIDE, GAUSSIAN, FILTER)  # baselines that use the whole body, unlike a filter for each joint

NOISE = 0.01  # standard deviation of the noise, metres
SEEN_FIRST = 15  # number of frames at the start in which everything is observed
BURSTS_S = (0.2, 0.5, 1.0, 2.0)

_LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]
_ARM = limbs(("shoulder", "elbow", "wrist"))[0]
"""Joints that are never observed: behind a counter, or out of the image."""


def _masked(
    truth: Floats, rng: np.random.Generator, mask: Callable[[Floats, np.random.Generator], NDArray[np.bool_]]
) -> Floats:
    hidden = mask(truth, rng)
    hidden[:SEEN_FIRST] = False
    return hide(gaussian(truth, NOISE, rng), hidden)


def _without(truth: Floats, rng: np.random.Generator, joints: Sequence[int]) -> Floats:
    seen = gaussian(truth, NOISE, rng)
    seen[:, :, list(joints)] = np.nan
    return seen


def _burst(truth: Floats, rng: np.random.Generator, seconds: float) -> NDArray[np.bool_]:
    frames, clips, joints, _ = truth.shape
    return bursts((frames, clips, joints), round(seconds * FPS), SEEN_FIRST, rng)


CONDITIONS: dict[str, Condition] = {
    "below 0.9 m": partial(_masked, mask=lambda truth, _: below(truth)),
    "arm behind": partial(_masked, mask=lambda truth, _: arm_behind(truth)),
    **{f"{s:g} s": partial(_masked, mask=partial(_burst, seconds=s)) for s in BURSTS_S},
    "legs unobserved": partial(_without, joints=_LEGS),
    "arm unobserved": partial(_without, joints=_ARM),
}


def run(bench: Bench) -> Result:
    clips = bench.clips()
    kept = ("arm behind", "0.5 s") if bench.quick else tuple(CONDITIONS)
    gaussian = ConditionalGaussian(bench.training_clips().positions.reshape(-1, 22, 3))
    baselines = (
        *BASELINES,
        Baseline(GAUSSIAN, partial(given_the_seen, gaussian=gaussian), (0, 4), whole_body=True),
        Baseline(FILTER, whole_body_kalman, (0,), {"density": (0.1, 50.0), "damping": (1.0, 30.0)}, whole_body=True),
    )
    data = run_conditions(bench, clips, {name: CONDITIONS[name] for name in kept}, baselines)
    records = data["records"]
    note = (
        f"{clips.positions.shape[1]} clips of {len(clips.positions)} frames, 22 joints, 1 cm of noise on those "
        f"observed; the first {SEEN_FIRST} frames of a clip are observed in full. A duration: one lower arm or leg is "
        f"away for so long. Unobserved: knees and all below them, or an arm, in no frame of a clip. {GAUSSIAN}: the "
        f"mean of what is hidden given what the whole-body bank makes of what is seen, of one Gaussian over training "
        f"poses; where neither hips nor shoulders are seen, {BESIDE}. {HOW}"
    )
    sources = by_source(records, "hidden", 4, clips, "hidden_joints-sources", "Hidden joints: their error")
    groups = (("hidden", "hidden joints"), ("seen", "observed joints"))
    tables: list[Table] = [_summary_table(records, note), sources]
    tables += [
        pivot(records, "condition", f"{group}_mm", "hidden_joints" if group == "hidden" else "hidden_joints-seen",
              f"Hidden joints: error of {text}, mm", note)
        for group, text in groups
    ]  # fmt: skip
    tables.append(
        pivot(records, "condition", "acceleration_mm", "hidden_joints-acceleration",
              "Hidden joints: acceleration error of all joints, mm/frame²", note, digits=2)
    )  # fmt: skip
    tables.append(calibration_table(data["calibration"], "hidden_joints-calibration"))
    timed = [
        {**r, "seconds": float(r["condition"].removesuffix(" s"))} for r in records if r["condition"].endswith(" s")
    ]
    pictures = {
        "hidden_bursts": figures.curves(
            [r for r in timed if r["delay"] == 4 or r["method"] in ("hold last", "One-Euro")], "seconds",
            {"hidden_mm": "error of hidden joints, mm", "seen_mm": "error of observed joints, mm"},
            "a limb is hidden for, s", "Hidden limbs, delay of at most 4 frames", log=True,
        )
    }  # fmt: skip
    bins = reliability_bins(data["calibration"], "steadypose", 4)
    if bins:
        pictures["hidden_reliability"] = figures.reliability(bins, "steadypose, delay 4: hidden joints")
    return Result(tables, {"data": clips.source, **data}, pictures)


def given_the_seen(seen: Floats, stamps_s: Floats, delay: int, gaussian: ConditionalGaussian) -> Floats:
    """Return the input, smoothed by the whole-body bank, with a hidden joint at its conditional mean.

    The heading is that of hips and shoulders, or of those of them that are seen. Where it is unknown, a hidden joint is
    held in the body frame.
    """
    smooth = np.where(np.isfinite(seen), whole_body_bank(seen, stamps_s, delay), np.nan)
    across = np.stack([smooth[..., left, :] - smooth[..., right, :] for left, right in (HIPS, SHOULDERS)])
    known = np.isfinite(across).all(axis=-1).any(axis=0)
    x, y, _ = np.moveaxis(np.nansum(across, axis=0), -1, 0)
    found = gaussian(smooth, yaw=np.where(known, np.arctan2(-x, y), np.nan))
    return np.where(np.isfinite(found), found, beside(smooth, stamps_s, delay))


def _summary_table(records: Sequence[Mapping[str, Any]], note: str) -> Table:
    conditions = list(dict.fromkeys(r["condition"] for r in records))
    rows: list[list[str]] = []
    for delay in (0, 4):
        for name in ("best filter", *KNOW_THE_BODY, "steadypose"):
            cells = []
            for condition in conditions:
                mine = [r for r in records if r["condition"] == condition and 0 <= r["delay"] <= delay]
                if name == "best filter":
                    mine = [r for r in mine if r["method"] not in (*PRODUCT, *KNOW_THE_BODY)]
                else:
                    mine = [r for r in mine if r["method"] == name and r["delay"] in (delay, 0)][-1:]
                found = [r["hidden_mm"] for r in mine if "hidden_mm" in r]  # raw has no estimate
                cells.append(f"{min(found):.0f}" if found else "–")
            rows.append([f"delay {delay}: {name}", *cells])
    return Table("hidden_joints-summary", "Hidden joints: their error, mm", ["method", *conditions], rows, note)
