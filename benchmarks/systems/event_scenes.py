"""Simulated scenes in which people do what `prior.events` detects, with true onsets.

Onsets are computed from the true motion without noise, by measures independent of the detector where possible: the
script's times for waving and pointing, the pelvis' height for sitting, standing and lying, the camera's view for
entering and leaving.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.baselines.body import facing
from steadypose.msgs.types import EventKind, Hand
from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import TOE_HEIGHT, random_offsets
from steadypose.prior.body.skeleton import J
from steadypose.prior.events.detector import EventSettings
from steadypose.prior.events.features import EXTENT, HAND
from steadypose.prior.sim.gait import RATE, Stand, Turn, Walk, minimum_jerk, plan
from steadypose.prior.sim.motion import SIGN, ArmAction, Intent, Motion, perform
from steadypose.prior.sim.scripts import SCRIPTS
from steadypose.training.data.prepare import runs

DOUBT = 0.05  # margin beyond a threshold within which detection is optional, metres or radians
SHORTEST_S = 0.25  # shortest duration that must be detected, seconds; shorter events are optional
GRAVITY = 9.81
LEG = [J[f"left_{joint}"] for joint in ("hip", "knee", "ankle", "foot")]


class Label(NamedTuple):
    """An event of one person."""

    person: int
    kind: EventKind
    hand: Hand
    start_s: float
    end_s: float
    required: bool = True  # whether it must be detected; between a threshold and its margin, it need not
    nearly_s: float = math.inf  # earliest time at which it may be detected, if before its start


class Scene(NamedTuple):
    """Motions of all people, and their events."""

    motions: list[Motion]
    labels: list[Label]
    undecided: frozenset[EventKind] = frozenset()
    """Kinds that the scene does not decide; detections of them do not count."""


def gestures(rng: np.random.Generator) -> Scene:
    """Stand before the camera and raise hands, wave and point, one after the other, with either arm.

    A wave begins where the hand first turns, as in `event_mocap`: until then, it is a raised hand that moves aside.
    """
    acts = rng.permutation([(act, side) for act in ("raise", "wave", "point") for side in ("left", "right")])
    ground = plan((rng.uniform(2.2, 3.0), rng.uniform(-0.3, 0.3)), np.pi + rng.uniform(-0.4, 0.4), [Stand(28.0)])
    intent, labels = Intent(ground), []
    t, at = ground.times, 1.5
    for act, side in acts:
        lasts, blend = rng.uniform(2.4, 3.2), rng.uniform(0.5, 0.9)
        weight = minimum_jerk((t - at) / blend) - minimum_jerk((t - at - lasts + blend) / blend)
        sign, hand = SIGN[side], Hand.LEFT if side == "left" else Hand.RIGHT
        goal = np.broadcast_to(_goal(rng, act, sign), (len(t), 3)).copy()
        if act == "wave":
            began = at + blend
            ample = 0.22 * minimum_jerk((t - began) / 0.3)
            beat = 2.0 * np.pi * rng.uniform(1.2, 1.9) * (t - began)
            aside = ample * np.sin(beat)
            goal += np.stack([0.0 * t, sign * aside, -0.25 * aside * np.sin(beat)], axis=-1)
            turned = float(t[:-1][(t[:-1] > began) & (np.diff(aside) < 0.0)][0])
            labels.append(Label(0, EventKind.WAVES, hand, turned, at + lasts - blend))
        if act == "point":
            labels.append(Label(0, EventKind.POINTS, hand, at + blend, at + lasts - blend))
        pole = np.array([-0.35, 0.75 * sign, -0.9])
        intent.arms[side].append(ArmAction(weight, goal, pole, "shoulder"))
        at += lasts + rng.uniform(0.8, 1.4)
    motion = perform(intent, _person(rng), rng)
    return Scene([motion], [*labels, *common(0, motion)])


def _goal(rng: np.random.Generator, act: str, sign: float) -> Floats:
    """Return the wrist's goal relative to the shoulder, in arm lengths: forward, left, up."""
    if act == "raise":
        return np.array([rng.uniform(0.1, 0.4), sign * rng.uniform(0.1, 0.4), rng.uniform(0.55, 0.85)])
    if act == "wave":
        return np.array([0.30, sign * 0.36, 0.42])
    aside, up = rng.uniform(-0.2, 1.2), rng.uniform(-0.35, 0.3)
    return 1.2 * np.array([np.cos(aside) * np.cos(up), sign * np.sin(aside) * np.cos(up), np.sin(up)])


