"""Clips of a Kinect beside Vicon (UI-PRMD), scores against Vicon, and the methods compared, each for the person who is
left out: filters, baselines that learn, and steadypose.

An estimate is aligned by one rotation and translation per clip, then by a constant offset per joint in the trunk's
frame. The offset is learned on other people. The rest of it, which differs between persons, is most of the error of a
method that does not know it. So each clip is also scored with its own offset.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn.metrics import roc_auc_score

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines import kinect_regression, smoothnet
from steadypose.benchmarks.baselines.filters import FILTERS, Baseline
from steadypose.benchmarks.bench import Bench, Tuned, loss, tune
from steadypose.benchmarks.motion import digest, side_by_side
from steadypose.benchmarks.provenance import ROOT
from steadypose.benchmarks.scores import acceleration_error, interval, length_variation, position_error, sigma_ratio
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, J
from steadypose.prior.clean.settings import CorrectSettings, PriorSettings
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.readers import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, load_pairs
from steadypose.training.data.recordings import trunk_frame
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes.sensor_bias import train_correction

SUBJECTS = TRAIN_SUBJECTS + VALIDATION_SUBJECTS

OUT_OF_STEP = ("s01",)
"""People whose Kinect and Vicon are not synchronised. For 12 % of s01's clips the best lag is three frames or more. Its
error measures the lag, so no mean includes it."""

SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SCORED = ("head", *(f"{side}_{joint}" for joint in SIDED for side in ("left", "right")))
"""The 13 scored joints: those that both systems have and that are points of the body."""
_CORNERS = [SCORED.index(f"{side}_{part}") for part in ("hip", "shoulder") for side in ("left", "right")]
OTHER_SIDE = tuple(SCORED.index(JOINTS[MIRROR[J[name]]]) for name in SCORED)
BONES = tuple(
    (SCORED.index(f"{side}_{a}"), SCORED.index(f"{side}_{b}"))
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
)


class Clip(NamedTuple):
    """One repetition of a movement."""

    name: str
    subject: str
    kinect: Floats  # (T, 22, 3) metres, skeleton kinect22, z up
    raw: Floats  # (T, 13, 3) metres, its scored joints
    centres: Floats  # (T, 13, 3) metres, the truth


def read_clips(path: Path, subjects: Sequence[str], every: int) -> list[Clip]:
    """Read every n-th clip of each of these subjects."""
    scored, clips = [J[name] for name in SCORED], []
    for pair in (pair for subject in subjects for pair in load_pairs(path, (subject,))[::every]):
        raw = to_canonical(KINECT22, pair.kinect)[0][:, scored]
        clips.append(Clip(pair.name, pair.subject, pair.kinect, raw, pair.vicon[:, scored]))
    return clips


OFF = 0.10  # error that the predicted standard deviation should indicate, metres
WORST = 0.1  # share of frames, the worst by mean error, that the anomaly should indicate


class Scores(NamedTuple):
    position: Floats  # (C,) metres
    moving: Floats  # (C,) metres, with this clip's own offset: the part of the error that changes with the pose
    acceleration: Floats  # (C,) metres/frame²
    variation: Floats  # (C,) of bone lengths, relative


def learn_offset(truths: Sequence[Floats], aligned: Sequence[Floats]) -> Floats:
    """Return the offset (13, 3) in the trunk's frame that moves aligned estimates of each joint to the truth,
    metres."""
    apart = [(t - a) @ trunk_frame(a, _CORNERS) for t, a in zip(truths, aligned, strict=True)]
    return np.nanmean(np.concatenate(apart), axis=0)


def score(truths: Sequence[Floats], aligned: Sequence[Floats], offset: Floats) -> Scores:
    """Score each clip's aligned estimate, moved by the offset."""
    found = []
    for truth, estimate in zip(truths, aligned, strict=True):
        placed, own = move(estimate, offset), move(estimate, learn_offset([truth], [estimate]))
        errors = position_error(placed, truth), position_error(own, truth), acceleration_error(placed, truth)
        found.append((*map(np.nanmean, errors), length_variation(estimate, BONES)))
    return Scores(*np.array(found).T)


