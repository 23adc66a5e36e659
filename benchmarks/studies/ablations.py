"""Ablations: what each part of the default is worth, and what it costs, each switched off by its own setting.

Three conditions: 2 cm of independent noise on every joint; noise of 2 cm that lasts, with spikes and exchanged limbs;
and 1 cm with one lower arm or leg away for half a second. The world's parts are ablated behind the default prior, in
noise of 2 cm that lasts, with the floor known. Errors are means over people (`benchmarks.intervals`), by source and of
all. Cost: of one body of which an arm is hidden, a frame at a time, so that every part has work.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from steadypose.benchmarks import ours
from steadypose.benchmarks.baselines.filters import missing
from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.corruption import correlated
from steadypose.benchmarks.intervals import interval
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import VARIANTS, WORLD
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.scores import score
from steadypose.benchmarks.studies import hidden_joints, noisy_joints
from steadypose.benchmarks.studies.spoiled import Condition
from steadypose.benchmarks.studies.world import chain, measure
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.denoise import DenoiseSettings
from steadypose.prior.clean.fuse import FuseSettings
from steadypose.prior.clean.gate import GateSettings
from steadypose.prior.clean.impute import ImputeSettings
from steadypose.prior.clean.orient import OrientSettings
from steadypose.prior.clean.person import PersonSettings
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.refine import RefineSettings
from steadypose.prior.clean.score import ScoreSettings
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = tuple(dict.fromkeys((*VARIANTS, *WORLD)))

AS_IT_SHIPS = "as it ships"
DELAY = 4
CLIPS, FRAMES = 48, 90
ROUNDS = 4
"""Times that the cost of each variant is measured, in turn; the least counts, as other work only adds to it."""

PARTS: Mapping[str, PriorSettings] = {
    AS_IT_SHIPS: PriorSettings(),
    "without the gate": PriorSettings(gate=GateSettings(enabled=False)),
    "without slow error": PriorSettings(bias_sigma=0.0),
    "without HG-VAE's denoising": PriorSettings(denoise=DenoiseSettings(enabled=False)),
    "without the person's bones": PriorSettings(bones=PersonSettings(enabled=False)),
    "without the score": PriorSettings(score=ScoreSettings(enabled=False)),
    "without completion": PriorSettings(impute=ImputeSettings(enabled=False)),
    "without fusion": PriorSettings(fuse=FuseSettings(enabled=False)),
    "without orientations by the whole body": PriorSettings(orient=OrientSettings(enabled=False)),
    "with HM-VAE, which is off": PriorSettings(refine=RefineSettings(enabled=True)),
}
"""Each part by what is measured without it."""

PARTS_OF_THE_WORLD: Mapping[str, TrajectorySettings] = {
    AS_IT_SHIPS: TrajectorySettings(),
    "without contacts": TrajectorySettings(contacts=False),
    "without the network": TrajectorySettings(network=False),
    "without both": TrajectorySettings(contacts=False, network=False),
}

CONDITIONS: Mapping[str, Condition] = {
    **{name: noisy_joints.CONDITIONS[name] for name in ("2 cm", "lasting 2 cm, spikes, swaps")},
    "0.5 s": hidden_joints.CONDITIONS["0.5 s"],
}


def run(bench: Bench) -> Result:
    """Every part off, in every condition; then the world's."""
    clips = bench.clips(FRAMES, 4 if bench.quick else CLIPS)
    records: list[dict[str, Any]] = []
    cost = costs(clips)
    for number, (condition, spoil) in enumerate(CONDITIONS.items()):
        seen = spoil(clips.positions, np.random.default_rng(number))
        hidden = missing(seen)
        for name, settings in bench.progress.track(PARTS.items(), description=condition):
            found = score(
                ours.run(settings, seen, clips.stamps_s, DELAY).positions, clips.positions, hidden, align=False
            )
            errors = found.hidden if hidden.any() else found.position
            acceleration = interval(found.acceleration_error, clips.person).mean
            records.append(_record(condition, name, clips, errors, acceleration, cost[name]))
    world = _world(bench, clips)
    tables = [
        _table("ablations", "What each part is worth in 2 cm of noise: error of joints, mm", records, "2 cm", clips),
        _table("ablations-faults", "The same with spikes and swaps, mm", records, "lasting 2 cm, spikes, swaps", clips),
        _table("ablations-hidden", "The same of joints hidden for 0.5 s, mm", records, "0.5 s", clips),
        _table("ablations-world", "The world's parts, in 2 cm of noise that lasts: joints, mm", world, "world", clips),
    ]
    return Result(tables, {"data": clips.source, "records": records, "world": world})


