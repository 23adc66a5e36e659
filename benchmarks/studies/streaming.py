"""Streaming: effective delay, jitter, recovery of hidden limbs, lost frames, jittering stamps.

Joints have 2 cm of white noise. A method is tuned once, on the steady stream, for all conditions. Lost frames are
scored like all others. Jittering stamps are correct: an estimate is compared with the truth at its own stamp. Compute
times are those of `benchmarks.systems.latency`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from steadypose.benchmarks import figures as pictures
from steadypose.benchmarks.baselines.filters import OFFLINE, PEERS, Peer, missing, raw
from steadypose.benchmarks.bench import Answer, Bench, Methods, Result, answers, over_seeds, tune, tuning_log
from steadypose.benchmarks.corruption import LIMBS, bursts, gaussian, hide
from steadypose.benchmarks.metrics import found_delay
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import VARIANTS
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.scores import figures, score
from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = VARIANTS

NOISE = 0.02
"""Metres."""
LOSSES = (0.01, 0.05, 0.10)
"""Shares of the frames."""
STAMP_JITTER_S = 0.010
BURST_S = 1.0
RECOVERED = 1.5
"""A limb has recovered when its error is within this multiple of its error while nothing is hidden."""
MAX_LAG = 12
"""Frames, the largest delay considered."""
STREAMING_PEERS = tuple(peer for peer in PEERS if peer.delays != (OFFLINE,) and peer.run is not raw)
"""A method without an estimate for lost frames would be scored on the others alone: "hold last" is raw, held."""
CONDITIONS = ("steady", *(f"{share:.0%} lost" for share in LOSSES), "stamps ±10 ms", "occlusion of 1 s")


def run(bench: Bench) -> Result:
    """Every method in every condition."""
    clips = bench.clips()
    truth_at = CubicSpline(clips.stamps_s, clips.positions)
    some = clips.every(3)
    tuning_seen = gaussian(some.positions, NOISE, np.random.default_rng(1))

    def evaluate(peer: Peer, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
        answer = peer.run(tuning_seen, clips.stamps_s, delay, **parameters)
        found = figures(score(answer, some.positions, missing(tuning_seen), align=False))
        behind = found_delay(answer, some.positions, MAX_LAG)
        kept = {key: found[key] for key in ("position_mm", "acceleration_mm", "own_acceleration_mm")}
        return {**kept, "delay_found_ms": round((delay + behind) * 1e3 / FPS, 2)}

    tuned = tune(bench, evaluate, "streaming", STREAMING_PEERS)
    records: list[dict[str, Any]] = []
    conditions = (CONDITIONS[0], CONDITIONS[3], *CONDITIONS[4:]) if bench.quick else CONDITIONS
    for condition in conditions:
        stamps, seen = observe(clips, condition, truth_at)
        hidden = missing(seen)
        found = answers(bench, seen, stamps, tuned, condition, Methods.all(bench, STREAMING_PEERS))
        records += over_seeds([_record(answer, condition, truth_at, hidden) for answer in found])
    data = {"data": clips.source, "records": records, "tuning": tuning_log(tuned)}
    return Result([_table(records, clips)], data, {"streaming_jitter": _jitter(records, data["tuning"])})


def observe(clips: MotionClips, condition: str, truth_at: CubicSpline) -> tuple[Floats, Floats]:
    """Stamps (T,) and observations (T, C, 22, 3)."""
    rng = np.random.default_rng(CONDITIONS.index(condition))
    frames, count = clips.positions.shape[:2]
    stamps = clips.stamps_s.copy()
    if condition == "stamps ±10 ms":
        stamps[1:-1] += rng.uniform(-STAMP_JITTER_S, STAMP_JITTER_S, frames - 2)
    seen = gaussian(truth_at(stamps), NOISE, rng)
    if condition.endswith("lost"):
        share = LOSSES[CONDITIONS.index(condition) - 1]
        gone = rng.random((frames, count)) < share
        gone[[0, -1]] = False
        seen[gone] = np.nan
    if condition == "occlusion of 1 s":
        seen = hide(seen, bursts((frames, count, 22), round(BURST_S * FPS), 15, rng))
    return stamps, seen


def _record(answer: Answer, condition: str, truth_at: CubicSpline, hidden: NDArray[np.bool_]) -> dict[str, Any]:
    inside = answer.stamps_s <= truth_at.x[-1] + 1e-3
    positions, truth = answer.positions[inside], truth_at(answer.stamps_s[inside])
    asked = hidden if len(hidden) == len(truth) else np.zeros(truth.shape[:-1], dtype=bool)
    found = figures(score(positions, truth, asked, align=False))
    record: dict[str, Any] = {
        "condition": condition,
        "method": answer.method,
        "delay": answer.delay,
        **{key: found[key] for key in ("position_mm", "acceleration_mm", "own_acceleration_mm")},
    }
    if condition == "steady":
        behind = found_delay(positions, truth, MAX_LAG)
        record["delay_found_ms"] = round((answer.delay + behind) * 1e3 / FPS, 2)
    if condition == "occlusion of 1 s":
        times = recovery(positions, truth, hidden)
        record["recovery_ms"] = {
            name: round(float(np.quantile(times, q)) * 1e3, 1) for name, q in (("p50", 0.5), ("p95", 0.95))
        }
    return record


def recovery(answer: Floats, truth: Floats, hidden: NDArray[np.bool_]) -> Floats:
    """(C,) seconds, by the frames' own stamps, from a limb's first frame in sight until it is found again.

    Found is when the mean error of its joints is within `RECOVERED` times their mean before they were hidden; a clip
    that ends before has the time to its end.
    """
    error = np.linalg.norm(answer - truth, axis=-1)
    times = []
    for clip in range(hidden.shape[1]):
        limb = next(joints for joints in LIMBS if hidden[:, clip, joints].any())
        away = np.flatnonzero(hidden[:, clip, limb[0]])
        limb_error = np.nan_to_num(error[:, clip, limb].mean(axis=1), nan=np.inf)
        found = limb_error[away[-1] + 1 :] <= RECOVERED * limb_error[: away[0]].mean()
        times.append((found.argmax() if found.any() else len(found)) / FPS)
    return np.array(times)


def _table(records: list[dict[str, Any]], clips: MotionClips) -> Table:
    by_method: dict[tuple[str, int], dict[str, dict[str, Any]]] = {}
    for record in records:
        by_method.setdefault((record["method"], record["delay"]), {})[record["condition"]] = record
    conditions = [c for c in CONDITIONS if c in {record["condition"] for record in records}]
    rows = []
    for (method, delay), found in by_method.items():
        recovered = found["occlusion of 1 s"]["recovery_ms"]
        rows.append(
            [
                method, str(delay), f"{found['steady']['delay_found_ms']:.0f}",
                f"{found['steady']['acceleration_mm']:.2f}",
                *(f"{found[c]['position_mm']:.1f}" for c in conditions),
                f"{recovered['p50']:.0f} / {recovered['p95']:.0f}",
            ]
        )  # fmt: skip
    return Table(
        name="streaming",
        title="Streaming: delay found, jitter, and position error (mm) by condition",
        columns=["method", "delay, frames", "delay found, ms", "jitter, mm/frame²", *(f"{c}, mm" for c in conditions),
                 "recovery, ms"],
        rows=rows,
        note=(
            f"{clips.positions.shape[1]} clips of {len(clips.positions)} frames, 2 cm of independent noise; methods "
            "are tuned once, on the steady stream. Delay found: where the velocities of answer and truth correlate "
            "best, the frames waited for included. Jitter: acceleration error on the steady stream. Recovery (median "
            "/ 95th percentile): after a limb was away for a second, until its error is within 1.5 times what it was."
        ),
    )  # fmt: skip


def _jitter(records: list[dict[str, Any]], tried: list[dict[str, Any]]) -> Figure:
    """Jitter against the delay found: of peers every point that was tried, of all methods what they are run with."""
    points = [{"method": found["method"], **point} for found in tried for point in found["tried"]]
    steady = [record for record in records if record["condition"] == "steady"]
    figure = Figure(figsize=(7.6, 4.4), layout="constrained")
    axis = figure.subplots()
    for method in dict.fromkeys(record["method"] for record in steady):
        colour = pictures.COLOURS.get(method)
        for marker, size, alpha, group in ((".", 30, 0.5, points), ("o", 50, 1.0, steady)):
            these = [p for p in group if p["method"] == method]
            axis.scatter(
                [p["delay_found_ms"] for p in these], [p["acceleration_mm"] for p in these], s=size, c=colour,
                marker=marker, alpha=alpha, lw=0, label=method if group is steady else None,
            )  # fmt: skip
    axis.set(xlabel="delay found, ms", ylabel="jitter: acceleration error, mm/frame²", yscale="log")
    axis.set_title("Jitter at matched delay, 2 cm of noise; small: other parameters tried", fontsize=10)
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.tick_params(which="minor", labelsize=7)
    axis.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return figure
