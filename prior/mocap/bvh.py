"""Biovision Hierarchy (.bvh) files.

This is our own reader; `docs/results/`, "Importers", compares packages. The format does not define what a position
channel means. In the original definition, it is added to the joint's OFFSET. Exporters that give every joint position
channels write the whole offset into them, so there it replaces the OFFSET. Here it is added at a root, where the two
differ only by a constant shift of the world (`prior.mocap.files` selects the one with the feet on the floor), and
replaces the OFFSET elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.rigs import UNITS, Rig, collar, skeleton
from steadypose.prior.mocap.clip import MotionError, documented, forward

# CMU's motion in its most common conversion (B. Hahne's, cgspeed.com, and derivatives). Topology alone does not
# determine this skeleton, because bones with several children have lost their lengths: the thorax (12 cm, as long as
# the upper back in the ASF) and the wrist's part of the forearm (9 cm, half of the radius in the ASF).
CMU_BVH = Rig(
    skeleton(
        "cmu_bvh",
        {
            "pelvis": "Hips",
            "spine1": "Spine",
            "spine2": {"Spine": 0.32, "Spine1": 0.68},
            "spine3": "Spine1",
            "neck": "Neck1",
            "head": {"Head": 0.8, "Head_end": 0.2},
        },
        {
            "hip": "LeftUpLeg",
            "knee": "LeftLeg",
            "ankle": "LeftFoot",
            "foot": "LeftToeBase",
            "collar": collar("Spine1", "Neck1", "LeftArm"),
            "shoulder": "LeftArm",
            "elbow": "LeftForeArm",
            "wrist": "LeftFingerBase",
        },
        lambda joint: joint.replace("Left", "Right"),
    ),
    metres=UNITS["CMU"],
    lost_bones={"Neck": 1.0, "LeftShoulder": 1.0, "RightShoulder": 1.0, "LeftFingerBase": 0.5, "RightFingerBase": 0.5},
)


@dataclass
class _Node:
    name: str
    parent: int
    offset: tuple[float, float, float]
    channels: tuple[str, ...] = ()


AT_ONCE = 256
"""Number of frames that are read or computed at once: words and rotations take ten times the memory of positions."""

_POSITION = {"Xposition": 0, "Yposition": 1, "Zposition": 2}
_ROTATION = {"Xrotation": "X", "Yrotation": "Y", "Zrotation": "Z"}
_WORDS = re.compile(r"(ROOT|JOINT)\s+([^{]*[^{\s])|(\{|[^\s{]+)", re.IGNORECASE)
"""the words of a line; the name of a joint, which may contain spaces, is one"""
_MOTION = re.compile(r"(?:^|(?<=\}))[ \t]*(MOTION)(?!\S)", re.IGNORECASE | re.MULTILINE)  # not a joint's name
_FRAMES = re.compile(r"\s*Frames:\s*(\S+)\s+Frame\s+Time:\s*(\S+)", re.IGNORECASE)


@dataclass(frozen=True)
class Bvh:
    """A BVH file."""

    joints: tuple[str, ...]
    """names, parents first. The end site of joint ``A`` is ``A_end``; a second one is ``A_end2``"""
    parents: tuple[int, ...]  # index of each joint's parent; -1 for a root
    offsets: NDArray[np.float64]  # (J, 3) in the file's unit and axes
    channels: tuple[tuple[str, ...], ...]  # channels of each joint, in the file's order
    fps: float  # frames per second
    values: NDArray[np.float64]  # (T, C) values of all channels, degrees and the file's unit

    @documented
    def positions(self, lost_bones: Mapping[str, float] | None = None) -> NDArray[np.float64]:
        """(T, J, 3) positions in the file's unit and axes, by forward kinematics; ``lost_bones``
        (`prior.body.rigs.Rig`) get their length back if the file has none."""
        offsets = self.offsets.copy()
        for name, multiple in (lost_bones or {}).items():
            joint = self.joints.index(name)
            if not offsets[joint].any():
                offsets[joint] = multiple * offsets[self.parents[joint]]
        parts = [self._placed(offsets, self.values[k : k + AT_ONCE]) for k in range(0, len(self.values), AT_ONCE)]
        return np.concatenate([np.empty((0, *offsets.shape)), *parts])

    def _placed(self, offsets: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        steps = np.tile(offsets, (len(values), 1, 1))
        local = np.broadcast_to(np.eye(3), (*steps.shape, 3)).copy()
        column = 0
        for j, channels in enumerate(self.channels):
            order = "".join(_ROTATION[c] for c in channels if c in _ROTATION)
            if order:
                turning = [column + i for i, c in enumerate(channels) if c in _ROTATION]
                local[:, j] = Rotation.from_euler(order, values[:, turning], degrees=True).as_matrix()
            for i, channel in enumerate(channels):
                if channel in _POSITION:
                    axis = _POSITION[channel]
                    base = offsets[j, axis] if self.parents[j] < 0 else 0.0
                    steps[:, j, axis] = base + values[:, column + i]
            column += len(channels)
        return forward(self.parents, steps, local)[0]


@documented
def read_bvh(text: str) -> Bvh:
    """Read a BVH file: any rotation order, position channels on any joint, several roots and end sites, and keywords in
    any case.

    Raises:
        MotionError: it is no BVH file, or its motion does not match its hierarchy.
    """
    head, keyword, motion = (*_MOTION.split(text, maxsplit=1), "", "")[:3]
    last = text.rstrip().count("\n") + 1
    if not keyword:
        raise MotionError(f"expected HIERARCHY and MOTION sections, found no MOTION up to the end on line {last}")
    nodes = _hierarchy(head)
    values, fps = _motion(motion, sum(len(n.channels) for n in nodes), last)
    return Bvh(
        joints=tuple(n.name for n in nodes),
        parents=tuple(n.parent for n in nodes),
        offsets=np.array([n.offset for n in nodes]),
        channels=tuple(n.channels for n in nodes),
        fps=fps,
        values=values,
    )


def _hierarchy(text: str) -> list[_Node]:
    nodes: list[_Node] = []
    open_joints: list[int] = []
    number = 0

    def words() -> Iterator[str]:
        nonlocal number
        for number, line in enumerate(text.splitlines(), 1):  # noqa: B007, for errors
            for match in _WORDS.finditer(line):
                yield from filter(None, match.groups())

    it = words()
    try:
        if (first := next(it)).upper() != "HIERARCHY":
            raise MotionError(f"expected HIERARCHY at the start, found '{first}'")
        for word in it:
            token = word.upper()
            if token in ("ROOT", "JOINT", "END"):
                parent = open_joints[-1] if open_joints else -1
                name, brace = next(it), next(it)
                if token == "END":
                    ends = sum(n.parent == parent and not n.channels for n in nodes)
                    name = f"{nodes[parent].name}_end{ends + 1 if ends else ''}"
                    brace = next(it) if brace != "{" else brace  # some programs name end sites
                if brace != "{":
                    raise MotionError(f"expected '{{' after {word} {name}, found '{brace}'")
                open_joints.append(len(nodes))
                nodes.append(_Node(name, parent, (0.0, 0.0, 0.0)))
            elif token == "OFFSET":
                nodes[open_joints[-1]].offset = (float(next(it)), float(next(it)), float(next(it)))
            elif token == "CHANNELS":
                channels = tuple(next(it).capitalize() for _ in range(int(next(it))))
                unknown = set(channels) - _POSITION.keys() - _ROTATION.keys()
                if unknown:
                    raise MotionError(f"joint {nodes[open_joints[-1]].name}: unknown channels {sorted(unknown)}")
                nodes[open_joints[-1]].channels = channels
            elif token == "}":
                open_joints.pop()
            else:
                raise MotionError(f"expected ROOT, JOINT, End, OFFSET, CHANNELS or '}}', found '{word}'")
        if open_joints or not nodes:
            raise StopIteration
    except (StopIteration, IndexError) as error:
        raise MotionError(f"line {number}: the hierarchy is cut short or its braces do not match") from error
    except ValueError as error:
        what = error if isinstance(error, MotionError) else _unread("hierarchy", error)
        raise MotionError(f"line {number}: {what}") from error
    return nodes


def _unread(part: str, error: ValueError) -> str:
    comma = "; write decimal points, not commas" if "," in str(error) else ""
    return f"a number in the {part} cannot be read: {error}{comma}"


def _numbers(text: str) -> NDArray[np.float64]:
    """All numbers of a text, a few lines at a time."""
    lines = text.splitlines()
    parts = (lines[k : k + AT_ONCE] for k in range(0, len(lines), AT_ONCE))
    return np.concatenate([np.empty(0), *(np.array(" ".join(part).split(), np.float64) for part in parts)])


def _motion(text: str, channels: int, last: int) -> tuple[NDArray[np.float64], float]:
    """Return values (T, channels), and frames per second. ``last`` is the number of the file's last line."""
    if not (stated := _FRAMES.match(text)):
        found = " ".join(text[:200].split()[:5])
        raise MotionError(f"expected 'Frames: N' and 'Frame Time: S' after MOTION, found '{found}'")
    try:
        frames, seconds = int(stated[1]), float(stated[2])
        values = _numbers(text[stated.end() :])
    except ValueError as error:
        raise MotionError(_unread("motion", error)) from error
    if not 0 < seconds < np.inf:
        raise MotionError(f"expected a frame time above zero, found {seconds}")
    if len(values) != frames * channels:
        raise MotionError(
            f"expected {frames} frames of {channels} numbers, found {len(values)} numbers up to the end on line {last}"
            + "; the file is cut short: export it again" * (len(values) < frames * channels)
        )
    return values.reshape(frames, channels), 1.0 / seconds