def comes_and_goes(rng: np.random.Generator) -> Scene:
    """Walk into view and up to the camera, stand, turn, and leave."""
    side = rng.choice([-1.0, 1.0])
    parts: list[Stand | Walk | Turn] = [
        Stand(0.5), Walk([(2.4, 0.6 * side), (1.0, rng.uniform(-0.1, 0.1))], rng.uniform(0.9, 1.3)),
        Stand(rng.uniform(1.0, 2.5)), Turn(np.pi * 0.9 * side, 2.2), Stand(0.4),
        Walk([(2.2, -0.6 * side), (2.6, -3.2 * side)], rng.uniform(0.9, 1.3)), Stand(2.0),
    ]  # fmt: skip
    motion = perform(Intent(plan((2.8, 3.2 * side), -side * np.pi / 2, parts)), _person(rng), rng)
    return Scene([motion], common(0, motion))


def falls(rng: np.random.Generator) -> Scene:
    """Stand, then topple over like a pole, to any side, and stay on the floor."""
    return _tips(rng, _toppling)


def lies_down(rng: np.random.Generator) -> Scene:
    """Stand, then lie down slowly, and stay on the floor."""
    return _tips(rng, lambda t: 0.5 * np.pi * minimum_jerk(t / 5.0))


def _toppling(t: Floats) -> Floats:
    """Return the tilt (T,) from upright of a toppling pole of 1.2 m, radians: theta'' = 3 g sin(theta) / 2 l, up to the
    floor."""
    angle, speed, angles = 0.1, 0.0, []
    for moment in t:
        if moment > 0:
            speed += 1.5 * GRAVITY / 1.2 * np.sin(angle) / RATE
            angle = min(angle + speed / RATE, 0.5 * np.pi)
        angles.append(angle)
    return np.array(angles) - 0.1 * np.cos(np.array(angles)).clip(0.0)


def _tips(rng: np.random.Generator, tilt: Callable[[Floats], Floats]) -> Scene:
    """Stand, then tip over as a whole about the feet, by ``tilt`` radians over time."""
    standing = perform(Intent(plan((2.8, 0.0), rng.uniform(-np.pi, np.pi), [Stand(12.0)])), _person(rng), rng)
    began, toward = rng.uniform(2.5, 4.0), rng.uniform(-np.pi, np.pi)
    angle = tilt(standing.times - began)
    axis = np.array([-np.sin(toward), np.cos(toward), 0.0])
    turn = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    pivot = np.array([2.8, 0.0, 0.0])
    rotations = standing.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    root = np.einsum("tij,tj->ti", turn, standing.root - pivot) + pivot
    root[:, 2] += 0.11 * np.sin(angle)  # half the trunk's depth
    contacts = standing.contacts & (angle < 0.2)[:, None]
    motion = Motion(standing.times, standing.offsets, root, rotations, contacts)
    down = float(standing.times[np.argmax(motion.positions[:, J["neck"], 2] < 0.4)])
    labels = [*common(0, motion), Label(0, EventKind.LIES, Hand.NONE, down, float(standing.times[-1]))]
    if tilt is _toppling:
        labels.append(Label(0, EventKind.FELL, Hand.NONE, down, float(standing.times[-1])))
    return Scene([motion], labels)