def align(truths: Sequence[Floats], estimates: Sequence[Floats]) -> list[Floats]:
    """Rotate and translate each clip's estimate as a whole to be nearest to the truth."""
    aligned = []
    for truth, estimate in zip(truths, estimates, strict=True):
        rotation, translation = rigid_alignment(estimate, truth)
        aligned.append(estimate @ rotation.T + translation)
    return aligned


def move(estimate: Floats, offset: Floats) -> Floats:
    """Add a constant offset (13, 3) in the trunk's frame to an estimate (T, 13, 3)."""
    return estimate + np.einsum("tab,jb->tja", trunk_frame(estimate, _CORNERS), offset)


def quick_score(clips: Sequence[Clip], answers: Sequence[Floats]) -> dict[str, float]:
    """Return errors (mm, mm/frame²) with the offset learned on the same clips, for tuning."""
    truths = [clip.centres for clip in clips]
    aligned = align(truths, answers)
    scores = score(truths, aligned, learn_offset(truths, aligned))
    return {"position_mm": _mm(scores.position), "acceleration_mm": _mm(scores.acceleration)}


def _mm(values: Floats) -> float:
    return round(float(np.mean(values)) * 1000, 3)


def summary(clips: Sequence[Clip], scores: Scores) -> dict[str, Any]:
    """Return a method's figures: mm, mm/frame², per cent, with 95 % intervals over people; and each subject's position.

    Subjects `OUT_OF_STEP` are left out of all means.
    """
    subject = np.array([clip.subject for clip in clips])
    kept = ~np.isin(subject, OUT_OF_STEP)
    found: dict[str, Any] = {"bone_variation_percent": round(float(scores.variation[kept].mean()) * 100, 3)}
    for name in ("position", "moving", "acceleration"):
        values = getattr(scores, name)
        found[f"{name}_mm"] = _mm(values[kept])
        found[f"{name}_ci_mm"] = [round(1e3 * end, 3) for end in interval(values[kept], subject[kept])[1:3]]
    return found | {"people_mm": {str(who): _mm(scores.position[subject == who]) for who in np.unique(subject)}}


def deviation(error: Floats, sigma: Floats, anomaly: Floats, flagged: NDArray[np.bool_]) -> dict[str, float | None]:
    """Measure how well the predicted deviation (N, 13), metres, and the anomaly (N,) of each frame indicate the error.

    ``error`` (N, 13) is in metres, NaN where Vicon has no joint; ``flagged`` (N,) frames count as anomalies. Returns
    the rank correlation of sigma with the error; areas under the ROC curve (None if one class is empty) of sigma for
    joints off by more than `OFF`, and, for the `WORST` frames by mean error, of the root mean square of sigma over the
    joints and of the anomaly; the error-to-sigma ratio; and the share flagged.
    """
    known = np.isfinite(error) & np.isfinite(sigma)
    off = error[known] > OFF
    frames = np.isfinite(anomaly) & known.any(axis=1)
    mean = np.nanmean(error[frames], axis=1)
    worst = mean > np.quantile(mean, 1 - WORST)
    squared = np.where(known, sigma, np.nan)[frames] ** 2
    return {
        "rank_correlation": round(float(np.corrcoef(rankdata(sigma[known]), rankdata(error[known]))[0, 1]), 3),
        "auroc_off": _auroc(off, sigma[known]),
        "off_percent": round(100 * float(off.mean()), 2),
        "auroc_worst": _auroc(worst, np.sqrt(np.nanmean(squared, axis=1))),
        "auroc_worst_anomaly": _auroc(worst, anomaly[frames]),
        "found_by_stated": round(sigma_ratio(error, sigma), 3),
        "flagged_percent": round(100 * float(flagged.mean()), 2),
    }


def _auroc(wrong: NDArray[np.bool_], score: Floats) -> float | None:
    return round(float(roc_auc_score(wrong, score)), 3) if 0 < wrong.sum() < len(wrong) else None


RIDGE, RIDGE_PENALTY = "ridge regression", 2200.0
"""Name and penalty of the ridge regression. The penalty was chosen by a search on s07 and s08, the same at every
delay."""
TCN = "temporal convolution"
SMOOTHNET = "SmoothNet-style"
UNKNOWN, KNOWN = "steadypose", "steadypose, sensor known"


