"""Real Kinect against Vicon: how cleaning reduces the noise of a real sensor (UI-PRMD), each person left out in turn.

The protocol is the same for every method. The input is the Kinect's 22 joints at 30 Hz. 13 joints (head, shoulders,
elbows, wrists, hips, knees, ankles) are scored against the Vicon's joint centres (`prior.mocap.plug_in_gait`). Each
clip is aligned by one rotation and one translation. Then a constant offset per joint is added, in the frame of the
trunk spanned by hips and shoulders, because the two systems define "hip" differently. For each of the eight people,
each method's offset is learned from its own output on the others. So are the parameters of baselines and the correction
of "sensor known". At a delay of k frames, an estimate uses k later frames, or those up to the end of the clip.

The smoother's mixture that ships was trained on the Kinect's output for s01 to s06, with the Vicon as reference, and
chosen on s07 and s08. The other networks have seen the Vicon's motion of s01 to s06. So "each person left out" holds
for offsets, baselines and the correction, but not for steadypose's smoother. Its rows are too good by the advantage of
people it was fitted to.

s01's two systems are not synchronised: its column is shown, but no mean includes it. More than half of a method's error
here is a constant that differs between persons and definitions of a joint, which no method can know. The second figure
of position, "moving", subtracts each joint's constant offset in each clip, for all methods alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from steadypose.benchmarks import figures
from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE
from steadypose.benchmarks.bench import Bench, loss, over_seeds, tuning_log
from steadypose.benchmarks.metrics import bootstrap_ratio, length_variation, position_error, reliability
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.kinect_clips import (
    BONES,
    OUT_OF_STEP,
    SCORED,
    SUBJECTS,
    Clip,
    Scores,
    align,
    deviation,
    in_step,
    learn_offset,
    move,
    read_clips,
    score,
    summary,
)
from steadypose.benchmarks.studies.kinect_methods import KNOWN, TCN, UNKNOWN, Kinect, Method, Stated
from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = (*CLEAN, "training.recipes.sensor_bias")
"""What the results depend on. No sensor correction that ships: each is trained here, without the person left out."""

OFFSET_CLIPS, TUNING_CLIPS = 3, 5
"""Steps between clips: offsets are learned on every n-th of the others' clips, filters are tuned on every n-th."""


def run(bench: Bench) -> Result:
    """Leave one person out, tune, run and score; then score all people's clips together."""
    assert bench.mocap is not None
    path = bench.mocap / "ui_prmd.npz"
    subjects = ("s01", "s05", "s08") if bench.quick else SUBJECTS
    clips = read_clips(path, subjects, 66 if bench.quick else 6)
    taught = read_clips(path, subjects, 40 if bench.quick else 3)
    kinect = Kinect(bench, path, clips, taught)
    tuned = kinect.tuned(clips[:: 1 if bench.quick else TUNING_CLIPS])
    parts: dict[tuple[str, int, int], list[tuple[Scores, dict[str, Any]]]] = {}
    deviations: dict[tuple[str, int], dict[str, Any]] = {}
    bins: dict[str, list[tuple[Floats, Floats]]] = {}
    for person in bench.progress.track(subjects, description="Kinect, left out"):
        asked = [clip for clip in clips if clip.subject == person]
        others = [clip for clip in clips if clip.subject != person][:: 1 if bench.quick else OFFSET_CLIPS]
        runs: dict[tuple[str, int], int] = {}
        for method in kinect.methods(person, tuned):
            result, skin, error, stated = _scored(method, asked, others)
            key = (method.name, method.delay)
            runs[key] = runs.get(key, -1) + 1  # networks of several seeds share one name
            parts.setdefault((*key, runs[key]), []).append((result, {
                "parameters": dict(method.parameters), "markers_mm": round(1e3 * float(skin.position.mean()), 3),
            }))  # fmt: skip
            if stated is not None:
                sigma, anomaly, flagged = (np.concatenate(part) for part in zip(*stated, strict=True))
                deviations.setdefault(key, {})[person] = deviation(error, sigma, anomaly, flagged)
                bins.setdefault(f"{method.name}, delay {method.delay}", []).append((error, sigma))
    ordered = [clip for person in subjects for clip in clips if clip.subject == person]
    scored = {key: _together([s for s, _ in some], subjects) for key, some in parts.items()}
    records = over_seeds([_record(key, ordered, scored, parts[key], deviations) for key in scored])
    reliabilities = {
        name: reliability(np.concatenate([error for error, _ in some]), np.concatenate([sigma for _, sigma in some]))
        for name, some in bins.items()
    }
    data = {
        "data": {
            "file": path.name, "people": subjects, "clips": len(clips), "learning_clips": len(taught),
            "joints": SCORED, "fps": FPS, "out of step, in no mean": OUT_OF_STEP,
        },
        "truth_bone_variation_percent": round(
            100 * float(np.mean([length_variation(clip.centres, BONES) for clip in clips])), 3
        ),
        "records": records, "reliability": reliabilities, "tuning": tuning_log(tuned),
    }  # fmt: skip
    pictures = {
        "kinect_vicon": figures.curves(
            [r for r in records if r["delay"] >= 0], "delay",
            {"position_mm": "position error, mm", "acceleration_mm": "acceleration error, mm/frame²"},
            "delay, frames at 30 Hz", "Real Kinect against Vicon, each of eight people left out",
        ),
        "kinect_reliability": figures.reliability(reliabilities, "Real Kinect: stated and found"),
    }  # fmt: skip
    tables = [
        _summary(records, bench.delays), _moving(records, bench.delays), _table(records, clips, subjects),
        _deviation_table(deviations, subjects),
    ]  # fmt: skip
    return Result(tables, data, pictures)