def _of_script(name: str, *undecided: EventKind) -> Callable[[np.random.Generator], Scene]:
    def scene(rng: np.random.Generator) -> Scene:
        motions = SCRIPTS[name](rng)
        labels = [label for person, motion in enumerate(motions) for label in common(person, motion)]
        return Scene(motions, labels, frozenset(undecided))

    return scene


def sits(rng: np.random.Generator) -> Scene:
    """Sit down on a chair twice, and stand up again."""
    (motion,) = SCRIPTS["sit_rise"](rng)
    labels = [label for label in common(0, motion) if label.kind != EventKind.STANDS]
    return Scene([motion], [*labels, *seated(0, motion)])


SCENES: Mapping[str, Callable[[np.random.Generator], Scene]] = {
    "gestures": gestures,
    "comes and goes": comes_and_goes,
    "sits": sits,
    "falls": falls,
    "lies down": lies_down,
    "walks": _of_script("walk_turn"),
    "idles": _of_script("idle"),
    # a hand held out at a shelf, or raised and hidden by the back, may or may not be pointing
    "reaches": _of_script("reach", EventKind.POINTS, EventKind.HAND_RAISED),
    "two cross": _of_script("crossing"),
}


def _person(rng: np.random.Generator) -> Floats:
    return random_offsets(rng, rng.uniform(1.55, 1.90))


def common(person: int, motion: Motion) -> list[Label]:
    """Label from the true joints of any scene: near, facing the camera, upright, hands above the neck."""
    s, p, t = EventSettings(), motion.positions, motion.times
    away = np.hypot(motion.root[:, 0], motion.root[:, 1])
    toward = np.arctan2(-motion.root[:, 1], -motion.root[:, 0])
    turned = np.abs(np.angle(np.exp(1j * (facing(p) - toward))))
    hips = motion.root[:, 2]
    tall = -float(motion.offsets[LEG, 2].sum()) + TOE_HEIGHT
    up = hips > 0.5 * tall
    trunk = p[:, J["neck"]] - p[:, J["pelvis"]]
    upright = trunk[:, 2] > 0.5 * np.linalg.norm(trunk, axis=1)
    faces, nearly_faces = turned < s.faces - DOUBT, turned < s.faces + s.faces_margin
    labels = [
        *_while(person, EventKind.NEAR, Hand.NONE, t, away < s.near - DOUBT, away < s.near + s.near_margin),
        *_while(person, EventKind.FACES_SENSOR, Hand.NONE, t, faces & up, nearly_faces & up),
        *_while(person, EventKind.STANDS, Hand.NONE, t, hips > 0.85 * tall, hips > 0.65 * tall),
    ]
    for side, hand in (("left", Hand.LEFT), ("right", Hand.RIGHT)):
        forearm = p[:, J[f"{side}_wrist"]] - p[:, J[f"{side}_elbow"]]
        forearm /= np.linalg.norm(forearm, axis=1, keepdims=True)
        above = p[:, J[f"{side}_wrist"], 2] + HAND * forearm[:, 2] - p[:, J["neck"], 2]
        raised, nearly = above > s.raised + DOUBT, above > s.raised - s.raised_margin
        labels += _while(person, EventKind.HAND_RAISED, hand, t, raised & upright, nearly & upright)
    return labels


def seated(person: int, motion: Motion) -> Iterator[Label]:
    """Label sitting down and standing up from the pelvis' height."""
    height = motion.root[:, 2]
    low, high = float(height.min()), float(np.quantile(height, 0.9))
    down, middle, up = low + 0.15 * (high - low), 0.5 * (low + high), high - 0.2 * (high - low)
    yield from _while(person, EventKind.SITS, Hand.NONE, motion.times, height < down, height < middle)
    yield from _while(person, EventKind.STANDS, Hand.NONE, motion.times, height > up, height > middle)


