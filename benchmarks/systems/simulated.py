"""The simulated streams, whose truth is known in full: joints hidden and seen, the root in the world, standing feet.

Every frame in which the sensor gave a body is scored, at its own stamp, in the world; only where the camera's place in
it is not known is an answer first aligned to the truth, by one rotation and translation. A joint is hidden where the
sensor gave none, and only joints that its skeleton has are scored. "raw" holds a hidden joint
where it was last seen; the fixed-lag RTS smoother coasts, and is tuned on these very streams, which favours it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.baselines.kalman import fixed_lag
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.metrics import acceleration_error, contact_speed, length_variation, position_error
from steadypose.benchmarks.provenance import WORLD, require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.msgs.types import CONTACTS, Message, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sources.recording import RecordingSource
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import PARENTS, J
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

DEPENDS_ON = WORLD

FEET = tuple(name for name in CONTACTS if name.endswith(("ankle", "foot")))
GAP_S = 0.5
"""a body that was away for longer is met anew"""
SHORTEST = 15
"""frames, of a track that is scored"""
DENSITIES = tuple(float(q) for q in np.round(np.geomspace(0.002, 20, 13), 4))
"""m²/s³, tried for the smoother"""
MEASUREMENT_SIGMA = 0.02


@dataclass(frozen=True)
class Args:
    """The simulated streams: errors of raw, RTS and steadypose where the truth is known."""

    streams: Path = ROOT / "sim_data"
    """folder of recordings that carry pose/truth"""
    delay: int = PriorSettings().delay
    """frames, of the smoother and of steadypose"""
    quick: bool = False
    """the first two streams; nothing is written unless --out says where"""
    out: Path | None = None
    """folder for the JSON file; benchmarks/results unless --quick"""


@dataclass(frozen=True)
class Track:
    """One body in the frames in which the sensor gave it."""

    body: int
    stamps_ns: NDArray[np.int64]  # (T,)
    seen: Floats  # (T, 22, 3) metres, world; NaN where hidden
    truth: Floats  # (T, 22, 3) metres, world
    contact: NDArray[np.bool_]  # (T, 4) of FEET, in truth
    observable: NDArray[np.bool_]  # (22,) joints of the sensor's skeleton
    calibrated: bool  # whether the camera's place is known

    @property
    def stamps_s(self) -> Floats:
        return (self.stamps_ns - self.stamps_ns[0]) * 1e-9

    def visits(self) -> list[slice]:
        """Frames between which the body was not away."""
        cuts = np.flatnonzero(np.diff(self.stamps_s) > GAP_S) + 1
        return [slice(a, b) for a, b in zip([0, *cuts], [*cuts, len(self.stamps_ns)], strict=True)]


def read_tracks(messages: Sequence[tuple[str, Message]]) -> list[Track]:
    """The bodies of a recording by the sensor's ids, each with the person of the truth that it is nearest to."""
    people: dict[int, list[tuple[int, Floats, NDArray[np.bool_]]]] = {}
    sightings: dict[int, list[tuple[int, Floats]]] = {}
    observable = np.zeros(len(PARENTS), dtype=bool)
    calibrated = True
    feet = [CONTACTS.index(name) for name in FEET]
    for _, message in messages:
        if isinstance(message, PoseWorld):
            for body in message.bodies:
                pose = body.positions.astype(np.float64), body.contacts[feet] > 0.5
                people.setdefault(body.id, []).append((message.stamp_ns, *pose))
        elif isinstance(message, PoseRaw):
            skeleton = SKELETONS[message.skeleton]
            observable, calibrated = skeleton.observable, message.calibrated
            for body in message.bodies:
                joints, _ = to_canonical(skeleton, body.positions.astype(np.float64))
                sightings.setdefault(body.id, []).append((message.stamp_ns, to_world(joints, message.sensor_pose)))
    truths = [
        (
            np.array([stamp for stamp, _, _ in path]),
            np.stack([p for _, p, _ in path]),
            np.stack([c for _, _, c in path]),
        )
        for path in people.values()
    ]
    tracks = []
    for body, seen in sightings.items():
        stamps, positions = np.array([stamp for stamp, _ in seen]), np.stack([p for _, p in seen])
        candidates = []
        for known, path, contact in truths:
            inside = (stamps >= known[0]) & (stamps <= known[-1])
            if inside.sum() < SHORTEST:
                continue
            after = np.clip(np.searchsorted(known, stamps[inside]), 1, len(known) - 1)
            share = ((stamps[inside] - known[after - 1]) / (known[after] - known[after - 1]))[:, None, None]
            candidates.append(
                Track(
                    body=body,
                    stamps_ns=stamps[inside],
                    seen=positions[inside],
                    truth=path[after - 1] + share * (path[after] - path[after - 1]),
                    contact=contact[after - 1] & contact[after],
                    observable=observable,
                    calibrated=calibrated,
                )
            )
        if candidates:
            tracks.append(
                min(candidates, key=lambda t: float(np.nanmedian(position_error(placed(t, t.seen), t.truth))))
            )
    return tracks


