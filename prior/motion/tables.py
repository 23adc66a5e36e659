"""How the skeletons of motion files map to the canonical joints, and their units and axes.

Sensors' tables (`prior.body.layouts`) leave a joint that is not there unobserved. Training needs complete bodies, so
these tables place the joints that a file lacks: within a bone that is there (a point of the spine or the neck is
a fixed mixture of the bone's ends, so that it moves rigidly with it), and a missing collar in the plane of
chest, neck and shoulder. The mixtures put each joint at the height the rest skeleton has it, scaled to the
torso. Figures in comments are centimetres above the hips: the rest skeleton has pelvis 7.5, spine1 18.5, spine2
31.5, spine3 37.5, collar 48.5, shoulder 51.5, neck 57.5, head 68.5.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from steadypose.prior.body.layouts import Skeleton

CMU_METRES = 0.0254 / 0.45
"""The size of CMU's unit: an inch, scaled by the 0.45 of its ASF files."""

Mixture = str | Mapping[str, float]


@dataclass(frozen=True)
class Rig:
    """A family of motion files that share joint names. y points up in all of them.

    Attributes:
        skeleton: the joints that matter, and their table.
        metres: the size of the file's unit.
        lost_bones: joints whose OFFSET the family's converter has lost (it is zero), each with the bone's length
            as a multiple of its parent's OFFSET, whose direction it shares.
    """

    skeleton: Skeleton
    metres: float
    lost_bones: Mapping[str, float] = field(default_factory=dict)


def _mix(*parts: tuple[Mixture, float]) -> dict[str, float]:
    """Joint weights of a mixture of mixtures."""
    total: dict[str, float] = {}
    for part, weight in parts:
        named = {part: 1.0} if isinstance(part, str) else part
        share = weight / sum(named.values())
        for name, inner in named.items():
            total[name] = total.get(name, 0.0) + share * inner
    return total


def _collar(spine3: Mixture, neck: Mixture, shoulder: Mixture) -> dict[str, float]:
    """The rest skeleton's collar as a mixture of its neighbours."""
    return _mix((spine3, 0.333), (neck, 0.278), (shoulder, 0.389))


def _skeleton(
    name: str, middle: Mapping[str, Mixture], left: Mapping[str, Mixture], left_name: str, right_name: str
) -> Skeleton:
    """A skeleton from its table; names on the right are those on the left with ``left_name`` (regex) replaced."""
    table = dict(middle)
    for joint, source in left.items():
        weights = {source: 1.0} if isinstance(source, str) else source
        table[f"left_{joint}"] = weights
        table[f"right_{joint}"] = {re.sub(left_name, right_name, n): w for n, w in weights.items()}
    named = {n for source in table.values() for n in ([source] if isinstance(source, str) else source)}
    return Skeleton(name, tuple(sorted(named)), table)


# Joints are the far ends of bones. root 10, lowerback 22, upperback 33, thorax 45 (where the clavicles start, 5
# below the shoulders), lowerneck 54, upperneck 63, head 72. The forearm is lradius and, in line with it and free
# to turn about it alone, lwrist: the hand bends at the latter's far end.
CMU_AMC = Rig(
    _skeleton(
        "cmu_amc",
        {
            "pelvis": "root",
            "spine1": "lowerback",
            "spine2": {"lowerback": 0.32, "upperback": 0.68},
            "spine3": "upperback",
            "neck": "lowerneck",
            "head": {"upperneck": 0.8, "head": 0.2},
        },
        {
            "hip": "lhipjoint",
            "knee": "lfemur",
            "ankle": "ltibia",
            "foot": "lfoot",
            "collar": _collar("upperback", "lowerneck", "lclavicle"),
            "shoulder": "lclavicle",
            "elbow": "lhumerus",
            "wrist": "lwrist",
        },
        "^l(?!ower)",
        "r",
    ),
    metres=1.0,
)

# The same bones, joints named by their near ends (B. Hahne's conversion, cgspeed.com, and what derives from it).
# That converter loses the length of each bone with several children: the thorax (12 cm, as long as the upper back
# in the ASF) and the wrist's part of the forearm (9 cm, half of the radius there).
CMU_BVH = Rig(
    _skeleton(
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
            "collar": _collar("Spine1", "Neck1", "LeftArm"),
            "shoulder": "LeftArm",
            "elbow": "LeftForeArm",
            "wrist": "LeftFingerBase",
        },
        "Left",
        "Right",
    ),
    metres=CMU_METRES,
    lost_bones={
        "Neck": 1.0,
        "LeftShoulder": 1.0,
        "RightShoulder": 1.0,
        "LeftFingerBase": 0.5,
        "RightFingerBase": 0.5,
    },
)

