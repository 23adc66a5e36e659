"""The skeletons of motion files that topology alone (`prior.body.rigs`) does not tell: CMU's own, and its commonest
conversion, which has lost bones.

Training needs complete bodies, so the tables place the joints that a file lacks within a bone that is there, at the
height the rest skeleton has them. Figures in comments are centimetres above the hips, where the rest skeleton has
pelvis 7.5, spine1 18.5, spine2 31.5, spine3 37.5, collar 48.5, shoulder 51.5, neck 57.5, head 68.5.
"""

from __future__ import annotations

import re

from steadypose.prior.body.rigs import UNITS, Rig, collar, skeleton

# Joints are the far ends of bones. root 10, lowerback 22, upperback 33, thorax 45 (where the clavicles start, 5
# below the shoulders), lowerneck 54, upperneck 63, head 72. The forearm is lradius and, in line with it and free
# to turn about it alone, lwrist: the hand bends at the latter's far end.
CMU_AMC = Rig(
    skeleton(
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
            "collar": collar("upperback", "lowerneck", "lclavicle"),
            "shoulder": "lclavicle",
            "elbow": "lhumerus",
            "wrist": "lwrist",
        },
        lambda joint: re.sub("^l(?!ower)", "r", joint),
    ),
    metres=1.0,
    up="y",
)

# The same bones, joints named by their near ends (B. Hahne's conversion, cgspeed.com, and what derives from it).
# That converter loses the length of each bone with several children: the thorax (12 cm, as long as the upper back
# in the ASF) and the wrist's part of the forearm (9 cm, half of the radius there).
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
    lost_bones={
        "Neck": 1.0,
        "LeftShoulder": 1.0,
        "RightShoulder": 1.0,
        "LeftFingerBase": 0.5,
        "RightFingerBase": 0.5,
    },
)
