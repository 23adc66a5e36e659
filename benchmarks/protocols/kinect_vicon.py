"""Real Kinect against Vicon: what cleaning does to the noise of a real sensor (UI-PRMD, by subject).

Protocol, the same for every method. The Kinect's 22 joints at 30 Hz go in; 13 joints are scored (head, shoulders,
elbows, wrists, hips, knees, ankles) against the Vicon's joint centres (`prior.motion.plug_in_gait`). Each clip is
aligned by one rotation and one translation. Then a constant offset a joint, in the frame of the trunk that hips and
shoulders span, is added: two systems do not mean the same point by "hip". Each method's own offset is learned on its
own output on the training subjects s01-s06, never on the clips that are scored. Scored are subjects s07-s08, every
second clip: movements done right, and done wrong on purpose (``_inc``).

Peers are tuned on every third of the clips that are scored, which favours them. At a delay of k frames a frame is
answered with k later ones known; at the end of a clip, with those there are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks import figures, ours
from steadypose.benchmarks.bench import Bench, Result, over_seeds, tune, tuning_log
from steadypose.benchmarks.metrics import (
    acceleration_error,
    body_frame,
    bootstrap,
    bootstrap_ratio,
    length_variation,
    position_error,
    reliability,
    sigma_ratio,
)
from steadypose.benchmarks.peers import kinect_regression, smoothnet
from steadypose.benchmarks.peers.filters import FILTERS, OFFLINE, Peer
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.tuning import Tuned, loss, search
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, J
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.motion.ui_prmd import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, KinectPair, load_pairs
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]

SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SCORED = ("head", *(f"{side}_{joint}" for joint in SIDED for side in ("left", "right")))
"""The 13 joints that are scored: those that both systems have and that are points of the body."""
OTHER_SIDE = tuple(SCORED.index(JOINTS[MIRROR[J[name]]]) for name in SCORED)
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

RIDGE = "ridge regression"
RIDGE_SPACE = {"penalty": (1e-2, 1e4)}
TCN = "temporal convolution"


class Clip(NamedTuple):
    """One repetition of a movement."""

    name: str
    subject: str
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
    centres, skin = pair.vicon[:, scored], np.stack(markers, axis=1)
    return Clip(pair.name, pair.subject, pair.kinect, raw, centres, skin)


@dataclass(frozen=True)
class Method:
    """A way to clean clips, at one delay.

    Attributes:
        name: in tables.
        delay: frames.
        run: clips to (T, 13, 3) metres each, and where it states one, its standard deviation (T, 13).
        parameters: found by tuning.
    """

    name: str
    delay: int
    run: Callable[[Sequence[Clip]], tuple[list[Floats], list[Floats] | None]]
    parameters: Mapping[str, float] = field(default_factory=dict)


def run_filter(clips: Sequence[Clip], run: Callable[[Floats, Floats], Floats]) -> list[Floats]:
    """A filter's answers for each clip, (T, 13, 3) metres. All clips go through it at once, side by side."""
    batch = side_by_side([clip.raw for clip in clips])
    answers = run(batch, np.arange(len(batch)) / FPS)
    return [answers[: len(clip.raw), number] for number, clip in enumerate(clips)]


def side_by_side(clips: Sequence[Floats]) -> Floats:
    """(T, C, J, 3) of clips (T, J, 3) of different lengths, NaN after their ends."""
    batch = np.full((max(map(len, clips)), len(clips), *clips[0].shape[1:]), np.nan)
    for number, clip in enumerate(clips):
        batch[: len(clip), number] = clip
    return batch


def run_ours(clips: Sequence[Clip], variant: str, delay: int) -> tuple[list[Floats], list[Floats]]:
    """What ``steadypose clean --delay K`` makes of each clip: (T, 13, 3) metres, and its sigma (T, 13).

    The command gives the same numbers for each clip alone, but for its last few frames, where a shorter clip ends by
    absence and not with the stream (0.05 mm of a clip's mean, up to 4 mm in its last frame).
    """
    batch = side_by_side([clip.kinect for clip in clips])
    cleaned = ours.run(VARIANTS[variant], batch, np.arange(len(batch)) / FPS, delay, "kinect22")
    scored = [J[name] for name in SCORED]
    positions, sigma = cleaned.positions[:, :, scored], cleaned.sigma[:, :, scored]
    return (
        [positions[: len(clip.kinect), c] for c, clip in enumerate(clips)],
        [sigma[: len(clip.kinect), c] for c, clip in enumerate(clips)],
    )


