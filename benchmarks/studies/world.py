"""The body in the world: root error and foot skate, and drift of a hidden root.

First: in correlated noise (2 cm), with a known floor, the error of the root, and the skate of each foot separately. A
measure that requires both feet to be still, such as RoHM's, ignores walking. Second: with the trunk hidden for two
seconds at a time, the drift of the root per 10 m of path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import roma
import torch
from numpy.typing import ArrayLike, NDArray

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE, missing
from steadypose.benchmarks.bench import TUNED_ON, Bench, baselines_of, tune_on, tuning_log
from steadypose.benchmarks.corruption import correlated
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import VARIANTS_22, WORLD_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import contact_speed, figures, position_error, score, sigma_ratio, source_table
from steadypose.msgs.types import CleanBody, JointState, Pose, PoseClean
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import JOINTS, limbs
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.rate import FPS
from steadypose.prior.world.observe import FEET, SOLE
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = (*VARIANTS_22, *WORLD_22)

NOISE = 0.02  # standard deviation of the noise, metres, with a correlation of 0.9 between frames
DELAY = 4
SKATING = 0.10  # speed above which a foot in contact skates, m/s
UNDER = 0.02  # depth under the floor beyond which a sole penetrates it, metres
SPEEDS = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, np.inf)  # edges of the bins of the root's speed, m/s
FRAMES = 192  # length of a clip, frames: two times 36 observed and 60 hidden


def run(bench: Bench) -> Result:
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
        "world-sources", f"In the world, through time-correlated noise of 2 cm: joints by source, mm, delay {DELAY}",
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


SEEN_FRAMES, HIDDEN_FRAMES = 36, 60  # number of frames in which the root is observed, then hidden, in turn

ROOT_NOISE, JOINT_NOISE = 0.015, 0.01
"""Standard deviations of the root's error, and of the joints' errors relative to it, metres."""

MEMORY = 0.95  # correlation of these errors between frames
HORIZONS = (15, 30, 60)  # frames after which the hidden root is compared with the truth


class Way(NamedTuple):
    positions: Floats  # (T, 22, 3) metres
    sigma: Floats  # (T, 3) metres, the root's standard deviation


Method = Callable[[Sequence[PoseClean]], Way]
"""Maps a clip from `observe` to estimates; each frame's uses only what came until then."""


def fusion(settings: TrajectorySettings, messages: Sequence[PoseClean]) -> Way:
    """Run the trajectory that ships, with these settings."""
    pipeline = TrajectoryPipeline(settings)
    bodies = [pipeline.process(message)[0].bodies[0] for message in messages]
    return Way(
        np.stack([b.positions for b in bodies]).astype(np.float64),
        np.sqrt(np.stack([np.diag(b.covariance)[:3] for b in bodies])),
    )


METHODS: Mapping[str, Method] = {
    "constant velocity": partial(fusion, TrajectorySettings(network=False, contacts=False)),
    "network": partial(fusion, TrajectorySettings(contacts=False)),
    "network and contacts": partial(fusion, TrajectorySettings()),
}
"""Methods to continue without a root: a Kalman filter alone, with the network's velocity, and with standing feet."""


