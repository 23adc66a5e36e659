"""Recognises the skeletons of motion files by their topology, and maps their joints to the canonical 22.

Programs name and divide bodies differently, but all bodies are the same tree. The names only have to show which joints
are left-right pairs. In the lowest pair of limbs, the longest two consecutive bones are thigh and shin; in another
pair, they are upper arm and forearm. The spine lies between. The canonical spine joints are placed on it at their
heights in the rest skeleton, scaled to the file's neck and head. Each lies within an existing bone and moves rigidly
with it. Rigs place collars differently, so collars are always mixtures of their neighbours.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import INTERPOLATED, NEEDED, Skeleton, middles
from steadypose.prior.body.mixtures import COLLAR
from steadypose.prior.body.skeleton import HIPS, JOINTS, REST_OFFSETS, REST_POSITIONS, SHOULDERS, J
from steadypose.prior.npz import MotionError

Mixture = Mapping[str, float]

UNITS: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "CMU": 0.0254 / 0.45}
"""Units of motion files, metres. CMU's unit is an inch divided by the 0.45 of its ASF files."""

SHORTEST, TALLEST = 0.55, 1.35
"""Range of a body's size relative to the rest skeleton (1.72 m): 0.95 to 2.3 m. If a body is outside it in every unit,
the unit is not guessed."""

ON_THE_JOINT = 0.15
"""Share of a bone within which a canonical joint near its end moves to the end, where the body turns."""

MOST_ASIDE = 0.8
"""Largest length of the bone to a hip, relative to the thigh: between rest skeletons' 0.3 and a knee's 1.0."""

_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("L", "R"), ("l", "r"))
_INLINE = re.compile(r"twist|roll", re.IGNORECASE)
_TIP = re.compile(r"(end|nub|tip|top)\d*$", re.IGNORECASE)
_PARTS = {
    "hjc": "hip", "kjc": "knee", "ajc": "ankle", "toebase": "foot", "bigtoe": "foot", "footindex": "foot",
    "toe": "foot", "toes": "foot", "clavicle": "collar", "sjc": "shoulder", "ejc": "elbow", "wjc": "wrist",
}  # fmt: skip
"""Synonyms of body parts in the names of points."""
_WORDS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDE_OF = {"l": "left", "left": "left", "r": "right", "right": "right"}
_MIDDLE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_MIDDLE_PARTS = {joint: joint for joint in _MIDDLE} | {"hips": "pelvis"}
_ABOVE_HIPS: Floats = REST_POSITIONS[:, 2] - REST_POSITIONS[list(HIPS), 2].mean()
"""(22,) height of each joint above the hips in the rest pose, metres."""


BY_RIG = "steadypose clean --rig FILE (docs/sources.md#motion-capture)"
"""How to describe a file; `info` and `plot`, which refuse it as well, read what `clean` then writes."""


@dataclass(frozen=True)
class Rig:
    """The mapping from a motion file's skeleton to the canonical one."""

    skeleton: Skeleton  # the file's joints that are used, and their table
    metres: float  # the file's unit, metres
    lost_bones: Mapping[str, float] = field(default_factory=dict)
    """joints whose OFFSET is zero because a converter lost it, each with the bone's length as a multiple of its
    parent's OFFSET, whose direction it shares"""
    up: str = ""  # the file's axis that points up: ``y``, ``-y`` or ``z``; empty if the motion determines it


def mirror_names(names: Sequence[str]) -> dict[str, str]:
    """Map each joint of the left to its counterpart on the right: names that exist with the side exchanged."""
    known, pairs = set(names), {}
    for name in names:
        for left, right in _SIDES:
            for match in re.finditer(left, name):
                other = name[: match.start()] + right + name[match.end() :]
                if other in known:
                    pairs[name] = other
    return pairs