def _world(bench: Bench, clips: MotionClips) -> list[dict[str, Any]]:
    """The same of `pose/world`, with the speed of feet that stand."""
    seen = correlated(clips.positions, 0.02, np.random.default_rng(0))
    cost = world_costs(clips)
    records = []
    for name, settings in bench.progress.track(PARTS_OF_THE_WORLD.items(), description="world"):
        answer = chain(PriorSettings(), seen, clips.stamps_s, settings)[1]
        found = score(answer, clips.positions, missing(seen), align=False)
        acceleration = interval(found.acceleration_error, clips.person).mean
        record = _record("world", name, clips, found.position, acceleration, cost[name])
        feet = measure(clips, answer)
        record["standing_feet_m_s"] = round(0.5 * (feet["left_skate_m_s"] + feet["right_skate_m_s"]), 4)
        records.append(record)
    return records


def costs(clips: MotionClips) -> dict[str, float]:
    """Milliseconds a frame of one body, of each of `PARTS`: the mean over a clip."""
    seen = hidden_joints.CONDITIONS["arm never"](clips.positions[:, :1], np.random.default_rng(0))

    def frames(settings: PriorSettings) -> Floats:
        prior = PriorPipeline(replace(settings, delay=DELAY))
        return _laps(ours.stream(prior, seen, clips.stamps_s))

    return _least({name: partial(frames, settings) for name, settings in PARTS.items()})


def world_costs(clips: MotionClips) -> dict[str, float]:
    """The same of `PARTS_OF_THE_WORLD`, without what the prior before it takes."""
    seen = hidden_joints.CONDITIONS["arm never"](clips.positions[:, :1], np.random.default_rng(0))
    prior = PriorPipeline(PriorSettings(delay=DELAY))
    messages = list(ours.stream(prior, seen, clips.stamps_s, calibrated=True))

    def frames(settings: TrajectorySettings) -> Floats:
        trajectory = TrajectoryPipeline(settings)
        return _laps(answer for message in messages for answer in trajectory.process(message))

    return _least({name: partial(frames, settings) for name, settings in PARTS_OF_THE_WORLD.items()})


def _laps(answers: Iterable[object]) -> Floats:
    """Milliseconds between one answer and the next."""
    ends = [time.perf_counter() for _ in answers]
    return 1e3 * np.diff(ends)


def _least(variants: Mapping[str, Callable[[], Floats]]) -> dict[str, float]:
    """The least of the means of `ROUNDS`, all variants in turn; a round before them compiles and loads."""
    means = [{name: float(np.mean(run())) for name, run in variants.items()} for _ in range(1 + ROUNDS)][1:]
    return {name: min(found[name] for found in means) for name in variants}


def _record(
    condition: str, name: str, clips: MotionClips, errors: Floats, acceleration: float, ms: float
) -> dict[str, Any]:
    of_all = interval(errors, clips.person)
    by_source = {
        source: interval(errors[clips.data_set == source], clips.person[clips.data_set == source]).mean
        for source in dict.fromkeys(clips.data_set.tolist())
    }
    return {
        "condition": condition, "method": name, "ms": round(ms, 3),
        "by_source_mm": {source: round(1e3 * mean, 3) for source, mean in by_source.items()},
        "mm": round(1e3 * of_all.mean, 3), "ci_mm": [round(1e3 * end, 3) for end in (of_all.low, of_all.high)],
        "people": of_all.people, "acceleration_mm": round(1e3 * acceleration, 3),
    }  # fmt: skip


def _table(name: str, title: str, records: Sequence[Mapping[str, Any]], condition: str, clips: MotionClips) -> Table:
    """A row a part, a column a source, then the mean over people."""
    mine = [record for record in records if record["condition"] == condition]
    feet = "standing_feet_m_s" in mine[0]
    rows = [
        [
            record["method"],
            *(f"{value:.1f}" for value in record["by_source_mm"].values()),
            f"{record['mm']:.2f}" + (f" ({low:.1f}–{high:.1f})" if np.isfinite(low) else ""),
            f"{record['acceleration_mm']:.2f}",
            *([f"{record['standing_feet_m_s']:.3f}"] if feet else []),
            f"{record['ms']:.2f}",
        ]
        for record in mine
        for low, high in (record["ci_mm"],)
    ]
    columns = ["", *mine[0]["by_source_mm"], "mean over people", "acceleration error, mm/frame²"]
    note = (
        f"{len(clips.offsets)} clips of {FRAMES} frames, {mine[0]['people']} people, delay {DELAY}; in brackets, the "
        f"95 % interval over people. ms: one body and one frame, the least of {ROUNDS} means"
        + (", without the prior." if feet else ".")
    )
    return Table(name, title, [*columns, *(["standing feet, m/s"] if feet else []), "ms a frame"], rows, note)
