"""Sensors' joint layouts: the tables that map each sensor's joints to the canonical 22.

A table says, of each canonical joint, which sensor joints it is the weighted mean of. A joint that a sensor lacks has
no entry: it stays unobserved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import JOINTS, J, finite_joints


@dataclass(frozen=True)
class Skeleton:
    """A sensor's joints and how the canonical ones are made of them.

    Attributes:
        name: the name that messages and files use.
        joints: the sensor's joint names in the sensor's order.
        table: canonical joint -> sensor joint, or sensor joints with their weights (made to sum to 1).
    """

    name: str
    joints: tuple[str, ...]
    table: Mapping[str, str | Mapping[str, float]]

    def index(self, joint: str) -> int:
        """Index of a sensor joint by name.

        Raises:
            KeyError: the skeleton has no such joint.
        """
        try:
            return self.joints.index(joint)
        except ValueError:
            raise KeyError(f"skeleton '{self.name}' has no joint '{joint}'; it has {', '.join(self.joints)}") from None

    @cached_property
    def to_canonical(self) -> NDArray[np.float64]:
        """(22, J) weights: each row sums to 1, or to 0 where the sensor lacks the joint."""
        matrix = np.zeros((len(JOINTS), len(self.joints)))
        for joint, source in self.table.items():
            weights = {source: 1.0} if isinstance(source, str) else source
            total = sum(weights.values())
            for name, weight in weights.items():
                matrix[J[joint], self.index(name)] = weight / total
        return matrix

    @cached_property
    def observable(self) -> NDArray[np.bool_]:
        """(22,) which canonical joints this sensor can see at all."""
        return self.to_canonical.sum(axis=1) > 0


def _mean(*names: str) -> dict[str, float]:
    return dict.fromkeys(names, 1.0)


def _sides(left: Mapping[str, str | Mapping[str, float]], swap: tuple[str, str]) -> dict[str, str | dict[str, float]]:
    """The entries of the left side and their mirror images, by exchanging ``swap`` in the sensor's names."""
    table: dict[str, str | dict[str, float]] = {}
    for joint, source in left.items():
        weights = {source: 1.0} if isinstance(source, str) else dict(source)
        table[joint] = weights
        table[joint.replace("left", "right")] = {_replace_side(n, swap): w for n, w in weights.items()}
    return table


def _replace_side(name: str, swap: tuple[str, str]) -> str:
    left, right = swap
    if left not in name:
        raise ValueError(f"'{name}' has no '{left}' to exchange for '{right}'")
    return name.replace(left, right, 1)


_ARMS_AND_LEGS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")

CANONICAL = Skeleton("smpl22", JOINTS, {j: j for j in JOINTS})

COCO17 = Skeleton(
    "coco17",
    (
        "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
        "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee",
        "left_ankle", "right_ankle",
    ),
    {
        "pelvis": _mean("left_hip", "right_hip"),
        "neck": _mean("left_shoulder", "right_shoulder"),
        "head": _mean("left_ear", "right_ear"),
        **_sides({f"left_{j}": f"left_{j}" for j in _ARMS_AND_LEGS}, ("left", "right")),
    },
)  # fmt: skip

BLAZEPOSE33 = Skeleton(
    "blazepose33",
    (
        "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer",
        "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow",
        "right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
        "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
        "right_ankle", "left_heel", "right_heel", "left_foot_index", "right_foot_index",
    ),
    {
        "pelvis": _mean("left_hip", "right_hip"),
        "neck": _mean("left_shoulder", "right_shoulder"),
        "head": _mean("left_ear", "right_ear"),
        **_sides({f"left_{j}": f"left_{j}" for j in _ARMS_AND_LEGS}, ("left", "right")),
        **_sides({"left_foot": "left_foot_index"}, ("left", "right")),
    },
)  # fmt: skip

H36M17 = Skeleton(
    "h36m17",
    (
        "hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle", "spine", "thorax",
        "nose", "head_top", "left_shoulder", "left_elbow", "left_wrist", "right_shoulder", "right_elbow",
        "right_wrist",
    ),
    {
        "pelvis": "hip",
        "spine2": "spine",
        "neck": "thorax",
        "head": _mean("nose", "head_top"),
        **_sides({f"left_{j}": f"left_{j}" for j in _ARMS_AND_LEGS}, ("left", "right")),
    },
)  # fmt: skip