VARIANTS = {
    name: settings
    for name, settings in {**ours.OURS, **ours.OURS_KINECT}.items()
    if settings.bias_sigma == PriorSettings().bias_sigma
}
"""Not those that are told that the sensor has no slow error: a Kinect has."""


def learn_offset(truths: Sequence[Floats], aligned: Sequence[Floats]) -> Floats:
    """(13, 3) metres in the trunk's frame: what, added to aligned estimates, brings each joint to the truth."""
    pairs = zip(truths, aligned, strict=True)
    return np.nanmean(np.concatenate([np.einsum("tba,tjb->tja", _trunk(a), t - a) for t, a in pairs]), axis=0)


def score(truths: Sequence[Floats], aligned: Sequence[Floats], offset: Floats) -> Scores:
    """Errors of each clip, of aligned estimates moved by the offset."""
    errors, acceleration, variation = [], [], []
    for truth, estimate in zip(truths, aligned, strict=True):
        placed = move(estimate, offset)
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


def move(estimate: Floats, offset: Floats) -> Floats:
    """(T, 13, 3) the estimate with a constant offset (13, 3) in the trunk's frame."""
    return estimate + np.einsum("tab,jb->tja", _trunk(estimate), offset)


def _trunk(positions: Floats) -> Floats:
    corners = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
    return body_frame(*(positions[:, SCORED.index(name)] for name in corners))


class Learners:
    """The peers that learn from the Kinect beside Vicon; their training clips, smoothed once for each delay."""

    def __init__(self, bench: Bench, clips: Sequence[Clip], densities: Mapping[int, float]) -> None:
        self._bench, self._densities = bench, densities
        self._truths = [clip.centres for clip in clips]
        self._lesson = lru_cache(maxsize=1)(partial(self.smoothed, clips))

    def smoothed(self, clips: Sequence[Clip], delay: int, ahead: int) -> list[kinect_regression.Smoothed]:
        """Clips as the regressions read them, smoothed as was found best for this delay."""
        scored = [J[name] for name in SCORED]
        return kinect_regression.smoothed([clip.kinect for clip in clips], scored, delay, ahead, self._densities[delay])

    def ridge(self, delay: int, on: Sequence[Clip]) -> tuple[Method, Tuned]:
        """The ridge regression, its penalty searched for like any peer's parameters, on clips ``on``."""
        train, asked = self._lesson(delay, 0), self.smoothed(on, delay, 0)

        def evaluate(parameters: Mapping[str, float]) -> dict[str, float]:
            answer = kinect_regression.ridge(train, self._truths, **parameters)
            return quick_score(on, [answer(clip) for clip in asked])

        tuned = search(RIDGE_SPACE, evaluate, self._bench.budget)
        answer = kinect_regression.ridge(train, self._truths, **tuned.parameters)

        def run(clips: Sequence[Clip]) -> tuple[list[Floats], None]:
            return [answer(clip) for clip in self.smoothed(clips, delay, 0)], None

        return Method(RIDGE, delay, run, tuned.parameters), tuned

    def convolution(self, delay: int, seed: int) -> Method:
        """The temporal convolution, trained at once."""
        ahead = kinect_regression.look_ahead(delay)
        answer = kinect_regression.temporal_convolution(
            self._lesson(delay, ahead),
            self._truths,
            OTHER_SIDE,
            ahead,
            steps=60 if self._bench.quick else 1000,
            seed=seed,
        )

        def run(clips: Sequence[Clip]) -> tuple[list[Floats], None]:
            return [answer(clip) for clip in self.smoothed(clips, delay, ahead)], None

        return Method(TCN, delay, run)


def quick_score(clips: Sequence[Clip], answers: Sequence[Floats]) -> dict[str, float]:
    """Errors (mm, mm/frame²) with the offset learned on these very clips: for tuning."""
    truths = [clip.centres for clip in clips]
    aligned = align(truths, answers)
    scores = score(truths, aligned, learn_offset(truths, aligned))
    return {"position_mm": _mm(scores.position), "acceleration_mm": _mm(scores.acceleration)}


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