@dataclass(frozen=True)
class Tree:
    """A file's skeleton."""

    joints: Sequence[str]  # J names, parents first
    parents: Sequence[int]  # index of each joint's parent; -1 for a root
    offsets: Floats  # (J, 3) offsets from the parent, in the file's unit

    @cached_property
    def rest(self) -> Floats:
        """(J, 3) positions with all angles zero and the root at the origin. Limbs may point in any direction."""
        placed = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                placed[joint] = placed[parent] + self.offsets[joint]
        return placed

    def path(self, joint: int) -> list[int]:
        """Return the path from the root to a joint."""
        path = [joint]
        while self.parents[path[-1]] >= 0:
            path.append(self.parents[path[-1]])
        return path[::-1]

    def above(self, joint: int) -> int:
        """Return the nearest ancestor at another position that is no twist helper inside a bone; -1 for none."""
        parent = self.parents[joint]
        while parent >= 0 and (
            _INLINE.search(self.joints[parent]) or not np.linalg.norm(self.rest[joint] - self.rest[parent]) > 0
        ):
            parent = self.parents[parent]
        return parent

    def length(self, joint: int) -> float:
        """Return the length of the bone to a joint from the joint `above` it."""
        above = self.above(joint)
        return float(np.linalg.norm(self.rest[joint] - self.rest[above])) if above >= 0 else 0.0


class _Limb(NamedTuple):
    """The two longest consecutive bones of a limb on the left."""

    trunk: int
    joints: tuple[int, int, int]
    length: float


class _Spine(NamedTuple):
    """The middle of the body, upwards: joint names, heights above the hips (file's unit), indices of neck and head."""

    joints: list[str]
    heights: Floats
    neck: int
    head: int