# The Kinect v2 as UI-PRMD renames it. Its "Spine" lies 29 cm above the waist (the height of spine3), "Chest" is
# the shoulders' mid-point with "Neck" and both collars derived from it by a centimetre, "Head" is the neck and
# "HeadTip" the head's centre: measured on the recordings, whatever the names say.
KINECT22 = Skeleton(
    "kinect22",
    (
        "Waist", "Spine", "Chest", "Neck", "Head", "HeadTip", "LCollar", "LUpperArm", "LForearm", "LHand",
        "RCollar", "RUpperArm", "RForearm", "RHand", "LUpperLeg", "LLowerLeg", "LFoot", "LToes", "RUpperLeg",
        "RLowerLeg", "RFoot", "RToes",
    ),
    {
        "pelvis": "Waist",
        "spine3": "Spine",
        "neck": "Neck",
        "head": _mean("Head", "HeadTip"),
        **_sides(
            {
                "left_hip": "LUpperLeg", "left_knee": "LLowerLeg", "left_ankle": "LFoot", "left_foot": "LToes",
                "left_shoulder": "LUpperArm", "left_elbow": "LForearm", "left_wrist": "LHand",
            },
            ("L", "R"),
        ),
    },
)  # fmt: skip

AZURE_KINECT32 = Skeleton(
    "azure_kinect32",
    (
        "PELVIS", "SPINE_NAVEL", "SPINE_CHEST", "NECK", "CLAVICLE_LEFT", "SHOULDER_LEFT", "ELBOW_LEFT",
        "WRIST_LEFT", "HAND_LEFT", "HANDTIP_LEFT", "THUMB_LEFT", "CLAVICLE_RIGHT", "SHOULDER_RIGHT",
        "ELBOW_RIGHT", "WRIST_RIGHT", "HAND_RIGHT", "HANDTIP_RIGHT", "THUMB_RIGHT", "HIP_LEFT", "KNEE_LEFT",
        "ANKLE_LEFT", "FOOT_LEFT", "HIP_RIGHT", "KNEE_RIGHT", "ANKLE_RIGHT", "FOOT_RIGHT", "HEAD", "NOSE",
        "EYE_LEFT", "EAR_LEFT", "EYE_RIGHT", "EAR_RIGHT",
    ),
    {
        "pelvis": "PELVIS",
        "spine2": "SPINE_NAVEL",
        "spine3": "SPINE_CHEST",
        "neck": "NECK",
        "head": "HEAD",
        **_sides({f"left_{j}": f"{j.upper()}_LEFT" for j in (*_ARMS_AND_LEGS, "foot")}, ("LEFT", "RIGHT")),
        **_sides({"left_collar": "CLAVICLE_LEFT"}, ("LEFT", "RIGHT")),
    },
)  # fmt: skip

ZED38 = Skeleton(
    "zed38",
    (
        "PELVIS", "SPINE_1", "SPINE_2", "SPINE_3", "NECK", "NOSE", "LEFT_EYE", "RIGHT_EYE", "LEFT_EAR",
        "RIGHT_EAR", "LEFT_CLAVICLE", "RIGHT_CLAVICLE", "LEFT_SHOULDER", "RIGHT_SHOULDER", "LEFT_ELBOW",
        "RIGHT_ELBOW", "LEFT_WRIST", "RIGHT_WRIST", "LEFT_HIP", "RIGHT_HIP", "LEFT_KNEE", "RIGHT_KNEE",
        "LEFT_ANKLE", "RIGHT_ANKLE", "LEFT_BIG_TOE", "RIGHT_BIG_TOE", "LEFT_SMALL_TOE", "RIGHT_SMALL_TOE",
        "LEFT_HEEL", "RIGHT_HEEL", "LEFT_HAND_THUMB_4", "RIGHT_HAND_THUMB_4", "LEFT_HAND_INDEX_1",
        "RIGHT_HAND_INDEX_1", "LEFT_HAND_MIDDLE_4", "RIGHT_HAND_MIDDLE_4", "LEFT_HAND_PINKY_1",
        "RIGHT_HAND_PINKY_1",
    ),
    {
        "pelvis": "PELVIS",
        "spine1": "SPINE_1",
        "spine2": "SPINE_2",
        "spine3": "SPINE_3",
        "neck": "NECK",
        "head": _mean("LEFT_EAR", "RIGHT_EAR"),
        **_sides({f"left_{j}": f"LEFT_{j.upper()}" for j in _ARMS_AND_LEGS}, ("LEFT", "RIGHT")),
        **_sides({"left_collar": "LEFT_CLAVICLE"}, ("LEFT", "RIGHT")),
        **_sides({"left_foot": _mean("LEFT_BIG_TOE", "LEFT_SMALL_TOE")}, ("LEFT", "RIGHT")),
    },
)  # fmt: skip