def run(bench: Bench) -> Result:
    """Tune, run, score."""
    assert bench.mocap is not None
    path = bench.mocap / "ui_prmd.npz"
    taught = read_clips(path, TRAIN_SUBJECTS, 20 if bench.quick else 2)
    train = taught[:: 2 if bench.quick else 5]
    validation = read_clips(path, VALIDATION_SUBJECTS, 9 if bench.quick else 2)
    methods, tuning = _methods(bench, taught, validation[:: 1 if bench.quick else 3])
    records: list[dict[str, Any]] = []
    scored: list[tuple[Method, Scores]] = []
    calibration: dict[str, Any] = {}
    for method in bench.progress.track(methods, description="Kinect against Vicon"):
        answers, sigma = method.run([*train, *validation])
        record: dict[str, Any] = {"method": method.name, "delay": method.delay, "parameters": dict(method.parameters)}
        for truth in ("markers", "centres"):
            known, asked = ([getattr(clip, truth) for clip in part] for part in (train, validation))
            offset = learn_offset(known, align(known, answers[: len(train)]))
            aligned = align(asked, answers[len(train) :])
            result = score(asked, aligned, offset)
            record[f"against_{truth}"] = summary(validation, result)
        figures_ = record["against_centres"]
        record |= {key: figures_[key] for key in ("position_mm", "acceleration_mm")}
        scored.append((method, result))
        if sigma is not None:
            error = np.concatenate([position_error(move(a, offset), t) for a, t in zip(aligned, asked, strict=True)])
            stated = np.concatenate(sigma[len(train) :])
            calibration[f"{method.name}, delay {method.delay}"] = {
                "ratio": round(sigma_ratio(error, stated), 3),
                "bins_m": reliability(error, stated),
            }
            record["ratios"] = _ratios(method, result, scored)
        records.append(record)
    records = over_seeds(records)
    data = {
        "data": {
            "file": path.name, "offset_clips": len(train), "learning_clips": len(taught),
            "validation_clips": len(validation), "joints": SCORED, "fps": FPS,
        },
        "truth_bone_variation_percent": round(
            100 * float(np.mean([length_variation(clip.centres, BONES) for clip in validation])), 3
        ),
        "records": records,
        "calibration": calibration,
        "tuning": tuning,
    }  # fmt: skip
    pictures = {
        "kinect_vicon": figures.curves(
            [r for r in records if r["delay"] >= 0 and r["method"] != "HM-VAE"], "delay",
            {"position_mm": "position error, mm", "acceleration_mm": "acceleration error, mm/frame²"},
            "delay, frames at 30 Hz", "Real Kinect against Vicon, subjects s07 and s08",
        ),
        "kinect_reliability": figures.reliability(
            {name: found["bins_m"] for name, found in calibration.items() if not name.startswith("HM-VAE")},
            "Real Kinect: stated and found",
        ),
    }  # fmt: skip
    tables = [_summary(records, bench.delays), _table(records, calibration, train, taught, validation)]
    return Result(tables, data, pictures)


