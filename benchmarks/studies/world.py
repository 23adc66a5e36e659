"""The body in the world: root error and foot skate, and drift of a hidden root.

First: in correlated noise (2 cm), with a known floor, the error of the root, and the skate of each foot separately. A
measure that requires both feet to be still, such as RoHM's, ignores walking. Second: with the trunk hidden for two
seconds at a time, the drift of the root per 10 m of path (`benchmarks.studies.root_drift`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import roma
import torch

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE, missing
from steadypose.benchmarks.bench import TUNED_ON, Bench, baselines_of, tune_on, tuning_log
from steadypose.benchmarks.corruption import correlated
from steadypose.benchmarks.metrics import contact_speed, position_error, sigma_ratio
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import VARIANTS_22, WORLD_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import figures, score, source_table
from steadypose.benchmarks.studies.root_drift import Clip, evaluate_fusion, rms
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import JOINTS, limbs
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.timing.rate import FPS
from steadypose.prior.world.observe import FEET, SOLE
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = (*VARIANTS_22, *WORLD_22)

NOISE = 0.02
"""Standard deviation of the noise, metres, with a correlation of 0.9 between frames."""
DELAY = 4
SKATING = 0.10
"""Speed above which a foot in contact skates, m/s."""
UNDER = 0.02
"""Depth under the floor beyond which a sole penetrates it, metres."""
SPEEDS = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, np.inf)
"""Edges of the bins of the root's speed, m/s."""
FRAMES = 192
"""Length of a clip, frames: two times 36 observed and 60 hidden."""


def run(bench: Bench) -> Result:
    """Measure the whole pipeline beside filters, then the fusion without a root."""
    clips = bench.clips(FRAMES, 400).farthest(4 if bench.quick else 24)
    some = clips.every(TUNED_ON)
    other = correlated(some.positions, NOISE, np.random.default_rng(1))
    seen = correlated(clips.positions, NOISE, np.random.default_rng(0))
    baselines = tuple(baseline for baseline in FILTERS if baseline.delays != (OFFLINE,))

    tuned = tune_on(bench, other, some.positions, clips.stamps_s, "world", baselines)
    records: list[dict[str, Any]] = [{"method": "truth", "delay": 0, **measure(clips, clips.positions)}]
    errors: dict[str, Floats] = {}
    for baseline, delay in baselines_of(baselines, bench.delays):
        answer = baseline.run(seen, clips.stamps_s, delay, **tuned[baseline.name, delay].parameters)
        records.append({"method": baseline.name, "delay": delay, **measure(clips, answer)})
        if delay == DELAY:
            errors[baseline.name] = _per_clip(clips, answer)
    by_speed: dict[str, dict[str, float]] = {}
    for name, settings in bench.progress.track(product.PRODUCT.items(), description="world"):
        clean, world, velocities, spreads = chain(settings, seen, clips.stamps_s)
        records.append({"method": f"{name}: pose/clean", "delay": DELAY, **measure(clips, clean)})
        records.append({"method": f"{name}: pose/world", "delay": DELAY, **measure(clips, world)})
        errors |= {f"{name}: pose/clean": _per_clip(clips, clean), f"{name}: pose/world": _per_clip(clips, world)}
        if name == "steadypose":
            by_speed = root_by_speed(clips, world[:, :, 0], velocities, spreads)
    quaternions = roma.rotmat_to_unitquat(torch.from_numpy(clips.rotations)).numpy()
    hidden = {
        name: {key: round(value, 4) for key, value in errors.summary().items()}
        for name, errors in evaluate_fusion(
            [Clip(clips.positions[:, c], quaternions[:, c], clips.contacts[:, c]) for c in range(len(clips.offsets))]
        ).items()
        if name != "as observed"
    }
    source = {**clips.source, "scored clips": len(clips.offsets)}
    best = min(
        (baseline.name for baseline in baselines if baseline.name in errors), key=lambda name: errors[name].mean()
    )
    sources = source_table(
        "world-sources", f"In the world, through noise of 2 cm that lasts: joints by source, mm, delay {DELAY}",
        {("no alignment", name): found for name, found in errors.items()}, clips, best,
    )  # fmt: skip
    data = {
        "data": source, "records": records, "root by speed": by_speed, "root hidden": hidden,
        "tuning": tuning_log(tuned),
    }  # fmt: skip
    tables = [sources, _table(records, len(clips.offsets)), _root_table(by_speed), _hidden_table(hidden)]
    return Result(tables, data)


