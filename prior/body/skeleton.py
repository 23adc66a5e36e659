"""The canonical skeleton: joints, tree, rest pose, and tables of body parts.

The joints are the 22 SMPL body joints in SMPL's order. Only the joint names are SMPL's; the rest pose and its
dimensions are our own, so that no licensed body model is involved. `prior.body.layouts` maps sensors' joints to them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS
from steadypose.prior.arrays import Bools, Floats

PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
"""Parent of each canonical joint; -1 for the root."""

PARENT: NDArray[np.intp] = np.array(PARENTS)  # (22,) parents, for compiled loops

CHILDREN: tuple[tuple[int, ...], ...] = tuple(
    tuple(child for child, parent in enumerate(PARENTS) if parent == joint) for joint in range(len(PARENTS))
)
"""Children of each joint."""

J: Mapping[str, int] = {name: i for i, name in enumerate(JOINTS)}  # index of each canonical joint by name


def _bones_between() -> NDArray[np.int64]:
    between = np.zeros((len(PARENTS), len(PARENTS)), dtype=np.int64)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            between[joint, :joint] = between[:joint, joint] = between[parent, :joint] + 1
    return between


BONES_BETWEEN: NDArray[np.int64] = _bones_between()  # (22, 22) number of bones between two joints

MIRROR: NDArray[np.intp] = np.array(
    [J[n.replace("left", "#").replace("right", "left").replace("#", "right")] for n in JOINTS]
)
"""(22,) index of each joint's counterpart on the other side; a joint of the middle is its own counterpart."""

REST_OFFSETS: Floats = np.array(
    [
        [0.0, 0.0, 0.0],  # pelvis
        [0.0, 0.088, -0.075],  # left_hip
        [0.0, -0.088, -0.075],  # right_hip
        [-0.01, 0.0, 0.11],  # spine1
        [0.0, 0.0, -0.415],  # left_knee
        [0.0, 0.0, -0.415],  # right_knee
        [0.0, 0.0, 0.13],  # spine2
        [0.0, 0.0, -0.41],  # left_ankle
        [0.0, 0.0, -0.41],  # right_ankle
        [0.01, 0.0, 0.06],  # spine3
        [0.13, 0.015, -0.055],  # left_foot
        [0.13, -0.015, -0.055],  # right_foot
        [-0.01, 0.0, 0.20],  # neck
        [0.0, 0.07, 0.11],  # left_collar
        [0.0, -0.07, 0.11],  # right_collar
        [0.03, 0.0, 0.11],  # head
        [-0.015, 0.11, 0.03],  # left_shoulder
        [-0.015, -0.11, 0.03],  # right_shoulder
        [0.0, 0.275, 0.0],  # left_elbow
        [0.0, -0.275, 0.0],  # right_elbow
        [0.0, 0.25, 0.0],  # left_wrist
        [0.0, -0.25, 0.0],  # right_wrist
    ]
)
"""(22, 3) offset from parent to joint in the rest pose, metres: a T-pose facing +x, left +y, up +z (REP-103).

It is a generic adult of 1.72 m with common anthropometric proportions.
"""

REST_LENGTHS: Floats = np.linalg.norm(REST_OFFSETS, axis=-1)
"""(22,) length of each joint's bone, metres; 0 for the root."""


def _rest_positions() -> Floats:
    placed = np.zeros((len(PARENTS), 3))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        placed[joint] = placed[parent] + REST_OFFSETS[joint]
    return placed


REST_POSITIONS: Floats = _rest_positions()  # (22, 3) positions relative to the pelvis in the rest pose, metres

HIPS = (J["left_hip"], J["right_hip"])
SHOULDERS = (J["left_shoulder"], J["right_shoulder"])
COLLARS = (J["left_collar"], J["right_collar"])

TRUNK = (J["pelvis"], *HIPS, J["spine1"], J["spine2"], J["spine3"], J["neck"], *SHOULDERS)
"""Joints whose positions relative to each other hardly depend on the pose."""

TRUNK_LANDMARKS = (J["pelvis"], *HIPS, J["spine3"], J["neck"], *SHOULDERS)
"""Joints of the trunk that sensors distinguish from their neighbours."""

LIMB_ENDS = frozenset(j for j, name in enumerate(JOINTS) if name.endswith(("knee", "ankle", "elbow", "wrist")))
"""Joints at the lower ends of the four arm bones and the four leg bones."""


def limbs(*chains: tuple[str, ...]) -> list[list[int]]:
    """Return the joints of chains such as ``("elbow", "wrist")``: all of the left side, then all of the right."""
    return [[J[f"{side}_{part}"] for part in chain] for side in ("left", "right") for chain in chains]


def finite_joints(positions: NDArray[np.floating]) -> Bools:
    """(..., J) which joints of (..., J, 3) have three finite coordinates, so were observed."""
    return np.asarray(np.isfinite(positions).all(axis=-1))


def at_origin(joints: NDArray[np.floating]) -> bool:
    """Whether bodies (T, 22, 3) metres, NaN where unknown, stay with their pelvis, or the middle of their hips, at the
    origin. MediaPipe's hips are up to 1 mm away."""
    roots = np.stack([joints[:, J["pelvis"]], joints[:, list(HIPS)].mean(axis=1)])
    return bool((np.fmax.reduce(np.abs(roots), axis=(1, 2), initial=np.nan) < 3e-3).any())


_AVATAR_BONES = {
    "pelvis": ("hips", "Hips"), "spine1": ("spine", "Spine"), "spine2": ("chest", "Spine1"),
    "spine3": ("upperChest", "Spine2"), "neck": ("neck", "Neck"), "head": ("head", "Head"),
    "hip": ("UpperLeg", "UpLeg"), "knee": ("LowerLeg", "Leg"), "ankle": ("Foot", "Foot"), "foot": ("Toes", "ToeBase"),
    "collar": ("Shoulder", "Shoulder"), "shoulder": ("UpperArm", "Arm"), "elbow": ("LowerArm", "ForeArm"),
    "wrist": ("Hand", "Hand"),
}  # fmt: skip
_SIDED = [joint.rpartition("_") for joint in JOINTS]

VRM: tuple[str, ...] = tuple(side + _AVATAR_BONES[part][0] for side, _, part in _SIDED)
"""(22,) names of VRM 1.0's humanoid bones. Unity and the VMC protocol use them with a capital first letter."""

AVATAR_NAMES: Mapping[str, tuple[str, ...]] = {
    "smpl22": JOINTS,
    "vrm": VRM,
    "mixamo": tuple(f"mixamorig:{side.capitalize()}{_AVATAR_BONES[part][1]}" for side, _, part in _SIDED),
}
"""Names of the canonical joints in avatars' rigs, which have the same tree and also rest in a T-pose."""
