"""Real Kinect against Vicon: what cleaning does to the noise of a real sensor (UI-PRMD, by subject).

Protocol, the same for every method. The Kinect's 22 joints at 30 Hz go in; 13 joints are scored (head, shoulders,
elbows, wrists, hips, knees, ankles) against the Vicon's joint centres (`prior.motion.plug_in_gait`). Each clip is
aligned by one rotation and one translation. Then a constant offset a joint, in the frame of the trunk that hips and
shoulders span, is added: two systems do not mean the same point by "hip". Each method's own offset is learned on its
own output on the training subjects s01-s06, never on the clips that are scored. Scored are subjects s07-s08, all
clips: movements done right, and done wrong on purpose (``_inc``).

Filters are tuned on the training subjects for the least sum of position error (mm) and acceleration error
(mm/frame²), for each delay on its own. At a delay of k frames a frame is answered with k later ones known; at the
end of a clip, with those there are.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from benchmarks.metrics import (
    acceleration_error,
    body_frame,
    bootstrap,
    bootstrap_ratio,
    length_variation,
    position_error,
    rigid_alignment,
)
from benchmarks.results import RESULTS, Table, save, show
from msgs.types import Pose, PoseRaw, RawBody
from prior.correct import CorrectSettings
from prior.filters import FixedLagRTS, OneEuroFilter
from prior.motion.ui_prmd import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, KinectPair, load_pairs
from prior.pipeline import PriorPipeline, PriorSettings
from prior.skeletons import KINECT22, J, to_canonical

Floats = NDArray[np.float64]
Parameters = dict[str, float]

SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SCORED = ("head", *(f"{side}_{joint}" for joint in SIDED for side in ("left", "right")))
"""The 13 joints that are scored: those that both systems have and that are points of the body."""
BONES = tuple(
    (SCORED.index(f"{side}_{a}"), SCORED.index(f"{side}_{b}"))
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
)
MARKERS = {
    "head": ("LFHD", "RFHD", "LBHD", "RBHD"),
    **{f"{side}_shoulder": (f"{s}SHO",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_elbow": (f"{s}ELB",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_wrist": (f"{s}WRA", f"{s}WRB") for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_hip": (f"{s}ASI",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_knee": (f"{s}KNE",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_ankle": (f"{s}ANK",) for side, s in (("left", "L"), ("right", "R"))},
}
"""The skin markers nearest to each joint: a second truth, to compare with work that did not find joint centres."""

FILTER_DELAYS = (0, 2, 4, 8)
STEADYPOSE_DELAYS = (0, 2, 4)
MEASUREMENT_SIGMA = 0.02
RTS_GRID = tuple({"acceleration_density": float(q)} for q in np.round(np.geomspace(0.02, 20, 16), 4))
ONE_EURO_GRID = tuple(
    {"min_cutoff_hz": cutoff, "beta": beta}
    for cutoff, beta in itertools.product((0.5, 0.8, 1.2, 1.8, 2.7, 4.0, 6.0), (0.0, 1.0, 2.0, 4.0, 8.0, 16.0))
)


@dataclass(frozen=True)
class Args:
    """Real Kinect against Vicon: raw, tuned filters, and steadypose, at equal delay."""

    mocap: Path
    """folder that holds ui_prmd.npz"""
    quick: bool = False
    """a tenth of the clips, to see that it works; nothing is written unless --out says where"""
    train_every: int = 5
    """tune and learn offsets on every n-th clip of the training subjects"""
    filters_only: bool = False
    """leave steadypose out"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


class Clip(NamedTuple):
    """One repetition of a movement."""

    name: str
    subject: str
    fps: float
    kinect: Floats  # (T, 22, 3) metres, skeleton kinect22, z up
    raw: Floats  # (T, 13, 3) metres, the scored joints of it
    centres: Floats  # (T, 13, 3) metres, the truth
    markers: Floats  # (T, 13, 3) metres, the other truth


@dataclass(frozen=True)
class Scores:
    """What a method gets, one number a clip."""

    position: Floats  # (C,) metres
    acceleration: Floats  # (C,) metres/frame²
    variation: Floats  # (C,) of bone lengths, relative
    joints: Floats  # (13,) metres, mean over the frames of all clips


