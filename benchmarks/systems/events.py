"""How well `prior.events` tells what people do: precision, recall and delay, behind the whole pipeline.

Simulated people are filmed with a Kinect's errors, and go through the nodes' own pipelines; `event_mocap` does the same
with motion capture. The thresholds were chosen on other seeds and people.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from steadypose.benchmarks.provenance import WORLD, require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.benchmarks.systems.event_scenes import SCENES, Label, Scene, in_view
from steadypose.benchmarks.systems.event_scoring import Score, Told, quantile_ms, score
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import EventKind, Phase, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.events_node import EventStream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.prior.events.detector import EventSettings
from steadypose.prior.sim.camera import Camera, film
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel
from steadypose.prior.sim.streams import START_NS

CAMERA = Camera(position=(0.0, 0.0, 1.4), look_at=(2.6, 0.0, 0.95), fps=30.0, skeleton="kinect22")
GRID_HZ = 30.0
DELAYS = (
    "Delays are between stamps of capture, from the onset in the true motion: the prior's own delay, which holds up "
    "every pose, comes on top."
)
IN_VIEW = 0.5
"""share of a body's joints in the camera's view, from which on it is there"""


@dataclass(frozen=True)
class Args:
    """Events of simulated people."""

    seeds: int = 4
    """of each scene"""
    first: int = 0
    """of them; those from 100 on chose the thresholds"""
    out: Path = RESULTS
    """folder for the JSON file"""


def worlds_of(raw: Iterable[PoseRaw]) -> Iterator[PoseClean | PoseWorld]:
    """What the prior and the trajectory node give for a stream."""
    for _, message in stream(((POSE_RAW, frame) for frame in raw), make_prior({}), make_trajectory({})):
        if isinstance(message, PoseClean | PoseWorld):
            yield message


def labels_of(scene: Scene) -> list[Label]:
    """The labels of a scene as far as the camera sees their people."""
    times = scene.motions[0].times
    t = np.arange(0.0, times[-1], 1.0 / GRID_HZ)
    labels = []
    for person, motion in enumerate(scene.motions):
        seen = CAMERA.in_view((motion.at(t).positions - np.array(CAMERA.position)) @ CAMERA.orientation)
        labels += in_view(scene.labels, person, t, seen.mean(axis=1) > IN_VIEW)
    return labels


def told_of(messages: Iterable[PoseClean | PoseWorld], scene: Scene, settings: EventSettings) -> list[Told]:
    """The beginnings that are told of a stream; a body is the person that it is nearest to when it is told of."""
    events, told, last = EventStream(settings), [], {}
    times = scene.motions[0].times
    for message in messages:
        if isinstance(message, PoseClean):
            events.sensor = message.sensor_pose.position
            continue
        last |= {body.id: body.root_position for body in message.bodies}
        told_now = events.process(message)
        at_s = (message.stamp_ns - START_NS) / 1e9
        now = min(int(np.searchsorted(times, at_s)), len(times) - 1)
        for event in told_now.events if told_now else ():
            if event.phase == Phase.BEGINS:
                away = [float(np.linalg.norm((motion.root[now] - last[event.body])[:2])) for motion in scene.motions]
                told.append(Told(int(np.argmin(away)), event.kind, event.hand, at_s))
    return told


def simulated(name: str, seed: int) -> tuple[Scene, list[PoseRaw]]:
    """A scene, and what a camera makes of it."""
    playing, filming = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    scene = SCENES[name](playing)
    return scene, film(scene.motions, CAMERA, NoiseModel.load(KINECT_NOISE), filming, name, START_NS)


def main(args: Args) -> None:
    """Measure, print, write."""
    require_committed(args.out)
    one_thread()
    totals: dict[EventKind, Score] = defaultdict(Score)
    by_scene: list[dict[str, Any]] = []
    runs = [(name, seed) for name in SCENES for seed in range(args.first, args.first + args.seeds)]
    for name, seed in track(runs, description="scenes"):
        scene, raw = simulated(name, seed)
        scores = score(told_of(worlds_of(raw), scene, EventSettings()), labels_of(scene), scene.undecided)
        for kind, found in scores.items():
            totals[kind].add(found)
            counts = {"met": found.met, "missed": found.missed, "false": found.false}
            by_scene.append({"scene": name, "seed": seed, "kind": kind.name, "delays_s": found.delays_s} | counts)
    console = Console()
    table = table_of(
        "events", "Events of simulated people, filmed with a Kinect's errors, behind the whole pipeline", totals, DELAYS
    )
    show(table, console)
    path = save("events", sys.argv[1:], [table], {"scenes": by_scene}, (*WORLD, "events settings"), args.out)
    console.print(f"wrote {path}")


def table_of(name: str, title: str, totals: Mapping[EventKind, Score], note: str) -> Table:
    """A row for each kind, and one for all."""
    whole = Score()
    for found in totals.values():
        whole.add(found)
    rows = [(kind.name.lower().replace("_", " "), totals[kind]) for kind in EventKind if kind in totals]
    return Table(
        name=name,
        title=title,
        columns=["event", "labels", "precision", "recall", "F1", "delay p50, ms", "delay p95, ms"],
        rows=[
            [
                kind,
                str(found.met + found.missed),
                *(f"{share:.3f}" for share in (found.precision, found.recall, found.f1)),
                *(f"{quantile_ms(found.delays_s, share):.0f}" for share in (0.5, 0.95)),
            ]
            for kind, found in [*rows, ("all", whole)]
        ],
        note=note,
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
