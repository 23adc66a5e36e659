"""CMU's motion capture where topology alone (`prior.body.rigs`) does not tell the skeleton: its own, and its commonest
conversion, which has lost bones; and clips of the latter as exponential maps.

Training needs complete bodies, so the tables place the joints that a file lacks within a bone that is there, at the
height the rest skeleton has them. Figures in comments are centimetres above the hips, where the rest skeleton has
pelvis 7.5, spine1 18.5, spine2 31.5, spine3 37.5, collar 48.5, shoulder 51.5, neck 57.5, head 68.5.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.rigs import UNITS, Rig, collar, skeleton
from steadypose.prior.mocap.clip import forward
from steadypose.prior.npz import open_npz

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
    lost_bones={"Neck": 1.0, "LeftShoulder": 1.0, "RightShoulder": 1.0, "LeftFingerBase": 0.5, "RightFingerBase": 0.5},
)


def read_expmap(file: IO[bytes]) -> Iterator[tuple[float, str, float, NDArray[np.float64]]]:
    """CMU clips as root translations and exponential maps (``cmu_expmap.npz``).

    The archive's own positions are passed over: its offsets are those of the BVH conversion that has lost the
    thorax and a third of the forearm, which are put back here.

    Yields:
        for each clip: which share of them is read, its name, frames a second, and (T, J, 3) metres, y up, for the
        joints of the rig ``cmu_bvh``.
    """
    with open_npz(file, "names", "parents", "offsets_m", "fps") as archive:
        joints = [str(n).replace("HeadEnd", "Head_end") for n in archive["names"]]
        parents = [int(p) for p in archive["parents"]]
        offsets, fps = archive["offsets_m"].copy(), float(archive["fps"])
        for joint, multiple in CMU_BVH.lost_bones.items():
            offsets[joints.index(joint)] = multiple * offsets[parents[joints.index(joint)]]
        wanted = [joints.index(j) for j in CMU_BVH.skeleton.joints]
        names = [n.removesuffix("/expmap") for n in archive.files if n.endswith("/expmap")]
        for done, name in enumerate(names, start=1):
            values = archive[f"{name}/expmap"].astype(np.float64)
            maps = values[:, 3:].reshape(-1, 3)
            # The file's convention is row vectors; the transpose serves columns.
            local = Rotation.from_rotvec(maps).inv().as_matrix().reshape(len(values), len(joints), 3, 3)
            steps = np.tile(offsets, (len(values), 1, 1))
            steps[:, 0] = values[:, :3] * UNITS["CMU"]
            yield done / len(names), name, fps, forward(parents, steps, local)[0][:, wanted]