def recognise(tree: Tree, metres: float = 0.0) -> Rig:
    """Recognise the rig of a file's skeleton (see the module). A skeleton with the canonical names is used as it is.
    ``metres`` is the file's unit; 0 to recognise it.

    Raises:
        MotionError: there are no two pairs of limbs below a head, or no unit gives the body a person's size.
    """
    pairs = mirror_names(tree.joints)
    legs, arms = _limbs(tree, pairs)
    spine = _spine(tree, legs, arms, pairs)
    scale = float(spine.heights[[spine.neck, spine.head]].sum() / _ABOVE_HIPS[[J["neck"], J["head"]]].sum())
    metres = metres or _metres(sum(tree.length(j) for j in legs.joints[1:]) + scale * float(_ABOVE_HIPS[J["neck"]]))
    if set(JOINTS) <= set(tree.joints):
        return Rig(Skeleton("file", JOINTS, {joint: joint for joint in JOINTS}), metres)
    for name in (tree.joints[j] for j in legs.joints + arms.joints):
        if [tree.joints.count(side) for side in (name, pairs.get(name, ""))] != [1, 1]:
            raise MotionError(
                f"expected each joint of legs and arms once on either side, in names that differ by left and right "
                f"alone; '{name}' has no counterpart, or there are two: rename it, or say with {BY_RIG} which is which"
            )
    middle = {joint: _on_spine(spine, scale * float(_ABOVE_HIPS[J[joint]])) for joint in _MIDDLE}
    parts = zip(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"), legs.joints + arms.joints, strict=True)
    left: dict[str, str | Mixture] = {part: tree.joints[j] for part, j in parts}
    left["collar"] = collar(middle["spine3"], middle["neck"], left["shoulder"])
    below = (j for j, parent in enumerate(tree.parents) if parent == legs.joints[-1])
    toes = [j for j in below if tree.length(j) > 0 and tree.joints[j] in pairs]
    if toes:
        left["foot"] = tree.joints[max(toes, key=tree.length)]
    return Rig(skeleton("file", middle, left, lambda joint: pairs.get(joint, joint)), metres)


def up_axis(bodies: Floats) -> str:
    """Return the axis that points up in a file's joints (T, 22, 3), NaN where missing: ``y``, ``-y`` or ``z``, along
    which heads are farthest from ankles or, if a file lacks these, shoulders from hips."""
    known = np.array([[0.0, 1.0, 0.0]])
    for high, low in (([J["head"]], [J["left_ankle"], J["right_ankle"]]), (list(SHOULDERS), list(HIPS))):
        upwards = bodies[:, high].mean(axis=1) - bodies[:, low].mean(axis=1)
        if (finite := np.isfinite(upwards).all(axis=1)).any():
            known = upwards[finite]
            break
    _, y, z = known.mean(axis=0)
    return max({"y": y, "-y": -y, "z": z}.items(), key=lambda axis: axis[1])[0]


def skeleton(
    name: str, middle: Mapping[str, str | Mixture], left: Mapping[str, str | Mixture], to_right: Callable[[str], str]
) -> Skeleton:
    """Build a skeleton from its canonical joints of the ``middle`` and of the ``left`` side, named without the side.
    ``to_right`` maps a joint of the file's left to the right; other joints stay the same."""
    table = {joint: _weights(source) for joint, source in middle.items()}
    for joint, source in left.items():
        table[f"left_{joint}"] = _weights(source)
        table[f"right_{joint}"] = {to_right(n): w for n, w in _weights(source).items()}
    return Skeleton(name, tuple(sorted({n for weights in table.values() for n in weights})), table)


def mix(*parts: tuple[str | Mixture, float]) -> Mixture:
    """Combine mixtures by weights."""
    total: dict[str, float] = {}
    for part, weight in parts:
        named = _weights(part)
        for name, inner in named.items():
            total[name] = total.get(name, 0.0) + weight * inner / sum(named.values())
    return total


def _weights(source: str | Mixture) -> Mixture:
    return {source: 1.0} if isinstance(source, str) else source


def collar(spine3: str | Mixture, neck: str | Mixture, shoulder: str | Mixture) -> Mixture:
    """Return the rest skeleton's collar as a mixture of its neighbours."""
    return mix(*zip((spine3, neck, shoulder), COLLAR, strict=True))


def recognise_points(names: Sequence[str]) -> Skeleton:
    """Recognise the skeleton of named points in TRC and C3D files by their names, as points have no tree.

    A name has a side and a part: ``RAnkle``, ``right_ankle``, ``ANKLE_R`` and ``RAJC`` are the same joint. Pelvis,
    neck and head may lie between hips, shoulders and ears. A joint without points stays unobserved.

    Raises:
        MotionError: hips or shoulders are missing.
    """
    table: dict[str, str | dict[str, float]] = {}
    sided: dict[str, str] = {}
    for name in names:
        words = [word.lower() for word in _WORDS.findall(name)]
        sides = {_SIDE_OF[word] for word in words if word in _SIDE_OF}
        part = "".join(word for word in words if word not in _SIDE_OF)
        if not sides and part[:1] in ("l", "r") and f"left_{_PARTS.get(part[1:], part[1:])}" in JOINTS:  # LHJC, lknee
            sides, part = {_SIDE_OF[part[0]]}, part[1:]
        if len(sides) == 1:
            sided.setdefault(f"{sides.pop()}_{_PARTS.get(part, part)}", name)
        elif part in _MIDDLE_PARTS:
            table.setdefault(_MIDDLE_PARTS[part], name)
    between = middles(sided)
    interpolated = between.keys() & INTERPOLATED - table.keys()
    table = between | table | {joint: name for joint, name in sided.items() if joint in JOINTS}
    if missing := [joint for joint in NEEDED if joint not in table]:
        raise MotionError(
            f"expected points of {', '.join(missing)}; got {', '.join(names[:8]) or 'none'}...; say with {BY_RIG} which"
        )
    ordered = {joint: table[joint] for joint in JOINTS if joint in table}
    return Skeleton("points", tuple(dict.fromkeys(names)), ordered, frozenset(interpolated))


def _limbs(tree: Tree, pairs: Mapping[str, str]) -> tuple[_Limb, _Limb]:
    """Return leg and arm of the left side."""
    longest: dict[int, _Limb] = {}
    for joint in range(len(tree.joints)):
        path = tree.path(joint)
        first = next((k for k, j in enumerate(path) if tree.joints[j] in pairs), 0)
        middle = tree.above(joint)
        start = tree.above(middle) if middle >= 0 else -1
        if first and start in path[first:]:
            limb = _Limb(path[first - 1], (start, middle, joint), tree.length(joint) + tree.length(middle))
            longest[path[first]] = max(longest.get(path[first], limb), limb, key=lambda other: other.length)
    limbs = sorted(longest.values(), key=lambda limb: -limb.length)[:2]
    if len(limbs) < 2:
        raise MotionError(
            "expected a body: legs and arms of two bones each, in names that differ by left and right alone; "
            f"got {', '.join(tree.joints[:8])}...; say with {BY_RIG} which joints are which"
        )
    legs, arms = sorted(limbs, key=lambda limb: len(tree.path(limb.trunk)))
    roots = [tree.joints[tree.path(limb.trunk)[0]] for limb in (legs, arms)]
    if tree.length(legs.joints[0]) > MOST_ASIDE * tree.length(legs.joints[1]):
        first = tree.joints[legs.joints[0]]
        raise MotionError(
            f"expected hips, in names that differ by left and right alone; '{first}', the first of a leg, lies where a "
            f"knee does: rename the hips, or say with {BY_RIG} which they are"
        )
    if roots[0] != roots[1] or tree.joints.count(roots[0]) > 1:
        raise MotionError(f"expected one body, got limbs below the roots {' and '.join(roots)}: export each body alone")
    return legs, arms


def _spine(tree: Tree, legs: _Limb, arms: _Limb, pairs: Mapping[str, str]) -> _Spine:
    """Return the spine, from the joint where legs and head branch to the top of the head."""
    sided, trunk = {*pairs, *pairs.values()}, tree.path(arms.trunk)
    ways = (tree.path(joint) for joint in range(len(tree.joints)) if not _TIP.search(tree.joints[joint]))
    upwards = [
        way for way in ways if way[: len(trunk)] == trunk != way and sided.isdisjoint(tree.joints[j] for j in way)
    ]
    if not upwards:
        raise MotionError(f"expected neck and head above '{tree.joints[arms.trunk]}', found neither; say with {BY_RIG}")
    named = [way for way in upwards if "head" in tree.joints[way[-1]].lower()]
    way = min(named, key=len) if named else max(upwards, key=len)
    base = max(k for k, (a, b) in enumerate(zip(way, tree.path(legs.trunk), strict=False)) if a == b)
    head = way[-1]
    neck = way[len(trunk)] if way[len(trunk)] != head else arms.trunk
    tips = [j for j, p in enumerate(tree.parents) if p == head and _TIP.search(tree.joints[j]) and tree.length(j) > 0]
    chain = way[base:] + tips[:1]
    # base and hips form one bone: the base's height above the hips, along the way to the first joint elsewhere
    hips = tree.rest[[legs.joints[0], tree.joints.index(pairs[tree.joints[legs.joints[0]]])]].mean(axis=0)
    out = tree.rest[chain] - hips
    up = next((step / norm for step in out[1:] if (norm := np.linalg.norm(step)) > 0), np.zeros(3))
    steps = [float(out[0] @ up), *(float(np.linalg.norm(tree.offsets[j])) for j in chain[1:])]
    return _Spine([tree.joints[j] for j in chain], np.cumsum(steps), chain.index(neck), chain.index(head))


def _on_spine(spine: _Spine, height: float) -> Mixture:
    """Return the point of the spine at a height above the hips, in the bone that contains it or at the spine's end."""
    above = int(np.searchsorted(spine.heights, height))
    if above in (0, len(spine.heights)):
        return {spine.joints[min(above, len(spine.heights) - 1)]: 1.0}
    low, high = spine.heights[above - 1 : above + 1]
    share = float((height - low) / (high - low))
    share = 0.0 if share < ON_THE_JOINT else 1.0 if share > 1 - ON_THE_JOINT else round(share, 3)
    ends = ((above - 1, 1.0 - share), (above, share))
    return {spine.joints[k]: weight for k, weight in ends if weight > 0}


def _metres(size: float) -> float:
    """Return the unit, metres, in which thigh, shin and trunk up to the neck have this total length ``size``."""
    person = -REST_OFFSETS[[J["left_knee"], J["left_ankle"]], 2].sum() + _ABOVE_HIPS[J["neck"]]
    times = {unit: size * unit / person for unit in UNITS.values()}
    unit = min(times, key=lambda unit: abs(np.log(max(times[unit], 1e-9))))
    if not SHORTEST < times[unit] < TALLEST:
        raise MotionError(
            f"expected a body of 0.95 to 2.3 m in {', '.join(UNITS)}; got one whose leg and trunk are {size:.4g} long: "
            f"say the size of its unit in metres with {BY_RIG}"
        )
    return unit