def _scored(
    method: Method, asked: Sequence[Clip], others: Sequence[Clip]
) -> tuple[Scores, Scores, Floats, list[Stated] | None]:
    """Score one person's clips against joint centres and markers; return errors (N, 13) and steadypose's
    predictions."""
    answers, stated = method.run([*others, *asked])
    found: list[tuple[Scores, Floats]] = []
    for truth in ("centres", "markers"):
        known, wanted = ([getattr(clip, truth) for clip in part] for part in (others, asked))
        offset = learn_offset(known, align(known, answers[: len(others)]))
        aligned = align(wanted, answers[len(others) :])
        error = [position_error(move(a, offset), t) for a, t in zip(aligned, wanted, strict=True)]
        found.append((score(wanted, aligned, offset), np.concatenate(error)))
    return found[0][0], found[1][0], found[0][1], None if stated is None else stated[len(others) :]


def _together(scores: Sequence[Scores], people: Sequence[str]) -> Scores:
    """Merge the scores of several people's clips; joints are the mean over people whose systems are synchronised."""
    return Scores(
        position=np.concatenate([s.position for s in scores]),
        moving=np.concatenate([s.moving for s in scores]),
        acceleration=np.concatenate([s.acceleration for s in scores]),
        variation=np.concatenate([s.variation for s in scores]),
        joints=np.mean([s.joints for s, who in zip(scores, people, strict=True) if who not in OUT_OF_STEP], axis=0),
    )


def _record(
    key: tuple[str, int, int],
    clips: Sequence[Clip],
    scored: Mapping[tuple[str, int, int], Scores],
    parts: Sequence[tuple[Scores, dict[str, Any]]],
    deviations: Mapping[tuple[str, int], dict[str, Any]],
) -> dict[str, Any]:
    name, delay, _ = key
    people = list(dict.fromkeys(clip.subject for clip in clips))
    record: dict[str, Any] = {
        "method": name, "delay": delay, **summary(clips, scored[key]),
        "parameters": {person: extra["parameters"] for person, (_, extra) in zip(people, parts, strict=True)},
        "markers_mm": {person: extra["markers_mm"] for person, (_, extra) in zip(people, parts, strict=True)},
    }  # fmt: skip
    if (name, delay) in deviations:
        record["deviation"] = deviations[name, delay]
        record["ratios"] = _ratios(scored[key], delay, clips, scored)
    return record


def _ratios(
    mine: Scores, delay: int, clips: Sequence[Clip], scored: Mapping[tuple[str, int, int], Scores]
) -> dict[str, Any]:
    """Return ratios of errors to the best filter up to this delay (least sum of errors) and to the temporal
    convolution.

    They have intervals over all synchronised clips, and position for each person.
    """
    kept = in_step(clips)
    names = {baseline.name for baseline in FILTERS}
    filters = {k: s for k, s in scored.items() if k[0] in names and OFFLINE < k[1] <= delay}

    def both(scores: Scores) -> float:
        mean = {"position_mm": scores.position[kept], "acceleration_mm": scores.acceleration[kept]}
        return loss({name: 1e3 * float(values.mean()) for name, values in mean.items()})

    best = min(filters, key=lambda k: both(filters[k]))
    of_person = {p: np.array([clip.subject == p for clip in clips]) for p in dict.fromkeys(c.subject for c in clips)}

    def ratio(name: str, rival: Scores) -> list[float]:
        return [round(v, 4) for v in bootstrap_ratio(getattr(mine, name)[kept], getattr(rival, name)[kept])]

    return {
        f"{rival[0]}, delay {rival[1]}": {
            **{name: ratio(name, scored[rival]) for name in ("position", "moving", "acceleration")},
            "position of each": {
                p: round(float(mine.position[rows].mean() / scored[rival].position[rows].mean()), 4)
                for p, rows in of_person.items()
            },
        }
        for rival in (best, (TCN, delay, 0))
        if rival in scored
    }