def _methods(bench: Bench, taught: Sequence[Clip], on: Sequence[Clip]) -> tuple[list[Method], list[dict[str, Any]]]:
    """All methods, tuned on the clips ``on``, and what was tried."""

    def evaluate(peer: Peer, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
        return quick_score(on, run_filter(on, partial(peer.run, delay=delay, **parameters)))

    tuned = tune(bench, evaluate, "Kinect", FILTERS)
    methods = []
    for peer in FILTERS:
        for delay in bench.delays if peer.delays is None else peer.delays:
            parameters = tuned[peer.name, delay].parameters
            one = partial(_filtered, run=partial(peer.run, delay=delay, **parameters))
            methods.append(Method(peer.name, delay, one, parameters))
    for delay in bench.delays:
        for net in bench.smoothnets:
            one = partial(_filtered, run=lambda seen, _, net=net, delay=delay: smoothnet.smooth(net, seen, (delay,))[0])
            methods.append(Method("SmoothNet-style", delay, one))
    densities = {delay: tuned["Kalman, constant velocity", delay].parameters["density"] for delay in bench.delays}
    learners = Learners(bench, taught, densities)
    for delay in bench.progress.track(bench.delays, description="ridge regression"):
        method, tuned[RIDGE, delay] = learners.ridge(delay, on)
        methods.append(method)
    seeds = [(delay, seed) for delay in bench.delays for seed in bench.seeds]
    methods += [learners.convolution(*one) for one in bench.progress.track(seeds, description=TCN)]
    methods += [
        Method(name, delay, partial(run_ours, variant=name, delay=delay))
        for name, settings in VARIANTS.items()
        for delay in bench.delays
        if ours.available(settings, delay)
    ]
    return methods, tuning_log(tuned)


def _filtered(clips: Sequence[Clip], run: Callable[[Floats, Floats], Floats]) -> tuple[list[Floats], None]:
    return run_filter(clips, run), None


def _ratios(method: Method, result: Scores, scored: Sequence[tuple[Method, Scores]]) -> dict[str, Any]:
    """Errors by those of the best tuned filter (least sum of errors), and of each regression, at this delay."""
    names = {peer.name for peer in FILTERS}
    here = [(m, s) for m, s in scored if m.delay <= method.delay and m.delay != OFFLINE]
    filters = [(m, s) for m, s in here if m.name in names]
    best = min(
        filters,
        key=lambda pair: loss({"position_mm": _mm(pair[1].position), "acceleration_mm": _mm(pair[1].acceleration)}),
    )
    rivals = [best, *((m, s) for m, s in here if m.name in (RIDGE, TCN) and m.delay == method.delay)]
    return {
        f"{rival.name}, delay {rival.delay}": {
            "position": [round(v, 4) for v in bootstrap_ratio(result.position, scores.position)],
            "acceleration": [round(v, 4) for v in bootstrap_ratio(result.acceleration, scores.acceleration)],
        }
        for rival, scores in rivals
    }


def _summary(records: Sequence[dict[str, Any]], delays: Sequence[int]) -> Table:
    """A row a method, a column a delay."""
    cells: dict[str, dict[int, str]] = {}
    for record in records:
        figures_ = f"{record['position_mm']:.1f} / {record['acceleration_mm']:.2f}"
        cells.setdefault(record["method"], {})[record["delay"]] = figures_
    return Table(
        name="kinect_vicon-summary",
        title="Real Kinect against Vicon: position error, mm / acceleration error, mm/frame²",
        columns=["method", *(f"delay {delay}" for delay in delays), "offline"],
        rows=[[method, *(found.get(delay, "") for delay in (*delays, OFFLINE))] for method, found in cells.items()],
        note="UI-PRMD, subjects s07 and s08, whom no network has seen; frames at 30 Hz. Details: docs/results.md.",
    )


def _table(
    records: Sequence[dict[str, Any]],
    calibration: Mapping[str, Any],
    train: Sequence[Clip],
    taught: Sequence[Clip],
    validation: Sequence[Clip],
) -> Table:
    body = []
    for record in records:
        figures_ = record["against_centres"]
        low, high = figures_["position_ci_mm"]
        acceleration_low, acceleration_high = figures_["acceleration_ci_mm"]
        subjects = [figures_["groups"][subject]["position_mm"] for subject in VALIDATION_SUBJECTS]
        body.append(
            [
                record["method"],
                "offline" if record["delay"] == OFFLINE else str(record["delay"]),
                f"{record['position_mm']:.1f} ({low:.1f}–{high:.1f})",
                *(f"{value:.1f}" for value in subjects),
                f"{record['acceleration_mm']:.2f} ({acceleration_low:.2f}–{acceleration_high:.2f})",
                f"{figures_['bone_variation_percent']:.1f}",
            ]
        )
    stated = ", ".join(f"{name} {found['ratio']:.2f}" for name, found in calibration.items())
    return Table(
        name="kinect_vicon",
        title="Real Kinect against Vicon: UI-PRMD, subjects s07 and s08",
        columns=["method", "delay, frames", "position, mm", "s07", "s08", "acceleration, mm/frame²", "bone length, %"],
        rows=body,
        note=(
            f"{len(validation)} clips, 13 joints, 30 Hz; in brackets, the 95 % interval by bootstrap over clips. One "
            "rotation and translation a clip, then a constant offset a joint in the trunk's frame, which every method "
            f"learns on {len(train)} clips of s01–s06; regressions learn on {len(taught)} of them. Peers are tuned on "
            "every third of the clips that are scored, each with the same number of evaluations. A delayed Kalman "
            "filter is a fixed-lag RTS smoother. HM-VAE later than 4 frames is its centre frame. Bone length: "
            f"standard deviation by mean. Error found by standard deviation stated: {stated}."
        ),
    )
