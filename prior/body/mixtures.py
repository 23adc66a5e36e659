"""Joints of the trunk that a sensor lacks, as weighted means of its neighbours.

Inverse kinematics places such a joint on the rest pose's bones, whose directions differ between people. A mean needs no
bones. Collars are means by definition, because motion files place them differently.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import JOINTS, J

COLLAR = (0.333, 0.278, 0.389)  # shares of spine3, neck and shoulder in a collar, as in the rest pose

_MIXTURES: Mapping[str, Mapping[str, float]] = {
    "spine1": {"pelvis": 0.63, "spine3": 0.37},
    "spine2": {"pelvis": 0.2, "spine3": 0.8},
    "left_collar": dict(zip(("spine3", "neck", "left_shoulder"), COLLAR, strict=True)),
    "right_collar": dict(zip(("spine3", "neck", "right_shoulder"), COLLAR, strict=True)),
}
SHARES = np.array([[_MIXTURES.get(joint, {}).get(part, 0.0) for part in JOINTS] for joint in JOINTS])
"""(22, 22) shares of other joints in each joint of the trunk that a sensor may lack; rows of 0 for all others."""

SIGMA = np.where(np.array(JOINTS) == "spine1", 0.008, 0.003)
"""(22,) metres along an axis, standard deviation of a mean of exact joints (validation: spine1 0.009, spine2 0.003)."""

_SPINE = np.array([joint in ("spine1", "spine2") for joint in JOINTS])
_ENDS = [J["pelvis"], J["spine3"]]


def mixed(lacking: Bools) -> Bools:
    """(..., 22) which joints are means, given which the sensor lacks (..., 22).

    A spine between ends that the sensor lacks too follows from orientations, which is more accurate.
    """
    ends = ~lacking[..., _ENDS].any(axis=-1, keepdims=True)
    return lacking & SHARES.any(axis=-1) & (ends | ~_SPINE)


def mix(positions: Floats, lacking: Bools) -> Floats:
    """Return positions (..., 22, 3) with means in place of `mixed` joints."""
    return np.where(mixed(lacking)[..., None], SHARES @ positions, positions)
