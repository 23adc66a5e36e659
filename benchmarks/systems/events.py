"""Precision, recall and delay of `prior.events`, after the whole pipeline.

Simulated people are observed with a Kinect's errors and processed by the nodes' own pipelines; `event_mocap` does the
same with motion capture. The thresholds were chosen on other seeds and people.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.provenance import WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.systems.event_scenes import SCENES, Label, Scene, Score, Told, in_view, score
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import EventKind, Phase, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.events_node import EventStream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.prior.events.detector import EventSettings
from steadypose.prior.sim.camera import Camera, film
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel
from steadypose.prior.sim.streams import START_NS
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = (*WORLD, "prior.events")

CAMERA = Camera(position=(0.0, 0.0, 1.4), look_at=(2.6, 0.0, 0.95), fps=30.0, skeleton="kinect22")
DELAYS = (
    "Delays are between stamps of capture, from the onset in the true motion: the prior's own delay, which holds up "
    "every pose, comes on top."
)
IN_VIEW = 0.5  # least share of a body's joints in the camera's view for the body to count as present


def worlds_of(raw: Iterable[PoseRaw]) -> Iterator[PoseClean | PoseWorld]:
    """Yield what the prior and the trajectory node publish for a stream."""
    for _, message in stream(((POSE_RAW, frame) for frame in raw), make_prior({}), make_trajectory({})):
        if isinstance(message, PoseClean | PoseWorld):
            yield message


def labels_of(scene: Scene) -> list[Label]:
    """Return the labels of a scene as far as its people are in the camera's view."""
    times = scene.motions[0].times
    t = np.arange(0.0, times[-1], 1.0 / FPS)
    labels = []
    for person, motion in enumerate(scene.motions):
        seen = CAMERA.in_view((motion.at(t).positions - np.array(CAMERA.position)) @ CAMERA.orientation)
        labels += in_view(scene.labels, person, t, seen.mean(axis=1) > IN_VIEW)
    return labels


def told_of(messages: Iterable[PoseClean | PoseWorld], scene: Scene, settings: EventSettings) -> list[Told]:
    """Return the detected beginnings of events in a stream. A body is the person it is nearest to at that time."""
    events, told, last = EventStream(settings), [], {}
    times = scene.motions[0].times
    for message in messages:
        if isinstance(message, PoseClean):
            events.sensor, events.calibrated = message.sensor_pose.position, message.calibrated
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
    """Return a scene and what a camera observes of it."""
    playing, filming = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    scene = SCENES[name](playing)
    return scene, film(scene.motions, CAMERA, NoiseModel.load(KINECT_NOISE), filming, name, START_NS)


def scored(raw: Iterable[PoseRaw], scene: Scene) -> dict[EventKind, Score]:
    return score(told_of(worlds_of(raw), scene, EventSettings()), labels_of(scene), scene.undecided)


def record_of(kind: EventKind, found: Score) -> dict[str, Any]:
    counts = {"met": found.met, "missed": found.missed, "false": found.false}
    return {"kind": kind.name, **counts, "delays_s": found.delays_s}


def run(bench: Bench) -> Result:
    """Score events of simulated people. Seeds from 100 on chose the thresholds."""
    totals: dict[EventKind, Score] = defaultdict(Score)
    by_scene: list[dict[str, Any]] = []
    runs = [(name, seed) for name in SCENES for seed in bench.seeds]
    for name, seed in bench.progress.track(runs, description="scenes"):
        scene, raw = simulated(name, seed)
        for kind, found in scored(raw, scene).items():
            totals[kind].add(found)
            by_scene.append({"scene": name, "seed": seed, **record_of(kind, found)})
    title = "Events of simulated people, filmed with a Kinect's errors, behind the whole pipeline"
    return Result([table_of("events", title, totals, DELAYS)], {"scenes": by_scene})


def table_of(name: str, title: str, totals: Mapping[EventKind, Score], note: str) -> Table:
    whole = Score()
    for found in totals.values():
        whole.add(found)
    rows = [(kind.name.lower().replace("_", " "), totals[kind]) for kind in EventKind if kind in totals]
    cells = [
        [kind, str(found.met + found.missed), *(f"{share:.3f}" for share in found.shares),
         *(f"{1e3 * q:.0f}" for q in np.quantile(found.delays_s or [np.nan], (0.5, 0.95)))]
        for kind, found in [*rows, ("all", whole)]
    ]  # fmt: skip
    columns = ["event", "labels", "precision", "recall", "F1", "delay p50, ms", "delay p95, ms"]
    return Table(name, title, columns, cells, note)