def lying(person: int, motion: Motion) -> Iterator[Label]:
    """Label lying: head, trunk, knees and feet are all low."""
    s, heights = EventSettings(), motion.positions[:, EXTENT, 2]
    extent = heights.max(axis=1) - heights.min(axis=1)
    yield from _while(
        person, EventKind.LIES, Hand.NONE, motion.times, extent < s.lies - DOUBT, extent < s.lies + s.lies_margin
    )


def _while(
    person: int, kind: EventKind, hand: Hand, t: Floats, holds: NDArray[np.bool_], nearly: NDArray[np.bool_]
) -> Iterator[Label]:
    """Yield a label for each time that it nearly holds, required from where it holds, if it ever does."""
    for begin, end in runs(nearly):
        held = np.flatnonzero(holds[begin:end])
        start = begin + int(held[0]) if len(held) else begin
        yield Label(person, kind, hand, float(t[start]), float(t[end - 1]), len(held) > 0, float(t[begin]))


def in_view(labels: Sequence[Label], person: int, t: Floats, seen: NDArray[np.bool_]) -> Iterator[Label]:
    """Yield a person's labels as far as a camera can observe them, by whether most of the person is in its view (T,).

    A person enters when they come into view. What they do at that moment begins then.
    """
    for first, after in runs(seen):
        begin, end = float(t[first]), float(t[after - 1])
        yield Label(person, EventKind.ENTERED, Hand.NONE, begin, begin)
        if after < len(t):
            yield Label(person, EventKind.LEFT, Hand.NONE, end, end)
        for label in labels:
            start_s, end_s = max(label.start_s, begin), min(label.end_s, end)
            if label.person == person and start_s < end_s:
                yield label._replace(start_s=start_s, end_s=end_s)


MOMENTS = (EventKind.ENTERED, EventKind.LEFT)  # kinds without a duration
EARLY_S, LATE_S = 0.5, 1.0  # how long before and after its true onset a detection matches a label, seconds


@dataclass
class Score:
    met: int = 0
    missed: int = 0
    false: int = 0
    delays_s: list[float] = field(default_factory=list)

    @property
    def shares(self) -> tuple[float, float, float]:
        """Precision, recall and F1; NaN of nothing."""
        met, missed, false = self.met, self.missed, self.false
        pairs = (met, met + false), (met, met + missed), (2 * met, 2 * met + missed + false)
        precision, recall, f1 = (part / whole if whole else math.nan for part, whole in pairs)
        return precision, recall, f1

    def add(self, other: Score) -> None:
        self.met, self.missed, self.false = self.met + other.met, self.missed + other.missed, self.false + other.false
        self.delays_s += other.delays_s


@dataclass(frozen=True)
class Told:
    """A detected beginning of an event."""

    person: int
    kind: EventKind
    hand: Hand
    at_s: float


def score(told: Sequence[Told], labels: Sequence[Label], undecided: Iterable[EventKind] = ()) -> dict[EventKind, Score]:
    """Score detections by kind; ``undecided`` kinds have no score."""
    scores: dict[EventKind, Score] = defaultdict(Score)
    left = [t for t in told if t.kind not in undecided]
    for label in sorted(labels, key=lambda label: (not label.required, label.start_s)):
        if label.kind in undecided:
            continue
        last_s = label.start_s + LATE_S if label.required else label.end_s
        first_s = min(label.start_s, label.nearly_s) - EARLY_S
        close = [t for t in left if (t.person, t.kind, t.hand) == label[:3] and first_s <= t.at_s <= last_s]
        if close:
            first = min(close, key=lambda t: t.at_s)
            left.remove(first)
            if label.required:
                scores[label.kind].met += 1
                scores[label.kind].delays_s.append(first.at_s - label.start_s)
        elif label.required and (label.end_s - label.start_s > SHORTEST_S or label.kind in MOMENTS):
            scores[label.kind].missed += 1
    for t in left:
        scores[t.kind].false += 1
    return dict(scores)