def placed(track: Track, answer: Floats) -> Floats:
    """The answer as it is scored: aligned to the truth where the camera's place is not known."""
    if track.calibrated:
        return answer
    rotation, translation = rigid_alignment(answer, track.truth)
    return answer @ rotation.T + translation


def to_world(positions: Floats, sensor: Pose) -> Floats:
    """(..., 3) metres from the sensor's frame to the world."""
    return positions @ Rotation.from_quat(sensor.orientation).as_matrix().T + sensor.position


def hold_last(track: Track) -> Floats:
    """What the sensor gave, a hidden joint where it last was: (T, 22, 3)."""
    held = track.seen.copy()
    for visit in track.visits():
        for before, now in zip(held[visit], held[visit][1:], strict=False):
            hidden = np.isnan(now[:, 0])
            now[hidden] = before[hidden]
    return held


def smooth(track: Track, delay: int, density: float) -> Floats:
    """The fixed-lag RTS smoother's answers: (T, 22, 3)."""
    visits = track.visits()
    return np.concatenate(
        [fixed_lag(track.seen[v], track.stamps_s[v], delay, 2, density, MEASUREMENT_SIGMA) for v in visits]
    )


def steadypose(messages: Sequence[tuple[str, Message]], tracks: Sequence[Track], delay: int) -> list[dict[str, Floats]]:
    """For each track what `steadypose clean` gives: clean and world (T, 22, 3) in the world, sigma (T, 22)."""
    prior, trajectory = PriorPipeline(PriorSettings(delay=delay)), TrajectoryPipeline(TrajectorySettings())
    collectors = {track.body: NpzCollector() for track in tracks}
    for _, message in stream(messages, prior, trajectory):
        if isinstance(message, PoseClean | PoseWorld):
            for body, collector in collectors.items():
                collector.add(replace(message, bodies=[b for b in message.bodies if b.id == body]))
    sensor = next(message.sensor_pose for _, message in messages if isinstance(message, PoseRaw))
    answers = []
    for track in tracks:
        arrays = collectors[track.body].arrays(track.stamps_ns)
        answers.append(
            {
                "clean": to_world(arrays["positions"].astype(np.float64), sensor),
                "world": arrays["world_positions"].astype(np.float64),
                "sigma": arrays["sigma"].astype(np.float64),
            }
        )
    return answers


def measure(tracks: Sequence[Track], answers: Sequence[Floats]) -> dict[str, float]:
    """Errors over all frames of these tracks: millimetres, mm/frame², mm/s, per cent."""
    errors, hidden, bends, roots, skate, variation = [], [], [], [], [], []
    bones = [(j, p) for j, p in enumerate(PARENTS) if p >= 0]
    feet = [J[name] for name in FEET]
    for track, answer in zip(tracks, map(placed, tracks, answers), strict=True):
        scored = track.observable
        errors.append(position_error(answer, track.truth)[:, scored])
        hidden.append(np.isnan(track.seen[:, scored, 0]))
        bends.append(acceleration_error(answer, track.truth)[:, scored])
        roots.append(np.linalg.norm((answer - track.truth)[:, J["pelvis"], :2], axis=-1))
        skate.append(contact_speed(answer[:, feet], track.contact, track.stamps_s))
        variation.append(length_variation(answer, [(a, b) for a, b in bones if scored[a] and scored[b]]))
    error, away = np.concatenate(errors), np.concatenate(hidden)
    figures = {
        "all_mm": _mean(error) * 1e3,
        "seen_mm": _mean(error[~away]) * 1e3,
        "hidden_mm": _mean(error[away]) * 1e3,
        "hidden_answered_percent": _mean(np.isfinite(error[away]).astype(float)) * 100,
        "acceleration_mm": _mean(np.concatenate(bends)) * 1e3,
        "root_mm": _mean(np.concatenate(roots)) * 1e3,
        "root_p95_mm": float(np.nanquantile(np.concatenate(roots), 0.95)) * 1e3,
        "skate_mm_s": _mean(np.concatenate(skate)) * 1e3,
        "bone_variation_percent": float(np.mean(variation)) * 100,
    }
    return {name: round(value, 3) for name, value in figures.items()}


