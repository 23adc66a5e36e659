"""How well `prior.events` detects events in motion capture, with labels from the recordings' names.

A camera with a Kinect's errors observes prepared clips, and the nodes' own pipelines clean its output.

A name says what a clip contains and what it does not: a clip named as walking has no wave. Onsets come from the true
motion, by the measures of `event_scenes`. Events that neither name nor measure decides are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import spread
from steadypose.benchmarks.provenance import WORLD_22
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.systems.event_scenes import Label, Scene, Score, common, lying, seated
from steadypose.benchmarks.systems.events import CAMERA, DELAYS, record_of, scored, table_of
from steadypose.msgs.types import EventKind, Hand
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading
from steadypose.prior.body.skeleton import J
from steadypose.prior.mocap.clip import person_of
from steadypose.prior.sim.camera import film
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel
from steadypose.prior.sim.streams import START_NS
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.prepare import runs

DEPENDS_ON = (*WORLD_22, "prior.events")

SEED, ALL, CLIPS = 7, "all", 2
"""Seed of positions and noise; name of the group of all; largest number of clips per action of a data set."""

LONGEST, SHORTEST = round(15.0 * FPS), round(1.5 * FPS)
"""Longest and shortest clips, frames. Longer takes are cut, because people walk out of the camera's view."""
NEAREST, FARTHEST = 2.8, 4.0  # distance from the camera to the middle of a scene, metres
AT_END_S = 0.5  # time before the end of a clip within which detecting a beginning is optional, seconds
UP, FALL_S = 0.7, 2.0
"""Fraction of the hips' greatest height above which a person is up, and the time before lying within which a falling
person was up, seconds."""
ALWAYS_OPEN = {EventKind.ENTERED, EventKind.LEFT, EventKind.NEAR, EventKind.POINTS}  # kinds that no name decides
ACTIONS = {
    "Bandai-Namco": (),
    "UI-PRMD (Vicon)": (),
    "LAFAN1": ("fallAndGetUp", "ground", "pushAndFall", "walk"),
}
"""Actions taken from each data set; all if none is named."""
OPEN = {"Bandai-Namco": {EventKind.SITS}, "LAFAN1": {EventKind.SITS, EventKind.WAVES}}
"""Kinds that a data set does not decide."""
SQUATS = ("m01", "m02", "m03", "m04")
WAVERS = ("wave", "bye")
QUIET = ("walk", "run", "dash", "raise")
"""Of Bandai-Namco's actions, those that wave and those that surely do not."""
WAVE = 0.41  # swing out and back of a forearm that counts as a wave in these joints, radians
FALLERS = ("fallAndGetUp", "pushAndFall")


class Clip(NamedTuple):
    """One recording, or a part of one."""

    source: str
    action: str
    person: str
    motion: Motion


def mocap_clips(path: Path, measured: bool, most: int) -> list[Clip]:
    """Return clips of ``prepared.npz``: those on which the thresholds were chosen, or the others, which measure them;
    at most ``most`` per action of a data set, equally many of each person.

    The thresholds were chosen on Bandai-Namco's session and LAFAN1's actor, which validate the networks, and on
    UI-PRMD's s07.
    """
    with np.load(path) as data:
        source, action, subject, split = (data[key] for key in ("source", "action", "subject", "split"))
        start, positions, rotations, offsets = (data[k] for k in ("clip_start", "positions", "rotations", "offsets"))
    person = np.array([person_of(*told) for told in zip(source, subject, strict=True)])
    held = np.where(source == "UI-PRMD (Vicon)", subject == "s07", split == "val")
    wanted = np.isin(source, list(ACTIONS)) & (held != measured)
    # the other people of UI-PRMD train the networks
    wanted &= (source != "UI-PRMD (Vicon)") | (split == "val")
    what = np.array([told.partition(" ")[0] for told in action])
    clips = []
    for name, acts in ACTIONS.items():
        for act in np.unique(what[wanted & (source == name)]):
            if acts and act not in acts:
                continue
            parts = [
                (k, slice(first, min(first + LONGEST, start[k + 1])))
                for k in np.flatnonzero(wanted & (source == name) & (what == act))
                for first in range(start[k], start[k + 1], LONGEST)
                if start[k + 1] - first > SHORTEST
            ]
            for chosen in spread(person[[k for k, _ in parts]], most):
                k, rows = parts[chosen]
                turned = Rotation.from_quat(rotations[rows].reshape(-1, 4)).as_matrix().reshape(-1, 22, 3, 3)
                contacts = np.zeros((len(turned), 8), dtype=bool)
                root = positions[rows, 0].astype(np.float64)
                motion = Motion(np.arange(len(turned)) / FPS, offsets[k].astype(np.float64), root, turned, contacts)
                clips.append(Clip(name, str(act), str(person[k]), motion))
    return clips


