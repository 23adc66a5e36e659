"""Motion whose files have rotations, as 30 Hz clips: joints to observe, and orientations to compare with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import to_canonical
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.mocap.bvh import Bvh
from steadypose.prior.mocap.clip import Y_UP_TO_Z_UP, forward
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.prepare import find_faults, resample
from steadypose.training.data.readers import bvh_motion, members

FRAMES, SKIPPED = 240, 60
"""Frames of a clip, and how many of them, at its start, are not scored: a filter is not judged by how it begins."""


class _Source(NamedTuple):
    """Where recordings with rotations are.

    Attributes:
        name: of the source.
        archive: its file.
        turns: the joint of the file that turns with each canonical joint, of left and middle.
        people: of each split, the marks in a file's name by which its people are known.
    """

    name: str
    archive: str
    turns: Mapping[str, str]
    people: Mapping[str, tuple[str, ...]]


_LIMBS = {
    "left_hip": "LeftUpLeg", "left_knee": "LeftLeg", "left_ankle": "LeftFoot",
    "left_collar": "LeftShoulder", "left_shoulder": "LeftArm", "left_elbow": "LeftForeArm",
    "neck": "Neck", "pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2",
}  # fmt: skip
SOURCES = (
    _Source(
        "CMU", "cmu_bvh.tar.xz",
        {"pelvis": "CC_Base_Hip", "spine1": "CC_Base_Spine01", "spine2": "CC_Base_Spine02", "spine3": "CC_Base_Spine02",
         "neck": "CC_Base_NeckTwist01", "left_hip": "CC_Base_L_Thigh", "left_knee": "CC_Base_L_Calf",
         "left_ankle": "CC_Base_L_Foot", "left_collar": "CC_Base_L_Clavicle", "left_shoulder": "CC_Base_L_Upperarm",
         "left_elbow": "CC_Base_L_Forearm"},
        {"val": ("002_",), "test": ()},
    ),
    _Source(
        "CMU (dance)", "cmu_dance.tar.xz",
        {"pelvis": "hip", "spine1": "abdomen", "spine2": "chest", "spine3": "chest", "neck": "neck",
         "left_hip": "lThigh", "left_knee": "lShin", "left_ankle": "lFoot", "left_collar": "lCollar",
         "left_shoulder": "lShldr", "left_elbow": "lForeArm"},
        {"val": (), "test": ("martial", "indian")},
    ),
    _Source(
        "DanceDB", "dancedb.tar.xz", {**_LIMBS, "spine3": "Spine3"},
        {"val": ("Andria_", "Elena_"), "test": ("Anna_", "Olivia_", "Theodora_")},
    ),
    _Source(
        "LAFAN1", "lafan1.tar.xz", {**_LIMBS, "spine3": "Spine2"},
        {"val": ("subject1",), "test": ("subject2", "subject3", "subject4")},
    ),
)  # fmt: skip
"""CMU's subject 02 trains nothing; DanceDB and LAFAN1 choose and measure only."""

SCORED = tuple(J[name] for name in JOINTS if not name.endswith(("foot", "wrist", "head")))
"""The 17 joints that carry another: the turn of hands, toes and head shows in no canonical joint."""


class Clips(NamedTuple):
    """Clips side by side, 30 Hz.

    Attributes:
        positions: (T, C, 22, 3) metres, z up.
        orientations: (T, C, 17, 3, 3) of `SCORED`, world from the file's joint.
        source: (C,) names.
        person: (C,) marks of their people.
    """

    positions: Floats
    orientations: Floats
    source: NDArray[np.str_]
    person: NDArray[np.str_]


def read(mocap: Path, split: str, most: int) -> Clips:
    """At most ``most`` clips of `FRAMES` frames of each source, spread evenly over its recordings."""
    found = [(source.name, *clip) for source in SOURCES for clip in _spread(list(_clips(mocap, source, split)), most)]
    names, people, positions, orientations = zip(*found, strict=True)
    return Clips(np.stack(positions, axis=1), np.stack(orientations, axis=1), np.array(names), np.array(people))


def _spread(clips: list[tuple[str, Floats, Floats]], most: int) -> list[tuple[str, Floats, Floats]]:
    rows = np.linspace(0, len(clips) - 1, min(most, len(clips))).round().astype(int)
    return [clips[row] for row in rows]


def _clips(mocap: Path, source: _Source, split: str) -> Iterator[tuple[str, Floats, Floats]]:
    """Every clip of a source's people of this split that has no fault: who, positions and orientations."""
    if not (marks := source.people[split]):
        return
    for name, content in sorted(members(mocap / source.archive, (".bvh",), lambda _: None)):
        person = next((mark for mark in marks if mark in name), None)
        if person is None:
            continue
        bvh, skeleton, places = bvh_motion(content.decode("ascii", "replace"))
        joints, _ = to_canonical(skeleton, places)
        turns = _orientations(bvh, source.turns)[len(bvh.values) - len(joints) :]
        positions = resample(joints, bvh.fps)
        orientations = _at_rate(turns, bvh.fps, len(positions))
        bad, _ = find_faults(positions)
        for first in range(0, len(positions) - FRAMES + 1, FRAMES):
            if not bad[rows := slice(first, first + FRAMES)].any():
                yield person, positions[rows], orientations[rows]


def _orientations(bvh: Bvh, turns: Mapping[str, str]) -> Floats:
    """(T, 17, 3, 3) of `SCORED`, z up."""
    local, column = np.broadcast_to(np.eye(3), (len(bvh.values), len(bvh.joints), 3, 3)).copy(), 0
    for joint, channels in enumerate(bvh.channels):
        turning = [column + i for i, channel in enumerate(channels) if channel.endswith("rotation")]
        if turning:
            order = "".join(channel[0] for channel in channels if channel.endswith("rotation"))
            local[:, joint] = Rotation.from_euler(order, bvh.values[:, turning], degrees=True).as_matrix()
        column += len(channels)
    every = forward(bvh.parents, bvh.offsets, local)[1]
    return Y_UP_TO_Z_UP @ every[:, [bvh.joints.index(_turner(JOINTS[joint], turns)) for joint in SCORED]]


def _turner(joint: str, turns: Mapping[str, str]) -> str:
    """The file's joint that turns with a canonical one; the right side's has the left's name with the side changed."""
    if not joint.startswith("right"):
        return turns[joint]
    name = turns[joint.replace("right", "left")]
    if "Left" in name:
        return name.replace("Left", "Right")
    return name.replace("_L_", "_R_") if "_L_" in name else "r" + name[1:]


def _at_rate(orientations: Floats, fps: float, frames: int) -> Floats:
    """(T', J, 3, 3) of (T, J, 3, 3), at 30 Hz, by slerp."""
    if abs(fps - FPS) < 1e-3:
        return orientations[:frames]
    asked, own = np.arange(frames) / FPS, np.arange(len(orientations)) / fps
    asked = np.minimum(asked, own[-1])
    slerps = [Slerp(own, Rotation.from_matrix(orientations[:, joint])) for joint in range(orientations.shape[1])]
    return np.stack([slerp(asked).as_matrix() for slerp in slerps], axis=1)