def read_clips(path: Path, subjects: Sequence[str], every: int) -> list[Clip]:
    """Every n-th clip of these subjects."""
    with np.load(path) as archive:
        marker_names = [str(name) for name in archive["vicon_names"]]
    return [_clip(pair, marker_names) for pair in load_pairs(path, subjects)[::every]]


def _clip(pair: KinectPair, marker_names: Sequence[str]) -> Clip:
    scored = [J[name] for name in SCORED]
    markers = [pair.markers[:, [marker_names.index(m) for m in MARKERS[name]]].mean(axis=1) for name in SCORED]
    raw = to_canonical(KINECT22, pair.kinect)[0][:, scored]
    centres = pair.vicon[:, scored]
    return Clip(pair.name, pair.subject, pair.fps, pair.kinect, raw, centres, np.stack(markers, axis=1))


@dataclass(frozen=True)
class Method:
    """A way to clean clips."""

    name: str
    delay: int
    run: Callable[[Sequence[Clip]], Iterable[Floats]]
    """clips to (T, 13, 3) metres each"""
    parameters: Mapping[str, float] = field(default_factory=dict)


def run_filter(clips: Sequence[Clip], make: Callable[[], OneEuroFilter | FixedLagRTS]) -> list[Floats]:
    """A filter's answers for each clip, (T, 13, 3) metres. All clips go through it at once, side by side."""
    longest = max(len(clip.raw) for clip in clips)
    batch = np.full((longest, len(clips), len(SCORED), 3), np.nan)
    for index, clip in enumerate(clips):
        batch[: len(clip.raw), index] = clip.raw
    smoother = make()
    frames = zip(batch, np.arange(longest) / clips[0].fps, strict=True)
    if isinstance(smoother, OneEuroFilter):
        answers = [smoother.update(frame, t) for frame, t in frames]
    else:
        held = [smoother.update(frame, t) for frame, t in frames]
        answers = [answer.positions for answer in (*held, *smoother.flush()) if answer]
    return [np.stack([answer[i] for answer in answers[: len(clip.raw)]]) for i, clip in enumerate(clips)]


def run_steadypose(clips: Sequence[Clip], delay: int, sensor: str) -> Iterator[Floats]:
    """What the prior of ``steadypose clean --delay K`` makes of each clip: (T, 13, 3) metres.

    Eight clips go through it side by side, as the bodies of one stream, in a fifth of the time. Bodies do not touch
    each other: the command gives the same numbers for each clip alone, but for its last few frames, where a shorter
    clip ends by absence and not with the stream (0.05 mm of a clip's mean, up to 4 mm in its last frame).
    """
    scored = [J[name] for name in SCORED]
    settings = PriorSettings(delay=delay, correct=CorrectSettings(sensor=sensor))
    prior = PriorPipeline(settings)
    for start in range(0, len(clips), settings.max_bodies):
        group = clips[start : start + settings.max_bodies]
        answers: list[list[Floats]] = [[] for _ in group]
        cleaned = [
            clean
            for frame in range(max(len(clip.kinect) for clip in group))
            for clean in prior.process(_message(group, frame))
        ]
        for clean in (*cleaned, *prior.flush()):
            for body in clean.bodies:
                answers[body.id].append(body.positions[scored].astype(np.float64))
        for clip, answer in zip(group, answers, strict=True):
            yield np.stack(answer[: len(clip.kinect)])


def _message(clips: Sequence[Clip], frame: int) -> PoseRaw:
    return PoseRaw(
        stamp_ns=round(frame * 1e9 / clips[0].fps),
        frame_id="kinect",
        source="ui_prmd",
        skeleton="kinect22",
        sensor_pose=Pose.identity(),
        calibrated=False,
        bodies=[
            RawBody(number, clip.kinect[frame], np.ones(22))
            for number, clip in enumerate(clips)
            if frame < len(clip.kinect)
        ],
    )