_NO_MEAN = f"{', '.join(OUT_OF_STEP)}, whose Kinect is out of step with the Vicon, is in no mean"


def _summary(records: Sequence[dict[str, Any]], delays: Sequence[int]) -> Table:
    return _by_delay(
        records, delays, "position_mm", "kinect_vicon-summary",
        "Real Kinect against Vicon: position error, mm / acceleration error, mm/frame²",
        "UI-PRMD, each of eight people left out in turn: offsets, tuning, training and the sensor's correction are "
        f"the others'. {_NO_MEAN}. Details: docs/results.md.",
    )  # fmt: skip


def _moving(records: Sequence[dict[str, Any]], delays: Sequence[int]) -> Table:
    return _by_delay(
        records, delays, "moving_mm", "kinect_vicon-moving",
        "Real Kinect against Vicon, each joint's constant offset of that clip taken off: position error, mm / "
        "acceleration error, mm/frame²",
        f"What differs between persons and definitions all the time is no matter of cleaning. {_NO_MEAN}.",
    )  # fmt: skip


def _by_delay(
    records: Sequence[dict[str, Any]], delays: Sequence[int], figure: str, name: str, title: str, note: str
) -> Table:
    """Build a table with a row for each method and a column for each delay."""
    cells: dict[str, dict[int, str]] = {}
    for record in records:
        cell = f"{record[figure]:.1f} / {record['acceleration_mm']:.2f}"
        cells.setdefault(record["method"], {})[record["delay"]] = cell
    return Table(
        name=name,
        title=title,
        columns=["method", *(f"delay {delay}" for delay in delays), "offline"],
        rows=[[method, *(found.get(delay, "") for delay in (*delays, OFFLINE))] for method, found in cells.items()],
        note=note,
    )


def _table(records: Sequence[dict[str, Any]], clips: Sequence[Clip], subjects: Sequence[str]) -> Table:
    return Table.of(
        "kinect_vicon", "Real Kinect against Vicon: UI-PRMD, each person left out in turn",
        [{**r, "delay": "offline" if r["delay"] == OFFLINE else r["delay"]} for r in records],
        {"method": "{method}", "delay, frames": "{delay}",
         "position, mm": "{position_mm:.1f} ({position_ci_mm[0]:.1f}–{position_ci_mm[1]:.1f})",
         "clip's offset off": "{moving_mm:.1f} ({moving_ci_mm[0]:.1f}–{moving_ci_mm[1]:.1f})",
         **{subject: f"{{groups[{subject}][position_mm]:.1f}}" for subject in subjects},
         "acceleration, mm/frame²":
             "{acceleration_mm:.2f} ({acceleration_ci_mm[0]:.2f}–{acceleration_ci_mm[1]:.2f})",
         "bone length, %": "{bone_variation_percent:.1f}"},
        f"{len(clips)} clips, 13 joints, 30 Hz; in brackets, the 95 % interval by bootstrap over clips. One "
        "rotation and translation a clip, then a constant offset a joint in the trunk's frame, which every method "
        "learns on the other people. Filters have the parameters that are best for the others, of one search. "
        "Bone length: standard deviation by mean. Clip's offset off: without each joint's constant offset of that "
        f"very clip. {_NO_MEAN}.",
    )  # fmt: skip


def _deviation_table(deviations: Mapping[tuple[str, int], dict[str, Any]], subjects: Sequence[str]) -> Table:
    """Build a table of how well sigma and anomaly indicate the error, for each person, at a delay of 4."""
    keys = {
        "rank_correlation": "rank correlation", "auroc_off": "AUROC, joint off by 10 cm",
        "auroc_worst": "AUROC, worst tenth of frames", "auroc_worst_anomaly": "of the anomaly",
        "found_by_stated": "found by stated", "flagged_percent": "flagged, %",
    }  # fmt: skip
    rows = [
        [f"{person}, {text}", *("–" if (v := deviations[name, 4][person][key]) is None else f"{v:.2f}" for key in keys)]
        for name, text in ((UNKNOWN, "sensor unknown"), (KNOWN, "sensor known"))
        for person in subjects
    ]
    return Table(
        "kinect_vicon-deviation", "Real Kinect: what the stated deviation and the anomaly tell of the error, delay 4",
        ["person left out", *keys.values()], rows,
        "Deviation of a joint, its root mean square over a frame's joints, and the frame's anomaly; 0.5 is chance.",
    )  # fmt: skip
