"""The names that avatars' rigs have for the canonical joints, whose tree is the same and whose rest pose is a T too."""

from __future__ import annotations

from collections.abc import Mapping

from steadypose.msgs.types import JOINTS

_MIDDLE = {
    "pelvis": ("hips", "Hips"),
    "spine1": ("spine", "Spine"),
    "spine2": ("chest", "Spine1"),
    "spine3": ("upperChest", "Spine2"),
    "neck": ("neck", "Neck"),
    "head": ("head", "Head"),
}
_SIDES = {
    "hip": ("UpperLeg", "UpLeg"),
    "knee": ("LowerLeg", "Leg"),
    "ankle": ("Foot", "Foot"),
    "foot": ("Toes", "ToeBase"),
    "collar": ("Shoulder", "Shoulder"),
    "shoulder": ("UpperArm", "Arm"),
    "elbow": ("LowerArm", "ForeArm"),
    "wrist": ("Hand", "Hand"),
}


def _names(joint: str) -> tuple[str, str]:
    if joint in _MIDDLE:
        return _MIDDLE[joint]
    side, _, part = joint.partition("_")
    vrm, mixamo = _SIDES[part]
    return f"{side}{vrm}", f"{side.capitalize()}{mixamo}"


VRM: tuple[str, ...] = tuple(_names(joint)[0] for joint in JOINTS)
"""(22,) humanoid bones of VRM 1.0; with a capital first letter those of Unity and of the VMC protocol"""
MIXAMO: tuple[str, ...] = tuple(f"mixamorig:{_names(joint)[1]}" for joint in JOINTS)
"""(22,) of Mixamo's rigs"""
NAMES: Mapping[str, tuple[str, ...]] = {"smpl22": JOINTS, "vrm": VRM, "mixamo": MIXAMO}
"""by the name of the rig"""