@dataclass(frozen=True)
class Clip:
    """True motion at 30 Hz."""

    positions: Floats  # (T, 22, 3) metres, world, floor at 0
    rotations: Floats  # (T, 22, 4) xyzw, local
    contacts: NDArray[np.bool_]  # (T, 8) labels

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Frames (T,) in which `observe` hides the root."""
        return np.arange(len(self.positions)) % (SEEN_FRAMES + HIDDEN_FRAMES) >= SEEN_FRAMES


def observe(clip: Clip, rng: np.random.Generator) -> list[PoseClean]:
    """Return a clip as a prior's output: with noise, and without the trunk where `Clip.hidden`.

    There the root stays where it was last observed, with an infinite standard deviation, and the body with it. Only the
    body's own motion is known, which is the task of HM-VAE's section 3.3.
    """
    count = len(clip.positions)
    root = clip.positions[:, 0] + ROOT_NOISE * time_correlated(rng.normal(size=(count, 3)), MEMORY)
    local = clip.positions - clip.positions[:, :1]
    local[:, 1:] += JOINT_NOISE * time_correlated(rng.normal(size=(count, 21, 3)), MEMORY)
    sigma = np.full((count, 22), np.hypot(ROOT_NOISE, JOINT_NOISE))
    sigma[:, 0] = np.where(clip.hidden, np.inf, ROOT_NOISE)
    trunk = [j for j in range(22) if j not in (4, 5, 7, 8, 10, 11, 20, 21)]
    messages = []
    for t, hidden in enumerate(clip.hidden):
        root[t] = root[t - 1] if hidden else root[t]
        state = np.full(22, JointState.REFINED)
        state[trunk] = JointState.IMPUTED if hidden else JointState.REFINED
        positions = root[t] + local[t]
        body = CleanBody(
            id=0, positions=positions, rotations=clip.rotations[t], state=state, sigma=sigma[t], anomaly=0.0,
            anomaly_flag=False, joint_anomaly=np.zeros(22, np.float32), bone_lengths=np.zeros(22, np.float32),
            raw_positions=positions, raw_confidence=np.ones(22, np.float32),
        )  # fmt: skip
        messages.append(PoseClean(round(t * FRAME_S * 1e9), "world", "clip", Pose.identity(), True, 0, [body]))
    return messages


@dataclass
class Errors:
    """Errors of one method over clips; lists hold one number per frame or span."""

    seen_position: list[float] = field(default_factory=list)
    seen_skate: list[float] = field(default_factory=list)
    hidden_skate: list[float] = field(default_factory=list)
    hidden_position: dict[int, list[float]] = field(default_factory=lambda: {h: [] for h in HORIZONS})
    hidden_nees: dict[int, list[float]] = field(default_factory=lambda: {h: [] for h in HORIZONS})
    hidden_path: list[float] = field(default_factory=list)

    def add(self, clip: Clip, positions: Floats, sigma: Floats) -> None:
        """Compare (T, 22, 3) metres and (T, 3) metres, the root's standard deviation, with the truth."""
        hidden, truth = clip.hidden, clip.positions[:, 0]
        off = positions[:, 0] - truth
        settled = np.arange(len(hidden)) >= 10
        self.seen_position += list(np.linalg.norm(off[~hidden & settled], axis=1))
        speed = np.linalg.norm(np.diff(positions[:, FEET, :2], axis=0), axis=2) / FRAME_S
        labels = clip.contacts[:, [CONTACT_JOINTS.index(j) for j in FEET]]
        stands = labels[1:] & labels[:-1] & settled[1:, None]
        inside = hidden[1:] & hidden[:-1]
        self.seen_skate += list(speed[stands & ~hidden[1:, None] & ~hidden[:-1, None]])
        self.hidden_skate += list(speed[stands & inside[:, None]])
        for start in range(SEEN_FRAMES, len(hidden) - HIDDEN_FRAMES + 1, SEEN_FRAMES + HIDDEN_FRAMES):
            for h in HORIZONS:
                at = start + h - 1
                self.hidden_position[h].append(float(np.linalg.norm(off[at, :2])))
                self.hidden_nees[h].append(float(np.mean((off[at, :2] / sigma[at, :2]) ** 2)))
            end = start + HIDDEN_FRAMES - 1
            self.hidden_path.append(float(np.linalg.norm(np.diff(truth[start : end + 1, :2], axis=0), axis=1).sum()))

    def summary(self) -> dict[str, float]:
        """Return means and root mean squares, in the units named by the keys."""
        last, path = np.array(self.hidden_position[HORIZONS[-1]]), np.array(self.hidden_path)
        walked = path > 1.0
        return {
            "seen: root cm": 100 * rms(self.seen_position),
            "seen: skate m/s": float(np.mean(self.seen_skate)),
            "hidden: skate m/s": float(np.mean(self.hidden_skate)),
            **{f"hidden {h * FRAME_S:g} s: root cm": 100 * rms(e) for h, e in self.hidden_position.items()},
            "hidden: m per 10 m walked": float(10 * last[walked].sum() / path[walked].sum())
            if walked.any()
            else np.nan,
            **{
                f"hidden {h * FRAME_S:g} s: squared error over variance": float(np.mean(e))
                for h, e in self.hidden_nees.items()
            },
        }


def rms(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def evaluate_fusion(clips: list[Clip]) -> dict[str, Errors]:
    """Run all `METHODS` over every clip; "as observed" is the input."""
    errors = {name: Errors() for name in ("as observed", *METHODS)}
    for number, clip in enumerate(clips):
        messages = observe(clip, np.random.default_rng((0, number)))
        seen = np.stack([m.bodies[0].positions for m in messages]).astype(np.float64)
        errors["as observed"].add(clip, seen, np.full((len(seen), 3), ROOT_NOISE))
        for name, method in METHODS.items():
            errors[name].add(clip, *method(messages))
    return errors


def _table(records: list[dict[str, Any]], clips: int) -> Table:
    return Table.of(
        "world", "In the world, through time-correlated noise of 2 cm: place, pose and standing feet", records,
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
        "world-root",
        "The root and its velocity by true speed: RMS error along an axis, and error-to-sigma ratio",
        ["m/s", "frames", "root, mm", "error-to-sigma", "velocity, m/s", "error-to-sigma"],
        [[name, str(r["frames"]), f"{r['position_mm']:.1f}", f"{r['position_ratio']:.2f}",
          f"{r['velocity_m_s']:.3f}", f"{r['velocity_ratio']:.2f}"] for name, r in by_speed.items()],
        "The same clips. Error-to-sigma ratio: 1 is calibrated.",
    )  # fmt: skip


def _hidden_table(hidden: Mapping[str, Mapping[str, float]]) -> Table:
    keys = [key for key in next(iter(hidden.values())) if key.startswith("hidden")]
    return Table(
        "world-hidden", "Without a root: the trunk hidden for two seconds at a time",
        ["method", *(key.removeprefix("hidden ").removeprefix("hidden: ") for key in keys)],
        [[name, *(f"{found[key]:.2f}" for key in keys)] for name, found in hidden.items()],
        "Root: horizontal error after so long. Squared error over variance: 1 is honest.",
    )  # fmt: skip