OPENPOSE25 = Skeleton(
    "openpose25",
    (
        "Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist", "MidHip", "RHip", "RKnee",
        "RAnkle", "LHip", "LKnee", "LAnkle", "REye", "LEye", "REar", "LEar", "LBigToe", "LSmallToe", "LHeel",
        "RBigToe", "RSmallToe", "RHeel",
    ),
    {
        "pelvis": "MidHip",
        "neck": "Neck",
        "head": _mean("LEar", "REar"),
        **_sides({f"left_{j}": f"L{j.capitalize()}" for j in _ARMS_AND_LEGS}, ("L", "R")),
        **_sides({"left_foot": _mean("LBigToe", "LSmallToe")}, ("L", "R")),
    },
)  # fmt: skip

# The Kinect v2 as its SDK numbers it (JointType). What KINECT22 calls Spine, Chest, Head and HeadTip are its SpineMid,
# SpineShoulder, Neck and Head.
KINECT25 = Skeleton(
    "kinect25",
    (
        "SpineBase", "SpineMid", "Neck", "Head", "ShoulderLeft", "ElbowLeft", "WristLeft", "HandLeft",
        "ShoulderRight", "ElbowRight", "WristRight", "HandRight", "HipLeft", "KneeLeft", "AnkleLeft", "FootLeft",
        "HipRight", "KneeRight", "AnkleRight", "FootRight", "SpineShoulder", "HandTipLeft", "ThumbLeft",
        "HandTipRight", "ThumbRight",
    ),
    {
        "pelvis": "SpineBase",
        "spine3": "SpineMid",
        "neck": "SpineShoulder",
        "head": _mean("Neck", "Head"),
        **_sides({f"left_{j}": f"{j.capitalize()}Left" for j in (*_ARMS_AND_LEGS, "foot")}, ("Left", "Right")),
    },
)  # fmt: skip

# The body of COCO-WholeBody: COCO's 17 and three points of each foot.
COCO_WHOLEBODY23 = Skeleton(
    "coco_wholebody23",
    (
        *COCO17.joints, "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe",
        "right_heel",
    ),
    {**COCO17.table, **_sides({"left_foot": _mean("left_big_toe", "left_small_toe")}, ("left", "right"))},
)  # fmt: skip

# Halpe's body (AlphaPose, RTMPose, Pose2Sim): COCO's 17, the head's top, neck, the hips' middle, and the feet.
HALPE26 = Skeleton(
    "halpe26",
    (
        *COCO17.joints, "head", "neck", "hip", "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe",
        "left_heel", "right_heel",
    ),
    {**COCO_WHOLEBODY23.table, "pelvis": "hip", "neck": "neck"},
)  # fmt: skip

# SMPL's own: the 22 and a point of each hand.
SMPL24 = Skeleton("smpl24", (*JOINTS, "left_hand", "right_hand"), CANONICAL.table)

# ZED's BODY_18 (COCO's with a neck, in OpenPose's order) and BODY_34, as the SDK numbers them.
ZED18 = Skeleton(
    "zed18",
    (
        "NOSE", "NECK", "RIGHT_SHOULDER", "RIGHT_ELBOW", "RIGHT_WRIST", "LEFT_SHOULDER", "LEFT_ELBOW", "LEFT_WRIST",
        "RIGHT_HIP", "RIGHT_KNEE", "RIGHT_ANKLE", "LEFT_HIP", "LEFT_KNEE", "LEFT_ANKLE", "RIGHT_EYE", "LEFT_EYE",
        "RIGHT_EAR", "LEFT_EAR",
    ),
    {
        "pelvis": _mean("LEFT_HIP", "RIGHT_HIP"),
        "neck": "NECK",
        "head": _mean("LEFT_EAR", "RIGHT_EAR"),
        **_sides({f"left_{j}": f"LEFT_{j.upper()}" for j in _ARMS_AND_LEGS}, ("LEFT", "RIGHT")),
    },
)  # fmt: skip