class Stated(NamedTuple):
    """steadypose's output for a clip, besides positions."""

    sigma: Floats  # (T, 13) metres
    anomaly: Floats  # (T,)
    flagged: NDArray[np.bool_]  # (T,)


Run = Callable[[Sequence[Clip]], tuple[list[Floats], list[Stated] | None]]
"""Maps clips to (T, 13, 3) metres each, and steadypose's further output for them."""


@dataclass(frozen=True)
class Method:
    name: str  # name in tables
    delay: int  # frames
    run: Run  # what it does
    parameters: Mapping[str, float] = field(default_factory=dict)  # tuned parameters


def run_filter(
    clips: Sequence[Clip], run: Callable[[Floats, Floats], Floats], whole_body: bool = False
) -> tuple[list[Floats], None]:
    """Return a filter's estimates of each clip, (T, 13, 3) metres, as a `Run`.

    All clips are processed together, side by side. Most filters receive only the scored joints, in two thirds of the
    time; others need the ``whole_body``.
    """
    batch = side_by_side([to_canonical(KINECT22, clip.kinect)[0] if whole_body else clip.raw for clip in clips])
    answers = run(batch, np.arange(len(batch)) / FPS)
    if whole_body:
        answers = answers[:, :, [J[name] for name in SCORED]]
    return [answers[: len(clip.raw), number] for number, clip in enumerate(clips)], None


def run_ours(clips: Sequence[Clip], settings: PriorSettings, delay: int) -> tuple[list[Floats], list[Stated]]:
    """Clean each clip as by ``steadypose clean --delay K``.

    For a clip alone, the command gives the same numbers except for its last few frames. There a shorter clip ends by
    absence, not with the stream (0.05 mm of a clip's mean, up to 4 mm in its last frame).
    """
    batch = side_by_side([clip.kinect for clip in clips])
    cleaned = product.run(settings, batch, np.arange(len(batch)) / FPS, delay, "kinect22")
    scored = [J[name] for name in SCORED]
    positions, sigma = cleaned.positions[:, :, scored], cleaned.sigma[:, :, scored]
    lengths = [len(clip.kinect) for clip in clips]
    return (
        [positions[:n, c] for c, n in enumerate(lengths)],
        [Stated(sigma[:n, c], cleaned.anomaly[:n, c], cleaned.flagged[:n, c]) for c, n in enumerate(lengths)],
    )