def chain(
    settings: product.PriorSettings, seen: Floats, stamps_s: Floats, world_settings: TrajectorySettings | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Run clips (T, C, 22, 3), calibrated, through prior and trajectory.

    Returns pose/clean and pose/world, (T, C, 22, 3); the velocities of the root, (T, C, 3) m/s; and the predicted
    standard deviations of its position and velocity, (T, C, 6). All are NaN without an estimate.
    """
    count = seen.shape[1]
    prior = PriorPipeline(replace(settings, delay=DELAY, max_bodies=product.SLOTS_A_CLIP * count))
    trajectory = TrajectoryPipeline(world_settings or TrajectorySettings(weights=settings.refine.weights))
    clean, world = np.full(seen.shape, np.nan), np.full(seen.shape, np.nan)
    velocities, spreads = np.full((*seen.shape[:2], 3), np.nan), np.full((*seen.shape[:2], 6), np.nan)
    for row, message in enumerate(product.stream(prior, seen, stamps_s, calibrated=True)):
        for body in message.bodies:
            clean[row, body.id] = body.positions
        for answer in trajectory.process(message):
            for body in answer.bodies:
                world[row, body.id] = body.positions
                velocities[row, body.id] = body.root_velocity
                spreads[row, body.id] = np.sqrt(np.diag(body.covariance))
    return clean, world, velocities, spreads


def root_by_speed(
    clips: MotionClips, positions: Floats, velocities: Floats, spreads: Floats
) -> dict[str, dict[str, float]]:
    """Return errors of root and velocity by the root's true speed: RMS along an axis, and the error-to-sigma ratio.

    ``positions`` are of the root, (T, C, 3); ``velocities`` and ``spreads`` are of `chain`.
    """
    true_velocities = np.gradient(clips.positions[:, :, 0], 1 / FPS, axis=0)
    speed = np.linalg.norm(true_velocities, axis=-1)
    off, drifts = positions - clips.positions[:, :, 0], velocities - true_velocities
    found: dict[str, dict[str, float]] = {}
    for low, high in pairwise(SPEEDS):
        inside = (speed >= low) & (speed < high) & np.isfinite(off).all(axis=-1)
        if not inside.any():
            continue
        found[f"{low:g}-{high:g}" if np.isfinite(high) else f"above {low:g}"] = {
            "frames": int(inside.sum()),
            "position_mm": round(1e3 * rms(off[inside]), 2),
            "position_ratio": round(_honest(off[inside], spreads[inside, :3]), 3),
            "velocity_m_s": round(rms(drifts[inside]), 4),
            "velocity_ratio": round(_honest(drifts[inside], spreads[inside, 3:]), 3),
        }
    return found


def _honest(error: Floats, spread: Floats) -> float:
    return sigma_ratio(np.linalg.norm(error / spread, axis=-1), np.ones(len(error)))


def _per_clip(clips: MotionClips, answer: Floats) -> Floats:
    """Return the mean error of joints in each clip, (C,) metres."""
    return np.nanmean(position_error(answer, clips.positions), axis=(0, 2))


def measure(clips: MotionClips, answer: Floats) -> dict[str, Any]:
    """Return the errors of position and pose in the world (mm), and of the feet.

    For the feet: mean speed in contact (m/s), share of frames that skate, and share with a sole under the floor (%).
    """
    found = figures(score(answer, clips.positions, missing(clips.positions)))
    root = position_error(answer[:, :, 0], clips.positions[:, :, 0])
    result = {key: found[key] for key in ("position_mm", "acceleration_mm")}
    result["root_mm"] = round(float(np.nanmean(root)) * 1e3, 2)
    legs = np.ravel(limbs(("hip", "knee", "ankle", "foot")))
    own = position_error(answer[:, :, legs], clips.positions[:, :, legs])
    result["legs_mm"] = round(float(np.nanmean(own)) * 1e3, 2)
    soles = answer[:, :, FEET, 2] - SOLE
    result["penetration_percent"] = round(100 * float((soles.min(axis=2) < -UNDER).mean()), 2)
    for side in ("left", "right"):
        joints = [j for j in CONTACT_JOINTS if JOINTS[j] in (f"{side}_ankle", f"{side}_foot")]
        labels = clips.contacts[:, :, [CONTACT_JOINTS.index(j) for j in joints]]
        speed = np.concatenate(
            [contact_speed(answer[:, c, joints], labels[:, c], clips.stamps_s).ravel() for c in range(answer.shape[1])]
        )
        speed = speed[np.isfinite(speed)]
        result[f"{side}_skate_m_s"] = round(float(speed.mean()), 4)
        result[f"{side}_skating_percent"] = round(100 * float((speed > SKATING).mean()), 2)
    return result


def _table(records: list[dict[str, Any]], clips: int) -> Table:
    return Table.of(
        "world", "In the world, through noise of 2 cm that lasts: place, pose and standing feet", records,
        {"method": "{method}", "delay, frames": "{delay}", "joints, mm": "{position_mm:.1f}",
         "legs, mm": "{legs_mm:.1f}", "root, mm": "{root_mm:.1f}",
         "acceleration error, mm/frame²": "{acceleration_mm:.2f}", "left foot, m/s": "{left_skate_m_s:.3f}",
         "right foot, m/s": "{right_skate_m_s:.3f}", "left skates, %": "{left_skating_percent:.1f}",
         "right skates, %": "{right_skating_percent:.1f}", "under the floor, %": "{penetration_percent:.1f}"},
        f"The {clips} clips of {FRAMES} frames that travel farthest, floor known, no alignment. "
        "Feet: mean horizontal speed of ankle and toe in frames in which they stand in truth; skating: faster than "
        f"{SKATING:.2f} m/s; under the floor: frames in which a sole (heel {1e3 * SOLE[0]:.0f}, toe "
        f"{1e3 * SOLE[2]:.0f} mm under its joint) is, by more than {1e3 * UNDER:.0f} mm. "
        "Baselines tuned on every third clip with other noise.",
    )  # fmt: skip


def _root_table(by_speed: Mapping[str, Mapping[str, float]]) -> Table:
    return Table(
        name="world-root",
        title="The root and its velocity by true speed: RMS error along an axis, found by standard deviation stated",
        columns=["m/s", "frames", "root, mm", "by stated", "velocity, m/s", "by stated"],
        rows=[
            [name, str(r["frames"]), f"{r['position_mm']:.1f}", f"{r['position_ratio']:.2f}",
             f"{r['velocity_m_s']:.3f}", f"{r['velocity_ratio']:.2f}"]
            for name, r in by_speed.items()
        ],
        note="The same clips. By stated: 1 is honest.",
    )  # fmt: skip


def _hidden_table(hidden: Mapping[str, Mapping[str, float]]) -> Table:
    keys = [key for key in next(iter(hidden.values())) if key.startswith("hidden")]
    return Table(
        name="world-hidden",
        title="Without a root: the trunk hidden for two seconds at a time",
        columns=["method", *(key.removeprefix("hidden ").removeprefix("hidden: ") for key in keys)],
        rows=[[name, *(f"{found[key]:.2f}" for key in keys)] for name, found in hidden.items()],
        note="Root: horizontal error after so long. Squared error over variance: 1 is honest.",
    )