def sigma_ratio(tracks: Sequence[Track], answers: Sequence[Floats], sigmas: Sequence[Floats]) -> dict[str, float]:
    """Error found by standard deviation stated, of one coordinate, over seen and over hidden joints; 1 is honest."""
    ratios, hidden = [], []
    for track, answer, sigma in zip(tracks, map(placed, tracks, answers), sigmas, strict=True):
        ratios.append((position_error(answer, track.truth) / sigma / np.sqrt(3))[:, track.observable])
        hidden.append(np.isnan(track.seen[:, track.observable, 0]))
    squared, away = np.concatenate(ratios) ** 2, np.concatenate(hidden)
    squared[~np.isfinite(squared)] = np.nan
    return {name: round(_mean(squared[mask]) ** 0.5, 3) for name, mask in (("seen", ~away), ("hidden", away))}


def _mean(values: NDArray[np.floating]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def tune(
    streams: Sequence[Sequence[Track]], delay: int, track: Callable[..., Iterable[float]]
) -> list[dict[str, float]]:
    """The smoother's mean errors over the streams for each density."""
    tried = []
    for density in track(DENSITIES, description="tuning RTS"):
        figures = [measure(tracks, [smooth(t, delay, density) for t in tracks]) for tracks in streams]
        means = {name: float(np.mean([f[name] for f in figures])) for name in ("all_mm", "acceleration_mm")}
        tried.append({"acceleration_density": density, **means})
    return tried


def main(args: Args) -> None:
    """Run, measure, print, write."""
    if args.out or not args.quick:
        require_committed(args.out or RESULTS)
    console = Console()
    one_thread()
    paths = sorted(path.parent for path in args.streams.glob("*/metadata.yaml"))
    if not paths:
        raise SystemExit(f"{args.streams}: expected folders with recordings, found none")
    recordings = {path.name: list(RecordingSource(path)) for path in paths[: 2 if args.quick else None]}
    tracks = {name: read_tracks(messages) for name, messages in recordings.items()}
    results: dict[str, dict[str, Any]] = {}
    with Progress(console=console) as progress:
        tried = tune(list(tracks.values()), args.delay, progress.track)
        density = min(tried, key=lambda point: point["all_mm"] + point["acceleration_mm"])["acceleration_density"]
        for name, messages in progress.track(recordings.items(), description="streams"):
            bodies = tracks[name]
            ours = steadypose(messages, bodies, args.delay)
            methods = {
                "raw, held": [hold_last(t) for t in bodies],
                "RTS": [smooth(t, args.delay, density) for t in bodies],
                "clean": [answer["clean"] for answer in ours],
                "world": [answer["world"] for answer in ours],
            }
            frames = sum(len(t.stamps_ns) for t in bodies)
            unseen = np.concatenate([np.isnan(t.seen[:, t.observable, 0]).ravel() for t in bodies])
            results[name] = {
                "frames": frames,
                "hidden_percent": round(100 * float(unseen.mean()), 2),
                "truth": measure(bodies, [t.truth for t in bodies]),
                "methods": {method: measure(bodies, answers) for method, answers in methods.items()},
                "sigma_ratio": sigma_ratio(bodies, methods["clean"], [answer["sigma"] for answer in ours]),
            }
    tables = [_table(results, args.delay, density)]
    show(tables[0], console)
    if args.out or not args.quick:
        data = {"delay": args.delay, "streams": results, "tuning": tried}
        console.print(f"wrote {save('simulated', sys.argv[1:], tables, data, DEPENDS_ON, args.out or RESULTS)}")


def _table(results: dict[str, dict[str, Any]], delay: int, density: float) -> Table:
    columns = {
        "all_mm": "all, mm",
        "seen_mm": "seen, mm",
        "hidden_mm": "hidden, mm",
        "acceleration_mm": "acceleration, mm/frame²",
        "root_mm": "root, mm",
        "skate_mm_s": "foot skate, mm/s",
        "bone_variation_percent": "bone length, %",
    }
    rows = [
        [f"{name}, {result['hidden_percent']:.0f} % hidden" if not index else "", method]
        + ["–" if np.isnan(figures[key]) else f"{figures[key]:.1f}" for key in columns]
        for name, result in results.items()
        for index, (method, figures) in enumerate(result["methods"].items())
    ]
    return Table(
        name="simulated",
        title="Simulated streams, in the world, against the truth",
        columns=["stream", "method", *columns.values()],
        rows=rows,
        note=(
            f"Delay {delay} frames. Joints that the sensor's skeleton has. Root: of the pelvis, "
            "horizontal. Foot skate: mean horizontal speed of ankles and toes that stand in truth. RTS: tuned on these "
            f"streams ({density:g} m²/s³). clean, world: pose/clean and pose/world. Where the camera's place is not "
            "known, each answer is first aligned to the truth by one rotation and translation."
        ),
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