@dataclass
class Kinect:
    """The methods, with each person left out in turn. What does not depend on the person is computed once."""

    bench: Bench  # settings of the study
    data: Path  # ``ui_prmd.npz``
    clips: Sequence[Clip]  # clips of all people
    taught: Sequence[Clip]  # clips of all people from which baselines learn
    _answers: dict[tuple[str | float, ...], dict[str, tuple[Floats, Stated | None]]] = field(default_factory=dict)

    def tuned(self, on: Sequence[Clip]) -> dict[tuple[str, int], Tuned]:
        """Run one parameter search for each filter and delay on the clips of all people, with figures for each
        subject."""
        groups = {subject: [c for c in on if c.subject == subject] for subject in dict.fromkeys(c.subject for c in on)}

        def evaluate(baseline: Baseline, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
            filtered, _ = run_filter(on, partial(baseline.run, delay=delay, **parameters), baseline.whole_body)
            answers = dict(zip((c.name for c in on), filtered, strict=True))
            found = {s: quick_score(some, [answers[c.name] for c in some]) for s, some in groups.items()}
            figures = {f"{s} {key}": value for s, some in found.items() for key, value in some.items()}
            for key in ("position_mm", "acceleration_mm"):
                figures[key] = round(float(np.mean([own[key] for own in found.values()])), 3)
            return figures

        return tune(self.bench, evaluate, "Kinect", FILTERS)

    def methods(self, left_out: str, tuned: Mapping[tuple[str, int], Tuned]) -> Iterator[Method]:
        """Yield all methods, tuned and trained without this person."""
        densities: dict[int, float] = {}
        for (name, delay), search in tuned.items():
            baseline = next(p for p in FILTERS if p.name == name)
            parameters = best_without(left_out, search, baseline)
            if name == "Kalman, constant velocity":
                densities[delay] = parameters["density"]
            at = partial(baseline.run, delay=delay, **parameters)
            run = partial(run_filter, run=at, whole_body=baseline.whole_body)
            once = partial(self._once, name=(name, delay, *parameters.values()), run=run)
            yield Method(name, delay, once, parameters)
        for delay in self.bench.delays:
            for seed, net in enumerate(self.bench.smoothnets):
                run = partial(run_filter, run=partial(_by_network, net=net, delay=delay))
                yield Method(SMOOTHNET, delay, partial(self._once, name=(SMOOTHNET, delay, seed), run=run))
        others = [c for c in self.taught if c.subject != left_out]
        for delay in self.bench.delays:
            yield from learners(others, delay, densities[delay], 60 if self.bench.quick else 1000)
        known = PriorSettings(correct=CorrectSettings(sensor=str(self.correction(left_out))))
        for delay in self.bench.delays:
            run = partial(run_ours, settings=PriorSettings(), delay=delay)
            yield Method(UNKNOWN, delay, partial(self._once, name=(UNKNOWN, delay), run=run))
            yield Method(KNOWN, delay, partial(run_ours, settings=known, delay=delay))

    def correction(self, left_out: str) -> Path:
        """Return the sensor correction trained without this person, or loaded from ``runs``."""
        steps = 40 if self.bench.quick else 4000
        folder = ROOT / "runs" / f"kinect-{digest(self.data)}-{steps}"
        name = f"correction-without-{left_out}"
        path = folder / name / f"{name}.safetensors"
        if not path.is_file():
            self.bench.progress.stop()  # training draws its own progress bar
            subjects = tuple(s for s in dict.fromkeys(c.subject for c in self.taught) if s != left_out)
            train_correction(TrainingOptions(self.data, folder, f"without-{left_out}", steps), subjects)
            self.bench.progress.start()
        return path

    def _once(
        self, clips: Sequence[Clip], name: tuple[str | float, ...], run: Run
    ) -> tuple[list[Floats], list[Stated] | None]:
        """Run a method that does not depend on the person left out once over all clips, and keep its output by
        ``name``."""
        if name not in self._answers:
            positions, stated = run(self.clips)
            every = zip(self.clips, positions, stated or [None] * len(positions), strict=True)
            self._answers[name] = {clip.name: (own, told) for clip, own, told in every}
        found = [self._answers[name][clip.name] for clip in clips]
        told = [of_clip for _, of_clip in found if of_clip is not None]
        return [own for own, _ in found], told or None


def best_without(left_out: str, search: Tuned, baseline: Baseline) -> dict[str, float]:
    """Return the parameters that are best for the other people, among the points that a search evaluated."""
    if not search.tried:
        return search.parameters

    def of_others(point: Mapping[str, float]) -> float:
        keys = ("position_mm", "acceleration_mm")
        others = {k: v for k, v in point.items() if k.endswith(keys) and " " in k and not k.startswith(left_out)}
        return loss({key: float(np.mean([v for k, v in others.items() if k.endswith(key)])) for key in keys})

    winner = min(search.tried, key=of_others)
    return {name: winner[name] for name in baseline.space}


def learners(clips: Sequence[Clip], delay: int, density: float, steps: int) -> Iterator[Method]:
    """Yield the baselines that learn from these clips of a Kinect beside Vicon, smoothed with this process density."""
    truths, scored = [clip.centres for clip in clips], [J[name] for name in SCORED]

    def smoothed(some: Sequence[Clip], ahead: int) -> list[kinect_regression.Smoothed]:
        return kinect_regression.smoothed([clip.kinect for clip in some], scored, delay, ahead, density)

    def method(name: str, ahead: int, answer: Callable[[kinect_regression.Smoothed], Floats]) -> Method:
        return Method(name, delay, lambda some: ([answer(clip) for clip in smoothed(some, ahead)], None))

    yield method(RIDGE, 0, kinect_regression.ridge(smoothed(clips, 0), truths, RIDGE_PENALTY))
    ahead = kinect_regression.look_ahead(delay)
    lesson = smoothed(clips, ahead)
    net = kinect_regression.temporal_convolution(lesson, truths, OTHER_SIDE, ahead, steps, seed=0)
    yield method(TCN, ahead, net)


def _by_network(seen: Floats, stamps_s: Floats, net: smoothnet.SmoothNet, delay: int) -> Floats:
    return smoothnet.smooth(net, seen, (delay,))[0]
