"""A person's measures: bones for the kinematics, flesh for what hides what."""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import JOINTS, MIRROR, REST_OFFSETS, J

REST_HEIGHT = 1.72
"""Metres: the stature that `REST_OFFSETS` stands for."""

TOE_HEIGHT = 0.015
"""Metres from the floor to the ball of a foot that rests on it."""

CAPSULES: tuple[tuple[str, str, float], ...] = (
    ("pelvis", "spine3", 0.125),
    ("left_hip", "right_hip", 0.115),
    ("spine3", "neck", 0.11),
    ("left_collar", "left_shoulder", 0.065),
    ("right_collar", "right_shoulder", 0.065),
    ("neck", "head", 0.09),
    ("left_hip", "left_knee", 0.075),
    ("right_hip", "right_knee", 0.075),
    ("left_knee", "left_ankle", 0.05),
    ("right_knee", "right_ankle", 0.05),
    ("left_ankle", "left_foot", 0.04),
    ("right_ankle", "right_foot", 0.04),
    ("left_shoulder", "left_elbow", 0.045),
    ("right_shoulder", "right_elbow", 0.045),
    ("left_elbow", "left_wrist", 0.04),
    ("right_elbow", "right_wrist", 0.04),
)
"""The body's flesh as capsules: from joint, to joint, radius in metres for a stature of 1.72 m."""

_ARM, _LEG = ("elbow", "wrist"), ("knee", "ankle", "foot")
_STATURE = [
    J[n] for n in ("left_hip", "left_knee", "left_ankle", "left_foot", "spine1", "spine2", "spine3", "neck", "head")
]


def random_offsets(rng: np.random.Generator, height: float) -> Floats:
    """Bones of a random adult, the same on both sides.

    Legs, arms and trunk vary by 3 % each and every bone by 1.5 % more (standard deviations, cut at two of them),
    about the generic proportions.

    Args:
        rng: source of the proportions.
        height: stature in metres.

    Returns:
        (22, 3) metres, each joint in its parent's frame in the rest pose.
    """
    trunk, arms, legs = 1.0 + 0.03 * np.clip(rng.standard_normal(3), -2, 2)
    own = 1.0 + 0.015 * np.clip(rng.standard_normal(len(JOINTS)), -2, 2)
    own = (own + own[MIRROR]) / 2
    part = np.array([arms if n.endswith(_ARM) else legs if n.endswith(_LEG) else trunk for n in JOINTS])
    offsets = REST_OFFSETS * (part * own)[:, None]
    return offsets * (height / stature(offsets))


def stature(offsets: Floats) -> float:
    """Metres of height of a person with bones (22, 3)."""
    return REST_HEIGHT * float(np.abs(offsets[_STATURE, 2]).sum() / np.abs(REST_OFFSETS[_STATURE, 2]).sum())
