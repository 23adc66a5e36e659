"""Ablations: accuracy and cost of each part of the default, each switched off separately.

A part with a setting is switched off by it. Others are replaced in place. The trajectory's parts are ablated after the
default prior, in time-correlated noise of 2 cm, with a known floor. Errors are means over people, relative to what
ships, paired by clip (`benchmarks.scores`). Some parts move no joint but decide what is flagged: their table has false
alarms, and faults that are found. Cost is measured on one body with a hidden arm, a frame at a time, so that every part
has work.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import missing
from steadypose.benchmarks.bench import Bench, numpy_ms
from steadypose.benchmarks.corruption import BEGINS, FAULTS, FAULTS_IN_DEPTH, correlated
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import VARIANTS_22, WORLD_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import interval, ratio, score
from steadypose.benchmarks.studies import hidden_joints, noisy_joints
from steadypose.benchmarks.studies.corrupted import Condition
from steadypose.benchmarks.studies.world import chain, measure
from steadypose.prior.arrays import Floats
from steadypose.prior.clean import reconstruct, steady
from steadypose.prior.clean.exchanged import ExchangedLimbs
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.reconstruct import Denoise
from steadypose.prior.clean.settings import (
    DenoiseSettings,
    FuseSettings,
    GateSettings,
    ImputeSettings,
    OrientSettings,
    PersonSettings,
    PostureSettings,
    PriorSettings,
    RefineSettings,
    ScoreSettings,
    SteadySettings,
)
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.prior.models.mixture import inference
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = (*VARIANTS_22, *WORLD_22)

AS_IT_SHIPS = "as it ships"
DELAY = 4
CLIPS, FRAMES = 48, 90
ROUNDS = 6
"""Number of times that every variant is timed, in turn. The least time of each frame counts, because other work only
adds to it."""


class Part(NamedTuple):
    """What is measured: settings, and what is replaced while they run."""

    settings: PriorSettings
    replaced: Callable[[], AbstractContextManager[Any]] = nullcontext


PARTS: Mapping[str, Part] = {
    AS_IT_SHIPS: Part(PriorSettings()),
    "without the gate": Part(PriorSettings(gate=GateSettings(enabled=False))),
    "without putting sides back": Part(
        PriorSettings(),
        lambda: mock.patch.multiple(
            ExchangedLimbs,
            begin=lambda _, positions: np.zeros(positions.shape[:2], dtype=bool),
            update=lambda _, positions, *__: (0, np.zeros(positions.shape[:2], dtype=bool)),
        ),
    ),
    "without the whole-body experts": Part(
        PriorSettings(), lambda: mock.patch.object(inference, "body_covariance", return_value=np.eye(22))
    ),
    "without the share of white noise": Part(
        PriorSettings(), lambda: mock.patch.object(inference, "fallback", lambda white, *_: np.zeros(len(white)))
    ),
    "without the expected bias": Part(PriorSettings(bias_sigma=0.0)),
    "without HG-VAE's denoising": Part(PriorSettings(denoise=DenoiseSettings(enabled=False))),
    "without denoising time-correlated noise": Part(
        PriorSettings(),
        lambda: mock.patch.object(
            Denoise,
            "_denoised",
            lambda *of, bare=Denoise._denoised: bare(*of[:-2], np.zeros_like(of[-2]), of[-1]),
        ),
    ),
    "with paths low-passed at 2 Hz": Part(
        PriorSettings(),
        lambda: mock.patch.object(reconstruct, "to_tracks", lambda seen, size, _: to_tracks(seen, size)),
    ),
    "without the person's bones": Part(PriorSettings(person=PersonSettings(enabled=False))),
    "without the score": Part(PriorSettings(score=ScoreSettings(enabled=False))),
    "without completion": Part(PriorSettings(impute=ImputeSettings(enabled=False))),
    "without fusion": Part(PriorSettings(fuse=FuseSettings(enabled=False))),
    "without the posture": Part(PriorSettings(posture=PostureSettings(enabled=False))),
    "without the steady stage": Part(PriorSettings(steady=SteadySettings(enabled=False))),
    "without straight paths": Part(PriorSettings(), lambda: mock.patch.object(steady, "STRAIGHTEN", 0.0)),
    "without orientations by the whole body": Part(PriorSettings(orient=OrientSettings(enabled=False))),
    "with HM-VAE, which is off": Part(PriorSettings(refine=RefineSettings(enabled=True))),
}
"""Settings by what is measured without each part. Without whole-body experts, joints are smoothed separately, by the
same network."""

PARTS_OF_THE_WORLD: Mapping[str, TrajectorySettings] = {
    AS_IT_SHIPS: TrajectorySettings(),
    "without contacts": TrajectorySettings(contacts=False),
    "without the network": TrajectorySettings(network=False),
    "without both": TrajectorySettings(contacts=False, network=False),
}

CONDITIONS: Mapping[str, Condition] = {
    name: (noisy_joints.CONDITIONS | hidden_joints.CONDITIONS)[name]
    for name in (
        "1 cm", "2 cm", "4 cm", "1 cm, sides", "correlated 2 cm", "correlated 2 cm, spikes, swaps", "0.5 s",
        "legs unobserved",
    )
} | {"1 cm, camera bounces": noisy_joints.CONDITIONS["1 cm"]}  # fmt: skip
"""Conditions. If joints are hidden, their error is measured, otherwise that of all joints."""

BOUNCE_HEIGHT, BOUNCE_HZ = 0.04, 3.0
"""Amplitude, metres, and frequency of a camera on a robot that bounces without publishing its pose."""

FLAGGING = (
    AS_IT_SHIPS,
    "without the gate",
    "without the expected bias",
    "without HG-VAE's denoising",
    "without the person's bones",
    "without the score",
)
"""Parts that flags may depend on."""

SOUND = ("1 cm", "correlated 2 cm")  # conditions without a fault

FAULTY = (
    "arms exchanged",
    "legs exchanged",
    "left taken for right",
    "another skeleton",
    "another person's arm",
    *FAULTS_IN_DEPTH,
)
"""Faults of the tracker, in addition to time-correlated noise of 2 cm."""


def run(bench: Bench) -> Result:
    clips = bench.clips(FRAMES, 4 if bench.quick else CLIPS)
    cost = costs(clips)
    records: list[dict[str, Any]] = []
    for number, (condition, corrupt) in enumerate(CONDITIONS.items()):
        truth = clips.positions
        if condition.endswith("camera bounces"):
            phase = 2 * np.pi * BOUNCE_HZ * clips.stamps_s[:, None] + np.arange(truth.shape[1])
            truth = truth + (BOUNCE_HEIGHT * np.sin(phase))[..., None, None] * [0.0, 0.0, 1.0]
        seen = corrupt(truth, np.random.default_rng(number))
        hidden = missing(seen)
        for name, part in bench.progress.track(PARTS.items(), description=condition):
            with part.replaced():
                answer = product.run(part.settings, seen, clips.stamps_s, DELAY).positions
            found = score(answer, truth, hidden)
            errors = found.hidden if hidden.any() else found.position
            records.append(_record(condition, name, errors, found.acceleration))
    flags = _flags(bench, clips)
    world, world_cost = _world(bench, clips), world_costs(clips)
    tables = [
        _table("ablations", "What each part is worth: error of joints", "mm", records, cost, clips),
        _table("ablations-acceleration", "The same of acceleration error", "acceleration_mm", records, cost, clips),
        _flags_table(flags, cost, clips),
        _table("ablations-world", "The world's parts: joints and standing feet", "mm", world, world_cost, clips),
    ]
    data = {
        "data": clips.source, "person": clips.person.tolist(), "data_set": clips.data_set.tolist(),
        "records": records, "flags": flags, "world": world, "ms": cost, "world ms": world_cost,
    }  # fmt: skip
    return Result(tables, data)


def _flags(bench: Bench, clips: MotionClips) -> list[dict[str, Any]]:
    """Measure the percentage of frames flagged without a fault, and of clips flagged while they have one."""
    noisy = correlated(clips.positions, 0.02, np.random.default_rng(0))
    records = []
    for condition in (*SOUND, *FAULTY):
        rng, has_fault = np.random.default_rng(0), np.ones(len(clips.offsets), dtype=bool)
        if condition in SOUND:
            seen = noisy_joints.CONDITIONS[condition](clips.positions, rng)
        else:
            windows, has_fault = {**FAULTS, **FAULTS_IN_DEPTH}[condition](noisy.swapaxes(0, 1), rng)
            seen = windows.swapaxes(0, 1)
        for name in bench.progress.track(FLAGGING, description=condition):
            flagged = product.run(PARTS[name].settings, seen, clips.stamps_s, DELAY).flagged[:, has_fault]
            share = flagged if condition in SOUND else flagged[BEGINS:].any(axis=0)
            records.append({"condition": condition, "method": name, "percent": round(100 * float(share.mean()), 2)})
    return records


def _world(bench: Bench, clips: MotionClips) -> list[dict[str, Any]]:
    """Measure `pose/world` without each part, including the speed of standing feet."""
    seen = correlated(clips.positions, 0.02, np.random.default_rng(0))
    records = []
    for name, settings in bench.progress.track(PARTS_OF_THE_WORLD.items(), description="world"):
        answer = chain(PriorSettings(), seen, clips.stamps_s, settings)[1]
        found = score(answer, clips.positions, missing(seen))
        record = _record("correlated 2 cm", name, found.position, found.acceleration)
        feet = measure(clips, answer)
        record["standing_feet_m_s"] = round(0.5 * (feet["left_skate_m_s"] + feet["right_skate_m_s"]), 4)
        records.append(record)
    return records


def costs(clips: MotionClips) -> dict[str, float]:
    """Return milliseconds per frame of one body for each of `PARTS`: the mean over a clip."""
    seen = hidden_joints.CONDITIONS["arm unobserved"](clips.positions[:, :1], np.random.default_rng(0))

    def frames(part: Part) -> Floats:
        with part.replaced():
            return _laps(product.stream(PriorPipeline(replace(part.settings, delay=DELAY)), seen, clips.stamps_s))

    return _least({name: partial(frames, part) for name, part in PARTS.items()})


def world_costs(clips: MotionClips) -> dict[str, float]:
    """Return the same for `PARTS_OF_THE_WORLD`, without the time of the prior before it."""
    seen = hidden_joints.CONDITIONS["arm unobserved"](clips.positions[:, :1], np.random.default_rng(0))
    prior = PriorPipeline(PriorSettings(delay=DELAY))
    messages = list(product.stream(prior, seen, clips.stamps_s, calibrated=True))

    def frames(settings: TrajectorySettings) -> Floats:
        trajectory = TrajectoryPipeline(settings)
        return _laps(answer for message in messages for answer in trajectory.process(message))

    return _least({name: partial(frames, settings) for name, settings in PARTS_OF_THE_WORLD.items()})


def _laps(answers: Iterable[object]) -> Floats:
    """Return the milliseconds between consecutive outputs."""
    ends = [time.perf_counter() for _ in answers]
    return 1e3 * np.diff(ends)


def _least(variants: Mapping[str, Callable[[], Floats]]) -> dict[str, float]:
    """Return the mean over frames of the least of `ROUNDS` times, all variants in turn, after a round that compiles and
    loads."""
    rounds = [{name: run() for name, run in variants.items()} for _ in range(1 + ROUNDS)][1:]
    return {name: round(float(np.mean(np.min([laps[name] for laps in rounds], axis=0))), 3) for name in variants}


def _record(condition: str, name: str, errors: Floats, acceleration: Floats) -> dict[str, Any]:
    """Return a record of the errors of each clip; metres in, mm out."""
    by_clip = {"mm": errors, "acceleration_mm": acceleration}
    return {
        "condition": condition, "method": name,
        **{key: np.round(1e3 * values, 3).tolist() for key, values in by_clip.items()},
    }  # fmt: skip


def _flags_table(records: Sequence[Mapping[str, Any]], cost: Mapping[str, float], clips: MotionClips) -> Table:
    percent = {(record["method"], record["condition"]): record["percent"] for record in records}
    rows = []
    for name in FLAGGING:
        spent = f"{cost[name] - cost[AS_IT_SHIPS]:+.2f}" if name != AS_IT_SHIPS else f"{cost[name]:.2f}"
        alarms, found = ([percent[name, condition] for condition in group] for group in (SOUND, FAULTY))
        rows.append([name, *(f"{share:.1f}" for share in alarms), *(f"{share:.0f}" for share in found), spent])
    note = (
        f"{len(clips.offsets)} clips of {FRAMES} frames, delay {DELAY}. False alarms: percentage of frames. Faults: in "
        f"time-correlated noise of 2 cm, from frame {BEGINS} on or in the whole clip; percentage of clips with the "
        f"fault that are flagged after frame {BEGINS}."
    )
    columns = ["", *(f"false alarms, {name}" for name in SOUND), *FAULTY, "ms a frame"]
    return Table("ablations-flags", f"What flags depend on, delay {DELAY}", columns, rows, note)


def _table(
    name: str,
    title: str,
    figure: str,
    records: Sequence[Mapping[str, Any]],
    cost: Mapping[str, float],
    clips: MotionClips,
) -> Table:
    conditions = list(dict.fromkeys(record["condition"] for record in records))
    by_key = {(record["method"], record["condition"]): record for record in records}
    rows = []
    for part in dict.fromkeys(record["method"] for record in records):
        mine = [by_key[part, condition] for condition in conditions]
        cells = []
        for record, shipped in zip(mine, (by_key[AS_IT_SHIPS, c] for c in conditions), strict=True):
            errors, baseline = (np.array(r[figure], dtype=float) for r in (record, shipped))
            if part == AS_IT_SHIPS:
                cells.append(f"{interval(errors, clips.person).text(1)} mm")
            else:
                cells.append(ratio(errors, baseline, clips.person).text(3))
        feet = [f"{record['standing_feet_m_s']:.3f}" for record in mine if "standing_feet_m_s" in record]
        spent = cost[part] - cost[AS_IT_SHIPS] * (part != AS_IT_SHIPS)
        rows.append([part, *cells, *feet, f"{spent:+.2f}" if part != AS_IT_SHIPS else f"{spent:.2f}"])
    feet = ["standing feet, m/s"] if "standing_feet_m_s" in records[0] else []
    people = len(set(clips.person.tolist()))
    note = (
        f"{len(clips.offsets)} clips of {FRAMES} frames, {people} people, delay {DELAY}. What ships: mean over people; "
        "below it ratios to what ships: above 1 the part helps. In brackets the 95 % interval over people. ms: one "
        f"body and one frame, the mean of the least of {ROUNDS} rounds; below what ships, the difference to it"
        + (", without the prior." if feet else ".")
        + f" 30 steps of a Kalman filter of 44 states in numpy take {numpy_ms():.2f} ms here."
    )
    return Table(name, f"{title}, delay {DELAY}", ["", *conditions, *feet, "ms a frame"], rows, note)