# Reallusion's characters. Hip 2.2, Waist 10.1, Spine01 14.8, Spine02 29.5, NeckTwist01 56.9, Head 64.8.
ICLONE = Rig(
    _skeleton(
        "iclone",
        {
            "pelvis": {"CC_Base_Hip": 0.33, "CC_Base_Waist": 0.67},
            "spine1": {"CC_Base_Spine01": 0.75, "CC_Base_Spine02": 0.25},
            "spine2": {"CC_Base_Spine02": 0.93, "CC_Base_NeckTwist01": 0.07},
            "spine3": {"CC_Base_Spine02": 0.71, "CC_Base_NeckTwist01": 0.29},
            "neck": "CC_Base_NeckTwist01",
            "head": "CC_Base_Head",
        },
        {
            "hip": "CC_Base_L_Thigh",
            "knee": "CC_Base_L_Calf",
            "ankle": "CC_Base_L_Foot",
            "foot": "CC_Base_L_ToeBase",
            "collar": "CC_Base_L_Clavicle",
            "shoulder": "CC_Base_L_Upperarm",
            "elbow": "CC_Base_L_Forearm",
            "wrist": "CC_Base_L_Hand",
        },
        "_L_",
        "_R_",
    ),
    metres=0.01,
)

# pelvis 0, spine.001 23, neck 46 (the height of the shoulders), face 64; wrists and toes are end sites. Torso
# 0.9 of the rest skeleton's.
_REACTIDLE_SPINE3 = {"spine.001": 0.54, "neck": 0.46}
_REACTIDLE_NECK = {"neck": 0.7, "face": 0.3}
REACTIDLE = Rig(
    _skeleton(
        "reactidle",
        {
            "pelvis": {"pelvis": 0.71, "spine.001": 0.29},
            "spine1": {"pelvis": 0.28, "spine.001": 0.72},
            "spine2": {"spine.001": 0.78, "neck": 0.22},
            "spine3": _REACTIDLE_SPINE3,
            "neck": _REACTIDLE_NECK,
            "head": {"neck": 0.13, "face": 0.87},
        },
        {
            "hip": "thigh.L",
            "knee": "shin.L",
            "ankle": "foot.L",
            "foot": "foot.L_end",
            "collar": _collar(_REACTIDLE_SPINE3, _REACTIDLE_NECK, "upper_arm.L"),
            "shoulder": "upper_arm.L",
            "elbow": "forearm.L",
            "wrist": "forearm.L_end",
        },
        r"\.L",
        ".R",
    ),
    metres=1.0,
)

# Hips 2.2, Spine 17.9, Chest 26.9, Neck 43.3, Head 49.7: a stylised body, torso 0.8 of the rest skeleton's.
BANDAI = Rig(
    _skeleton(
        "bandai",
        {
            "pelvis": {"Hips": 0.76, "Spine": 0.24},
            "spine1": {"Hips": 0.2, "Spine": 0.8},
            "spine2": {"Spine": 0.19, "Chest": 0.81},
            "spine3": {"Chest": 0.81, "Neck": 0.19},
            "neck": "Neck",
            "head": "Head",
        },
        {
            "hip": "UpperLeg_L",
            "knee": "LowerLeg_L",
            "ankle": "Foot_L",
            "foot": "Toes_L",
            "collar": "Shoulder_L",
            "shoulder": "UpperArm_L",
            "elbow": "LowerArm_L",
            "wrist": "Hand_L",
        },
        "_L",
        "_R",
    ),
    metres=0.01,
)

# DAZ's figures, another common form of CMU's database. hip -2.6, abdomen 18.0, chest 29.7, neck 51.9, head 59.0, eyes
# 67.1 and 8 before the head, shoulders 47.0: torso 0.91 of the rest skeleton's. Toes are the feet's end sites.
_DAZ_SPINE3 = {"chest": 0.8, "neck": 0.2}
CMU_DAZ = Rig(
    _skeleton(
        "cmu_daz",
        {
            "pelvis": {"hip": 0.54, "abdomen": 0.46},
            "spine1": {"hip": 0.05, "abdomen": 0.95},
            "spine2": {"abdomen": 0.08, "chest": 0.92},
            "spine3": _DAZ_SPINE3,
            "neck": "neck",
            "head": {"head": 0.57, "leftEye": 0.215, "rightEye": 0.215},
        },
        {
            "hip": "lThigh",
            "knee": "lShin",
            "ankle": "lFoot",
            "foot": "lFoot_end",
            "collar": _collar(_DAZ_SPINE3, "neck", "lShldr"),
            "shoulder": "lShldr",
            "elbow": "lForeArm",
            "wrist": "lHand",
        },
        "^l(?=[A-Z])",
        "r",
    ),
    metres=0.01,
)

BVH_RIGS: tuple[Rig, ...] = (CMU_BVH, CMU_DAZ, ICLONE, REACTIDLE, BANDAI)
"""The families of BVH files that are recognised by their joints' names."""
