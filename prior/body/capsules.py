"""Dimensions of a simulated person: bones, capsules that occlude, and the positions of a sensor's joints on the body.

Each joint of a sensor is fixed in the frame of a canonical joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.body.skeleton import JOINTS, MIRROR, REST_OFFSETS, REST_POSITIONS, J

REST_HEIGHT = 1.72  # stature of a person with the bones `REST_OFFSETS`, metres
TOE_HEIGHT = 0.015  # height above the floor of the ball of a resting foot, metres

CAPSULES: tuple[tuple[str, str, float], ...] = (
    ("pelvis", "spine3", 0.125),
    ("left_hip", "right_hip", 0.115),
    ("spine3", "neck", 0.11),
    ("neck", "head", 0.09),
    *(
        (f"{side}_{start}", f"{side}_{end}", radius)
        for start, end, radius in (
            ("collar", "shoulder", 0.065), ("shoulder", "elbow", 0.045), ("elbow", "wrist", 0.04),
            ("hip", "knee", 0.075), ("knee", "ankle", 0.05), ("ankle", "foot", 0.04),
        )
        for side in ("left", "right")
    ),
)  # fmt: skip
"""Capsules of the body's volume: from joint, to joint, radius for a stature of 1.72 m, metres."""

_ARM, _LEG = ("elbow", "wrist"), ("knee", "ankle", "foot")
_STATURE = [
    J[n] for n in ("left_hip", "left_knee", "left_ankle", "left_foot", "spine1", "spine2", "spine3", "neck", "head")
]


def random_offsets(rng: np.random.Generator, height: float) -> Floats:
    """Draw the bones of a random adult of stature ``height`` (metres), equal on both sides: (22, 3) metres, each joint
    in its parent's frame in the rest pose.

    Legs, arms and trunk vary about the generic proportions by 3 % each, and every bone by another 1.5 % (standard
    deviations, clipped at two of them).
    """
    trunk, arms, legs = 1.0 + 0.03 * np.clip(rng.standard_normal(3), -2, 2)
    own = 1.0 + 0.015 * np.clip(rng.standard_normal(len(JOINTS)), -2, 2)
    own = (own + own[MIRROR]) / 2
    part = np.array([arms if n.endswith(_ARM) else legs if n.endswith(_LEG) else trunk for n in JOINTS])
    offsets = REST_OFFSETS * (part * own)[:, None]
    return offsets * (height / stature(offsets))


def stature(offsets: Floats) -> float:
    """Return the stature of a person with bones (22, 3), metres."""
    return REST_HEIGHT * float(np.abs(offsets[_STATURE, 2]).sum() / np.abs(REST_OFFSETS[_STATURE, 2]).sum())


# Joints that the canonical skeleton lacks: the canonical joint to which each is fixed, and its position in the rest
# frame (x forward, y left, z up), metres, for a stature of 1.72 m. Only left and middle are listed; right is the mirror
# image.
_RIDES: Mapping[str, Mapping[str, tuple[str, tuple[float, float, float]]]] = {
    "smpl22": {},
    "coco17": {
        "nose": ("head", (0.105, 0.0, 0.0)),
        "left_eye": ("head", (0.085, 0.032, 0.035)),
        "left_ear": ("head", (0.0, 0.075, 0.0)),
    },
    "blazepose33": {
        "nose": ("head", (0.105, 0.0, 0.0)),
        "left_eye_inner": ("head", (0.088, 0.018, 0.035)),
        "left_eye": ("head", (0.085, 0.032, 0.035)),
        "left_eye_outer": ("head", (0.080, 0.046, 0.035)),
        "left_ear": ("head", (0.0, 0.075, 0.0)),
        "mouth_left": ("head", (0.090, 0.025, -0.045)),
        "left_pinky": ("left_wrist", (-0.030, 0.085, 0.0)),
        "left_index": ("left_wrist", (0.030, 0.095, 0.0)),
        "left_thumb": ("left_wrist", (0.050, 0.035, -0.01)),
        "left_heel": ("left_ankle", (-0.055, 0.0, -0.045)),
    },
    "kinect22": {
        "Chest": ("neck", (0.0, 0.0, -0.01)),
        "LCollar": ("neck", (0.0, 0.012, -0.01)),
        "Head": ("head", (-0.015, 0.0, -0.06)),
        "HeadTip": ("head", (0.015, 0.0, 0.06)),
    },
}
_RIGHT_NAME: Mapping[str, str] = {"mouth_left": "mouth_right", "LCollar": "RCollar"}


@dataclass(frozen=True)
class Mount:
    """A sensor's J joints on the canonical body."""

    joint: NDArray[np.intp]  # (J,) index of the canonical joint to which each joint is fixed
    place: Floats  # (J, 3) metres, position in that joint's frame for a stature of 1.72 m
    mirror: NDArray[np.intp]  # (J,) index of each joint's counterpart on the other side

    def positions(self, joints: Floats, orientations: Floats, scale: float) -> Floats:
        """(..., J, 3) metres, from canonical joints (..., 22, 3), their world orientations, and stature / 1.72 m."""
        turned = np.einsum("...jab,jb->...ja", orientations[..., self.joint, :, :], scale * self.place)
        return joints[..., self.joint, :] + turned


@cache
def mount(skeleton: str) -> Mount:
    """Return the positions of a sensor's joints on the body.

    Raises:
        ValueError: the simulator cannot place this skeleton.
    """
    if skeleton not in _RIDES:
        raise ValueError(f"cannot simulate skeleton '{skeleton}': expected one of {', '.join(_RIDES)}")
    rides: dict[str, tuple[str, tuple[float, float, float]]] = {}
    for canonical, source in SKELETONS[skeleton].table.items():
        direct = [source] if isinstance(source, str) else list(source)
        if len(direct) == 1:
            rides[direct[0]] = (canonical, (0.0, 0.0, 0.0))
    for name, (canonical, (x, y, z)) in _RIDES[skeleton].items():
        rides[name] = (canonical, (x, y, z))
        other = _RIGHT_NAME.get(name, name.replace("left", "right"))
        if other != name:
            rides[other] = (JOINTS[MIRROR[J[canonical]]], (x, -y, z))
    joints, places = zip(*(rides[name] for name in SKELETONS[skeleton].joints), strict=True)
    joint, place = np.array([J[name] for name in joints]), np.array(places)
    rest = REST_POSITIONS[joint] + place
    # a joint's counterpart is the joint nearest to its mirror image in the rest pose
    apart = np.linalg.norm(rest[:, None] * [1.0, -1.0, 1.0] - rest[None], axis=-1)
    return Mount(joint, place, apart.argmin(axis=1))