ZED34 = Skeleton(
    "zed34",
    (
        "PELVIS", "NAVAL_SPINE", "CHEST_SPINE", "NECK", "LEFT_CLAVICLE", "LEFT_SHOULDER", "LEFT_ELBOW", "LEFT_WRIST",
        "LEFT_HAND", "LEFT_HANDTIP", "LEFT_THUMB", "RIGHT_CLAVICLE", "RIGHT_SHOULDER", "RIGHT_ELBOW", "RIGHT_WRIST",
        "RIGHT_HAND", "RIGHT_HANDTIP", "RIGHT_THUMB", "LEFT_HIP", "LEFT_KNEE", "LEFT_ANKLE", "LEFT_FOOT",
        "RIGHT_HIP", "RIGHT_KNEE", "RIGHT_ANKLE", "RIGHT_FOOT", "HEAD", "NOSE", "LEFT_EYE", "LEFT_EAR", "RIGHT_EYE",
        "RIGHT_EAR", "LEFT_HEEL", "RIGHT_HEEL",
    ),
    {
        "pelvis": "PELVIS",
        "spine2": "NAVAL_SPINE",
        "spine3": "CHEST_SPINE",
        "neck": "NECK",
        "head": "HEAD",
        **_sides({f"left_{j}": f"LEFT_{j.upper()}" for j in (*_ARMS_AND_LEGS, "foot")}, ("LEFT", "RIGHT")),
        **_sides({"left_collar": "LEFT_CLAVICLE"}, ("LEFT", "RIGHT")),
    },
)  # fmt: skip

_SKELETONS: dict[str, Skeleton] = {
    s.name: s
    for s in (
        CANONICAL, COCO17, BLAZEPOSE33, H36M17, KINECT22, KINECT25, AZURE_KINECT32, ZED38, OPENPOSE25, SMPL24,
        COCO_WHOLEBODY23, HALPE26, ZED18, ZED34,
    )
}  # fmt: skip
SKELETONS: Mapping[str, Skeleton] = MappingProxyType(_SKELETONS)
"""Every skeleton that ``pose/raw`` may name: these, and those of the user's own (`own_layouts`)."""


def add_skeleton(skeleton: Skeleton) -> None:
    """Make a skeleton known by its name, to all of this process."""
    _SKELETONS[skeleton.name] = skeleton


def get_skeleton(name: str) -> Skeleton:
    """The skeleton of that name.

    Raises:
        KeyError: unknown name; the message lists the known ones.
    """
    try:
        return SKELETONS[name]
    except KeyError:
        raise KeyError(f"unknown skeleton '{name}': expected one of {', '.join(SKELETONS)}") from None


def to_canonical(
    skeleton: Skeleton, positions: NDArray[np.floating], confidence: NDArray[np.floating] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Map a sensor's joints to the canonical 22.

    Args:
        skeleton: the sensor's skeleton with J joints.
        positions: (..., J, 3) metres, any frame; NaN where missing.
        confidence: (..., J) in 0..1; all ones if left out.

    Returns:
        positions (..., 22, 3), NaN where unobserved, and confidence (..., 22), the least of the joints that
        went in and 0 where unobserved.
    """
    weights = skeleton.to_canonical
    if confidence is None:
        confidence = np.ones(positions.shape[:-1])
    missing = ~finite_joints(positions)
    filled = np.where(missing[..., None], 0.0, positions)
    mapped = weights @ filled
    needs = weights > 0
    unobserved = (missing @ needs.T.astype(np.float64) > 0) | ~skeleton.observable
    mapped[unobserved] = np.nan
    contributors = np.where(needs, confidence[..., None, :], np.inf).min(axis=-1)
    return mapped, np.where(unobserved, 0.0, contributors)
