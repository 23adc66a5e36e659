"""Real Kinect against Vicon: how cleaning reduces the noise of a real sensor (UI-PRMD), each person left out in turn.

The input is the Kinect's 22 joints at 30 Hz. 13 joints (head, shoulders, elbows, wrists, hips, knees, ankles) are
scored against the Vicon's joint centres (`prior.mocap.plug_in_gait`), aligned as in `kinect_methods`, because the two
systems define "hip" differently. For each of the eight people, each method's offset is learned from its own output on
the others. So are the parameters of baselines and the correction of "sensor known". At a delay of k frames, an estimate
uses k later frames, or those up to the end of the clip.

The smoother's mixture that ships was trained on the Kinect's output for s01 to s06, with the Vicon as reference, and
chosen on s07 and s08. The other networks have seen the Vicon's motion of s01 to s06. So "each person left out" holds
for offsets, baselines and the correction, but not for steadypose's smoother. Its rows are too good by the advantage of
people it was fitted to.

s01's two systems are not synchronised: its column is shown, but no mean includes it. More than half of a method's error
here is a constant that differs between persons and definitions of a joint, which no method can know; the second figure
of position, "moving", subtracts it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from steadypose.benchmarks import figures
from steadypose.benchmarks.baselines.filters import OFFLINE
from steadypose.benchmarks.bench import Bench, over_seeds, tuning_log
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import position_error, reliability
from steadypose.benchmarks.studies.kinect_methods import (
    KNOWN,
    OUT_OF_STEP,
    SCORED,
    SUBJECTS,
    UNKNOWN,
    Clip,
    Kinect,
    Method,
    Scores,
    Stated,
    align,
    deviation,
    learn_offset,
    move,
    read_clips,
    score,
    summary,
)
from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = (*CLEAN, "training.recipes.sensor_bias")
"""What the results depend on. No sensor correction that ships: each is trained here, without the person left out."""

OFFSET_CLIPS, TUNING_CLIPS = 3, 5
"""Steps between clips: offsets are learned on every n-th of the others' clips, filters are tuned on every n-th."""


def run(bench: Bench) -> Result:
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
            result, error, stated = _scored(method, asked, others)
            key = (method.name, method.delay)
            runs[key] = runs.get(key, -1) + 1  # networks of several seeds share one name
            parts.setdefault((*key, runs[key]), []).append((result, dict(method.parameters)))
            if stated is not None:
                sigma, anomaly, flagged = (np.concatenate(part) for part in zip(*stated, strict=True))
                deviations.setdefault(key, {})[person] = deviation(error, sigma, anomaly, flagged)
                bins.setdefault(f"{method.name}, delay {method.delay}", []).append((error, sigma))
    records = over_seeds(
        [
            {
                "method": name, "delay": delay,
                **summary(clips, Scores(*map(np.concatenate, zip(*(scores for scores, _ in some), strict=True)))),
                "parameters": {who: parameters for who, (_, parameters) in zip(subjects, some, strict=True)},
                **({"deviation": deviations[name, delay]} if (name, delay) in deviations else {}),
            }
            for (name, delay, _), some in parts.items()
        ]
    )  # fmt: skip
    reliabilities = {
        name: reliability(np.concatenate([error for error, _ in some]), np.concatenate([sigma for _, sigma in some]))
        for name, some in bins.items()
    }
    data = {
        "data": {
            "file": path.name, "people": subjects, "clips": len(clips), "learning_clips": len(taught),
            "joints": SCORED, "fps": FPS, "out of step, in no mean": OUT_OF_STEP,
        },
        "records": records, "reliability": reliabilities, "tuning": tuning_log(tuned),
    }  # fmt: skip
    pictures = {
        "kinect_vicon": figures.curves(
            [r for r in records if r["delay"] >= 0], "delay",
            {"position_mm": "position error, mm", "acceleration_mm": "acceleration error, mm/frame²"},
            "delay, frames at 30 Hz", "Real Kinect against Vicon, each of eight people left out",
        ),
        "kinect_reliability": figures.reliability(reliabilities, "Real Kinect: error and its standard deviation"),
    }  # fmt: skip
    return Result([_table(records, clips, subjects), _deviation_table(deviations, subjects)], data, pictures)


def _scored(
    method: Method, asked: Sequence[Clip], others: Sequence[Clip]
) -> tuple[Scores, Floats, list[Stated] | None]:
    """Score one person's clips; also return errors (N, 13) and steadypose's predictions."""
    answers, stated = method.run([*others, *asked])
    known, wanted = ([clip.centres for clip in part] for part in (others, asked))
    offset = learn_offset(known, align(known, answers[: len(others)]))
    aligned = align(wanted, answers[len(others) :])
    error = [position_error(move(a, offset), t) for a, t in zip(aligned, wanted, strict=True)]
    return score(wanted, aligned, offset), np.concatenate(error), None if stated is None else stated[len(others) :]


_NO_MEAN = f"{', '.join(OUT_OF_STEP)}, whose Kinect is out of step with the Vicon, is in no mean"


def _table(records: Sequence[dict[str, Any]], clips: Sequence[Clip], subjects: Sequence[str]) -> Table:
    return Table.of(
        "kinect_vicon", "Real Kinect against Vicon: UI-PRMD, each person left out in turn",
        [{**r, "delay": "offline" if r["delay"] == OFFLINE else r["delay"]} for r in records],
        {"method": "{method}", "delay, frames": "{delay}",
         "position, mm": "{position_mm:.1f} ({position_ci_mm[0]:.1f}–{position_ci_mm[1]:.1f})",
         "clip's offset off": "{moving_mm:.1f} ({moving_ci_mm[0]:.1f}–{moving_ci_mm[1]:.1f})",
         **{subject: f"{{people_mm[{subject}]:.1f}}" for subject in subjects},
         "acceleration, mm/frame²":
             "{acceleration_mm:.2f} ({acceleration_ci_mm[0]:.2f}–{acceleration_ci_mm[1]:.2f})",
         "bone length, %": "{bone_variation_percent:.1f}"},
        f"{len(clips)} clips, 13 joints, 30 Hz; in brackets, the 95 % interval over people. One "
        "rotation and translation a clip, then a constant offset a joint in the trunk's frame, which every method "
        "learns on the other people. Filters have the parameters that are best for the others, of one search. "
        "Bone length: standard deviation by mean. Clip's offset off: without each joint's constant offset of that "
        f"very clip. {_NO_MEAN}.",
    )  # fmt: skip


def _deviation_table(deviations: Mapping[tuple[str, int], dict[str, Any]], subjects: Sequence[str]) -> Table:
    keys = {
        "rank_correlation": "rank correlation", "auroc_off": "AUROC, joint off by 10 cm",
        "auroc_worst": "AUROC, worst tenth of frames", "auroc_worst_anomaly": "of the anomaly",
        "found_by_stated": "error-to-sigma", "flagged_percent": "flagged, %",
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