def learn_offset(truths: Sequence[Floats], aligned: Sequence[Floats]) -> Floats:
    """(13, 3) metres in the trunk's frame: what, added to aligned estimates, brings each joint to the truth."""
    pairs = zip(truths, aligned, strict=True)
    return np.nanmean(np.concatenate([np.einsum("tba,tjb->tja", _trunk(a), t - a) for t, a in pairs]), axis=0)


def score(truths: Sequence[Floats], aligned: Sequence[Floats], offset: Floats) -> Scores:
    """Errors of each clip, of aligned estimates moved by the offset."""
    errors, acceleration, variation = [], [], []
    for truth, estimate in zip(truths, aligned, strict=True):
        placed = estimate + np.einsum("tab,jb->tja", _trunk(estimate), offset)
        errors.append(position_error(placed, truth))
        acceleration.append(np.nanmean(acceleration_error(placed, truth)))
        variation.append(length_variation(estimate, BONES))
    return Scores(
        position=np.array([np.nanmean(error) for error in errors]),
        acceleration=np.array(acceleration),
        variation=np.array(variation),
        joints=np.nanmean(np.concatenate(errors), axis=0),
    )


def align(truths: Sequence[Floats], estimates: Sequence[Floats]) -> list[Floats]:
    """Each clip's estimate, turned and moved as a whole to lie nearest to the truth."""
    aligned = []
    for truth, estimate in zip(truths, estimates, strict=True):
        rotation, translation = rigid_alignment(estimate, truth)
        aligned.append(estimate @ rotation.T + translation)
    return aligned


def _trunk(positions: Floats) -> Floats:
    corners = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
    return body_frame(*(positions[:, SCORED.index(name)] for name in corners))


def tune(clips: Sequence[Clip], grid: Sequence[Parameters], make: Callable[..., Any]) -> Iterator[dict[str, float]]:
    """The grid's points, each with its errors (mm, mm/frame²) on these clips."""
    truths = [clip.centres for clip in clips]
    for point in grid:
        aligned = align(truths, run_filter(clips, partial(make, **point)))
        scores = score(truths, aligned, learn_offset(truths, aligned))
        yield {**point, "position_mm": _mm(scores.position), "acceleration_mm": _mm(scores.acceleration)}


def tuned_filters(clips: Sequence[Clip], progress: Progress, quick: bool) -> tuple[list[Method], dict[str, Any]]:
    """The filters with their best parameters for these clips, and all that was tried."""
    methods, tried = [], {}
    kinds = [("One-Euro", 0, OneEuroFilter, ONE_EURO_GRID)]
    kinds += [("RTS", k, partial(FixedLagRTS, k, measurement_sigma=MEASUREMENT_SIGMA), RTS_GRID) for k in FILTER_DELAYS]
    for name, delay, make, grid in kinds:
        grid = grid[::5] if quick else grid
        title = f"tuning {name}, delay {delay}"
        points = list(progress.track(tune(clips, grid, make), total=len(grid), description=title))
        best = min(points, key=lambda point: point["position_mm"] + point["acceleration_mm"])
        parameters = {key: best[key] for key in grid[0]}
        methods.append(Method(name, delay, partial(run_filter, make=partial(make, **parameters)), parameters))
        tried[f"{name}, delay {delay}"] = points
    return methods, tried


def _mm(values: Floats) -> float:
    return round(float(np.mean(values)) * 1000, 3)


def summary(clips: Sequence[Clip], scores: Scores) -> dict[str, Any]:
    """Figures of a method: millimetres, millimetres/frame², per cent."""
    groups = {subject: [clip.subject == subject for clip in clips] for subject in VALIDATION_SUBJECTS}
    wrong = [clip.name.endswith("_inc") for clip in clips]
    groups |= {"done right": [not w for w in wrong], "done wrong": wrong}
    return {
        "position_mm": _mm(scores.position),
        "position_ci_mm": [round(v * 1000, 3) for v in bootstrap(scores.position)],
        "acceleration_mm": _mm(scores.acceleration),
        "acceleration_ci_mm": [round(v * 1000, 3) for v in bootstrap(scores.acceleration)],
        "bone_variation_percent": round(float(scores.variation.mean()) * 100, 3),
        "joints_mm": dict(zip(SCORED, np.round(scores.joints * 1000, 2).tolist(), strict=True)),
        "groups": {
            name: {"position_mm": _mm(scores.position[mask]), "acceleration_mm": _mm(scores.acceleration[mask])}
            for name, mask in groups.items()
        },
    }