def scene_of(clip: Clip, rng: np.random.Generator) -> Scene:
    """Place a clip before the camera: its middle roughly faces the camera, far enough that all of it is in view."""
    motion = _before_camera(clip.motion, rng)
    labels = [*common(0, motion), *lying(0, motion)]
    undecided = ALWAYS_OPEN | OPEN.get(clip.source, set())
    if clip.action == "m05":
        labels = [*(label for label in labels if label.kind != EventKind.STANDS), *seated(0, motion)]
    elif clip.action in SQUATS:
        undecided |= {EventKind.SITS, EventKind.STANDS}
    if clip.source == "Bandai-Namco":
        if clip.action.startswith(WAVERS):
            labels += _waves(motion)
        elif not clip.action.startswith(QUIET):
            undecided |= {EventKind.WAVES}
    if clip.action.startswith(FALLERS):
        labels += _falls(motion)
    last_s = float(motion.times[-1]) - AT_END_S
    labels = [label._replace(required=label.required and label.start_s < last_s) for label in labels]
    return Scene([motion], labels, frozenset(undecided))


def _before_camera(motion: Motion, rng: np.random.Generator) -> Motion:
    root = motion.root
    low, high = root[:, :2].min(axis=0), root[:, :2].max(axis=0)
    middle = np.append((low + high) / 2, 0.0)
    yaw = np.pi + rng.uniform(-0.5, 0.5) - float(heading(motion.rotations[len(root) // 2, 0]))
    turn = Rotation.from_euler("z", yaw).as_matrix()
    rotations = motion.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    away = min(NEAREST + 0.3 * float(np.linalg.norm(high - low)), FARTHEST)
    return Motion(motion.times, motion.offsets, (root - middle) @ turn.T + [away, 0.0, 0.0], rotations, motion.contacts)


def _waves(motion: Motion) -> Iterator[Label]:
    """Label waves of a person named as waving, while a hand is up.

    A wave begins where the raised forearm first turns, if it then swings far enough twice. A wave of the wrist alone is
    not visible in these joints, so detecting it is optional.
    """
    p, t = motion.positions, motion.times
    chest = p[:, J["spine3"], 2]
    for side, hand in (("left", Hand.LEFT), ("right", Hand.RIGHT)):
        for begin, end in runs(p[:, J[f"{side}_wrist"], 2] > chest):
            turns = _turns(_swing(p[begin:end], side), WAVE)
            start = begin + (turns[0] if len(turns) > 1 else 0)
            yield Label(0, EventKind.WAVES, hand, float(t[start]), float(t[end - 1]), len(turns) > 1)


def _swing(p: Floats, side: str) -> Floats:
    """Return the angle of a forearm from upright, towards the body's left, unwrapped, (T,) radians."""
    across = [p[:, J[f"left_{joint}"], :2] - p[:, J[f"right_{joint}"], :2] for joint in ("hip", "shoulder")]
    left = across[0] + across[1]
    forearm = p[:, J[f"{side}_wrist"]] - p[:, J[f"{side}_elbow"]]
    aside = (forearm[:, :2] * left).sum(axis=1) / np.linalg.norm(left, axis=1)
    return np.unwrap(np.arctan2(aside, forearm[:, 2]))


def _turns(angle: Floats, swing: float) -> list[int]:
    """Return the extremes of (T,) that are ``swing`` away from both the extreme before and the one after; not the first
    and last."""
    turns, side, low, high = [], 0, 0, 0
    for k in range(len(angle)):
        low, high = (k if angle[k] < angle[low] else low), (k if angle[k] > angle[high] else high)
        if side <= 0 and angle[k] > angle[low] + swing:
            turns += [low] if side else []
            side, low, high = 1, k, k
        elif side >= 0 and angle[k] < angle[high] - swing:
            turns += [high] if side else []
            side, low, high = -1, k, k
    return turns


def _falls(motion: Motion) -> Iterator[Label]:
    """Label falls: a person named as falling who lies down fell if they were on their feet shortly before."""
    hips, t = motion.root[:, 2], motion.times
    for label in lying(0, motion):
        before = (t >= label.start_s - FALL_S) & (t <= label.start_s)
        # a person who lies from the start, or soon after, may have fallen before
        if label.start_s < FALL_S:
            yield label._replace(kind=EventKind.FELL, required=False)
        elif hips[before].max() > UP * hips.max():
            yield label._replace(kind=EventKind.FELL)


def run(bench: Bench) -> Result:
    """Score events of people in motion capture. The split ``val`` has the people on whom the thresholds were chosen,
    other splits those who measure."""
    totals: dict[str, dict[EventKind, Score]] = defaultdict(lambda: defaultdict(Score))
    by_clip: list[dict[str, Any]] = []
    clips = mocap_clips(bench.data, bench.split == "test", 1 if bench.quick else CLIPS)
    noise = NoiseModel.load(KINECT_NOISE)
    for number, clip in enumerate(bench.progress.track(clips, description="clips")):
        placing, filming = (np.random.default_rng(s) for s in np.random.SeedSequence([SEED, number]).spawn(2))
        scene = scene_of(clip, placing)
        raw = film(scene.motions, CAMERA, noise, filming, clip.action, START_NS)
        for kind, found in scored(raw, scene).items():
            for group in (clip.source, ALL):
                totals[group][kind].add(found)
            by_clip.append({"action": clip.action, "person": clip.person, **record_of(kind, found)})
    people = len({clip.person for clip in clips})
    title = f"Events in motion capture, filmed with a Kinect's errors: {len(clips)} clips of {people} people"
    tables = [table_of("event-mocap", title, totals[ALL], DELAYS)]
    tables += [table_of(f"event-mocap-{name}", name, of, "") for name, of in totals.items() if name != ALL]
    return Result(tables, {"clips": by_clip})
