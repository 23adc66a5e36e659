"""People who cross and hide each other, without ids: streams of the simulator, and a score of who is taken for whom.

The simulated tracker knows who is who, so each observation's person is known. The bodies of each frame come in random
order and without ids.
"""

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import PoseRaw, PoseWorld
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.clean.identify import Identify
from steadypose.prior.clean.settings import IdentifySettings
from steadypose.prior.sim.streams import Stream, make

MANIFEST = Path(__file__).parents[2] / "sim_data" / "manifest.json"
ROWS = 16
HIDDEN_S = 1.0
"""Seconds, the least for which the one who is hidden is not observed."""


class Frame(NamedTuple):
    """Capture; bodies (N, 22, 3) metres, world; their confidence (N, 22); and who each of them is."""

    stamp_ns: int
    bodies: NDArray[np.float64]
    confidence: NDArray[np.float64]
    people: list[int]


def watch(stream: Stream) -> list[Frame]:
    """A stream's frames, with bodies in random order; whoever goes out of sight does so for `HIDDEN_S` at least."""
    rng = np.random.default_rng(stream.seed)
    raw, truth = make(stream)
    people = _people(raw, truth)
    skeleton, turn, eye = SKELETONS[stream.camera.skeleton], stream.camera.orientation, stream.camera.position
    last_ns: dict[int, int] = {}
    back_ns: dict[int, int] = {}
    frames = []
    for message in raw:
        seen = []
        for body in message.bodies:
            who = people[body.id]
            if who in last_ns and message.stamp_ns - last_ns[who] > 0.15e9:
                back_ns[who] = last_ns[who] + round(HIDDEN_S * 1e9)
            last_ns[who] = message.stamp_ns
            if message.stamp_ns >= back_ns.get(who, 0):
                seen.append((body, who))
        order = rng.permutation(len(seen))
        joints = [to_canonical(skeleton, seen[k][0].positions.astype(float), seen[k][0].confidence) for k in order]
        places = np.array([p for p, _ in joints]).reshape(-1, 22, 3) @ turn.T + np.array(eye)
        confidence = np.array([c for _, c in joints]).reshape(-1, 22)
        frames.append(Frame(message.stamp_ns, places, confidence, [seen[k][1] for k in order]))
    return frames


def all_hidden(frames: list[Frame]) -> list[Frame]:
    """The same with everybody out of sight for `HIDDEN_S` around the moment at which the first one reappears."""
    stamps = {who: [f.stamp_ns for f in frames if who in f.people] for who in {p for f in frames for p in f.people}}
    gaps = [(b - a, b) for s in stamps.values() for a, b in pairwise(s) if b - a > 0.5e9]
    if not gaps:
        return frames
    end = max(gaps)[1]
    hidden = range(end - round(0.5 * HIDDEN_S * 1e9), end + round(0.5 * HIDDEN_S * 1e9))
    nobody = np.zeros((0, 22, 3)), np.zeros((0, 22)), []
    return [Frame(f.stamp_ns, *nobody) if f.stamp_ns in hidden else f for f in frames]


def _people(raw: list[PoseRaw], truth: list[PoseWorld]) -> dict[int, int]:
    """The person of each id of the source: the tracker of a simulated camera makes no mistakes."""
    roots = {body.id: np.array([m.bodies[k].root_position for m in truth]) for k, body in enumerate(truth[0].bodies)}
    stamps = np.array([m.stamp_ns for m in truth])
    away: dict[int, Counter[int]] = {}
    for message in raw:
        place = message.sensor_pose
        turn = Rotation.from_quat(place.orientation).as_matrix()
        now = int(np.abs(stamps - message.stamp_ns).argmin())
        for body in message.bodies:
            middle = turn @ np.nanmedian(body.positions, axis=0) + place.position
            nearest = min(roots, key=lambda who: float(np.linalg.norm((roots[who][now] - middle)[:2])))
            away.setdefault(body.id, Counter())[nearest] += 1
    return {i: votes.most_common(1)[0][0] for i, votes in away.items()}


def score(frames: list[Frame], settings: IdentifySettings) -> tuple[int, float]:
    """Id switches of `prior.clean.identify` as CLEAR MOT counts them (Bernardin and Stiefelhagen 2008), and the share
    of observations that got an id. A switch is an observation of a person under another id than this person's last.
    """
    stage, last = Identify(settings, ROWS, Counter()), dict[int, int]()
    observations = named = switches = 0
    for frame in frames:
        ids = stage.update(frame.stamp_ns, frame.bodies, frame.confidence)
        for who, i in zip(frame.people, ids, strict=True):
            observations += 1
            if i is not None:
                named += 1
                switches += last.get(who, i) != i
                last[who] = i
    return switches, named / observations