def main(args: Args) -> None:
    """Tune, run, score, print, write."""
    console = Console()
    torch.set_num_threads(1)
    path = args.mocap / "ui_prmd.npz"
    with console.status("reading the recordings"):
        train = read_clips(path, TRAIN_SUBJECTS, 25 if args.quick else args.train_every)
        validation = read_clips(path, VALIDATION_SUBJECTS, 9 if args.quick else 1)
    rows: list[dict[str, Any]] = []
    scores: dict[tuple[str, int], Scores] = {}
    with Progress(console=console) as progress:
        filters, tuning = tuned_filters(train, progress, args.quick)
        raw = Method("raw", 0, lambda clips: [clip.raw for clip in clips])
        steadypose = [
            Method(name, k, partial(run_steadypose, delay=k, sensor=sensor))
            for name, sensor in (("steadypose", ""), ("steadypose, sensor = kinect_v2", "kinect_v2"))
            for k in STEADYPOSE_DELAYS
        ]
        for method in [raw, *filters, *([] if args.filters_only else steadypose)]:
            title = f"{method.name}, delay {method.delay}"
            clips = [*train, *validation]
            answers = list(progress.track(method.run(clips), len(clips), description=title))
            fitted, held = answers[: len(train)], answers[len(train) :]
            row: dict[str, Any] = {"method": method.name, "delay": method.delay, "parameters": method.parameters}
            for truth in ("markers", "centres"):
                known, asked = ([getattr(clip, truth) for clip in part] for part in (train, validation))
                result = score(asked, align(asked, held), learn_offset(known, align(known, fitted)))
                row[f"against_{truth}"] = summary(validation, result)
            scores[method.name, method.delay] = result
            if method in steadypose:
                peer = scores["RTS", method.delay]
                row["ratio_to_rts"] = {
                    "position": bootstrap_ratio(result.position, peer.position),
                    "acceleration": bootstrap_ratio(result.acceleration, peer.acceleration),
                }
            rows.append(row)
    table = _table(rows, len(train), len(validation))
    show(table, console)
    if args.out or not args.quick:
        data = {
            "data": {"train_clips": len(train), "validation_clips": len(validation), "joints": SCORED, "fps": 30},
            "truth_bone_variation_percent": round(
                100 * float(np.mean([length_variation(clip.centres, BONES) for clip in validation])), 3
            ),
            "rows": rows,
            "tuning": tuning,
        }
        console.print(f"wrote {save('kinect_vicon', sys.argv[1:], [table], data, args.out or RESULTS)}")


def _table(rows: Sequence[dict[str, Any]], train: int, validation: int) -> Table:
    body = []
    for row in rows:
        figures = row["against_centres"]
        low, high = figures["position_ci_mm"]
        acceleration_low, acceleration_high = figures["acceleration_ci_mm"]
        subjects = [figures["groups"][subject]["position_mm"] for subject in VALIDATION_SUBJECTS]
        body.append(
            [
                row["method"],
                str(row["delay"]),
                f"{figures['position_mm']:.1f} ({low:.1f}–{high:.1f})",
                *(f"{value:.1f}" for value in subjects),
                f"{figures['acceleration_mm']:.2f} ({acceleration_low:.2f}–{acceleration_high:.2f})",
                f"{figures['bone_variation_percent']:.1f}",
            ]
        )
    return Table(
        name="kinect_vicon",
        title="Real Kinect against Vicon: UI-PRMD, subjects s07 and s08",
        columns=["method", "delay, frames", "position, mm", "s07", "s08", "acceleration, mm/frame²", "bone length, %"],
        rows=body,
        note=(
            f"{validation} clips, 13 joints, 30 Hz; in brackets, the 95 % interval by bootstrap over clips. One "
            "rotation and translation a clip, then a constant offset a joint in the trunk's frame, which every method "
            f"learns on {train} clips of s01–s06; filters are tuned on the same. Bone length: standard deviation by "
            "mean."
        ),
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
