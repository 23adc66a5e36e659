from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.helpers.bvh_writer import Joint, write_bvh

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.rigs import UNITS, Tree, mirror_names, recognise, recognise_points, up_axis
from steadypose.prior.body.skeleton import JOINTS, PARENTS, REST_POSITIONS, J
from steadypose.prior.mocap.bvh import read_bvh
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import Description, describe, file_rig, read_motion

HIPS_HEIGHT = 0.90
"""Metres above the ground, of the body that all families are given."""

# Metres, x left, y up, z forward, from the middle of the hips.
LEG = {"hip": (0.09, 0.0, 0.0), "knee": (0.09, -0.42, 0.01), "ankle": (0.09, -0.83, -0.01), "toe": (0.1, -0.88, 0.12)}
ARM = {
    "collar": (0.04, 0.49, 0.0), "shoulder": (0.18, 0.515, -0.02), "elbow": (0.46, 0.515, -0.02),
    "wrist": (0.71, 0.515, -0.01),
}  # fmt: skip


@dataclass(frozen=True)
class Family:
    """How a program names and cuts a body.

    Attributes:
        middle: names of the middle, from the root upwards, with their heights (cm) above the hips.
        legs_on, arms_on: which of these carry the limbs.
        leg: names of hip, knee, ankle and toe, ``{}`` for the side; where the last is missing there is an end site.
        arm: names of collar, shoulder, elbow and wrist.
        sides: what the left and the right are called.
    """

    middle: str
    legs_on: str
    arms_on: str
    leg: str
    arm: str
    sides: str = "Left Right"
    unit: float = 0.01
    up: str = "y"

    @property
    def heights(self) -> dict[str, float]:
        """Of the middle, metres above the hips."""
        parts = (part.rpartition(":") for part in self.middle.split())
        return {name: float(height) / 100 for name, _, height in parts}

    def joints(self) -> list[Joint]:
        """In the file's unit and axes, parents first."""
        names = [None, *self.heights]
        joints = [
            Joint(name, above, self._placed((0.0, height, 0.0)))
            for above, (name, height) in zip(names, self.heights.items(), strict=False)
        ]
        for side, sign in zip(self.sides.split(), (1, -1), strict=True):
            for trunk, limb, points in (
                (self.legs_on, self.leg.split(), LEG), (self.arms_on, self.arm.split(), ARM)
            ):  # fmt: skip
                parent = trunk
                for name, (x, y, z) in zip(limb, points.values(), strict=False):
                    joints.append(Joint(name.format(side), parent, self._placed((sign * x, y, z))))
                    parent = joints[-1].name
                if len(limb) < len(points):
                    x, y, z = points["toe"]
                    joints[-1] = replace(joints[-1], end=self._placed((sign * x, y, z)))
        return joints

    def _placed(self, point: tuple[float, float, float]) -> NDArray[np.float64]:
        x, y, z = point
        return np.array([x, y, z] if self.up == "y" else [x, -z, y]) / self.unit


USUAL_LEG, USUAL_ARM = "{}UpLeg {}Leg {}Foot {}ToeBase", "{}Shoulder {}Arm {}ForeArm {}Hand"
FAMILIES = {
    "Mixamo": Family(
        "mixamorig:Hips:5 mixamorig:Spine:15 mixamorig:Spine1:27 "
        "mixamorig:Spine2:40 mixamorig:Neck:56 mixamorig:Head:66 mixamorig:HeadTop_End:85",
        "mixamorig:Hips", "mixamorig:Spine2",
        "mixamorig:{}UpLeg mixamorig:{}Leg mixamorig:{}Foot mixamorig:{}ToeBase",
        "mixamorig:{}Shoulder mixamorig:{}Arm mixamorig:{}ForeArm mixamorig:{}Hand",
    ),
    "LAFAN1": Family(
        "Hips:1 Spine:8 Spine1:20 Spine2:32 Neck:58 Head:69",
        "Hips", "Spine2", "{}UpLeg {}Leg {}Foot {}Toe", USUAL_ARM,
    ),
    "DanceDB": Family(
        "Hips:2 Spine:9 Spine1:16 Spine2:28 Spine3:43 Spine4:54 Neck:58 Head:66",
        "Hips", "Spine4", USUAL_LEG, USUAL_ARM,
    ),
    "Xsens": Family(
        "Hips:9 Chest:18 Chest2:28 Chest3:38 Chest4:48 Neck:58 Head:67",
        "Hips", "Chest4", "{}Hip {}Knee {}Ankle {}Toe", "{}Collar {}Shoulder {}Elbow {}Wrist",
    ),
    "Rokoko": Family(
        "Hips:4 Spine1:14 Spine2:24 Spine3:34 Spine4:45 Neck:56 Head:66",
        "Hips", "Spine4", "{}Thigh {}Shin {}Foot {}Toe", USUAL_ARM,
    ),
    "OptiTrack": Family(
        "Hip:8 Ab:16 Chest:36 Neck:57 Head:68",
        "Hip", "Chest", "{}Thigh {}Shin {}Foot {}Toe", "{}Shoulder {}UArm {}FArm {}Hand", sides="L R", unit=1.0,
    ),
    "Perception Neuron": Family(
        "Hips:6 Spine:16 Spine1:27 Spine2:42 Neck:57 Neck1:62 Head:67",
        "Hips", "Spine2", "{}UpLeg {}Leg {}Foot", USUAL_ARM,
    ),
    "SOMA": Family(
        "Root:8 Hips:8 Spine1:18 Spine2:28 Chest:38 Neck1:56 Neck2:61 Head:67 HeadEnd:85",
        "Hips", "Chest", "{}Leg {}Shin {}Foot {}ToeBase", USUAL_ARM,
    ),
    "Bandai": Family(
        "joint_Root:2 Hips:2 Spine:20 Chest:32 Neck:56 Head:66",
        "Hips", "Chest", "UpperLeg_{} LowerLeg_{} Foot_{} Toes_{}", "Shoulder_{} UpperArm_{} LowerArm_{} Hand_{}",
        sides="L R",
    ),
    "ReActIdle (Blender)": Family(
        "pelvis:2 spine.001:24 neck:52 face:70",
        "pelvis", "spine.001", "thigh.{} shin.{} foot.{}", "shoulder.{} upper_arm.{} forearm.{} hand.{}", sides="L R",
        unit=1.0, up="z",
    ),
    "DAZ": Family(
        "hip:-2.6 abdomen:18 chest:31 neck:57 head:66",
        "hip", "chest", "{}Thigh {}Shin {}Foot", "{}Collar {}Shldr {}ForeArm {}Hand", sides="l r",
    ),
    "iClone": Family(
        "CC_Base_Hip:2 CC_Base_Waist:10 CC_Base_Spine01:15 CC_Base_Spine02:30 CC_Base_NeckTwist01:57 CC_Base_Head:66",
        "CC_Base_Hip", "CC_Base_Spine02", "CC_Base_{}_Thigh CC_Base_{}_Calf CC_Base_{}_Foot CC_Base_{}_ToeBase",
        "CC_Base_{}_Clavicle CC_Base_{}_Upperarm CC_Base_{}_Forearm CC_Base_{}_Hand", sides="L R",
    ),
    "Unreal": Family(
        "pelvis:8 spine_01:18 spine_02:30 spine_03:42 neck_01:57 head:67",
        "pelvis", "spine_03", "thigh_{} calf_{} foot_{} ball_{}", "clavicle_{} upperarm_{} lowerarm_{} hand_{}",
        sides="l r", up="z",
    ),
    "mocopi": Family(
        "root:4 torso_1:11 torso_2:18 torso_3:25 torso_4:32 "
        "torso_5:39 torso_6:46 torso_7:53 neck_1:57 neck_2:61 head:66",
        "root", "torso_7", "{}_up_leg {}_low_leg {}_foot {}_toes", "{}_shoulder {}_up_arm {}_low_arm {}_hand",
        sides="l r",
    ),
}  # fmt: skip


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES.keys())
def test_a_family_is_read_without_a_word(family: Family) -> None:
    root = np.array([0.5, HIPS_HEIGHT, -1.0])
    fps, body = read_motion("take.bvh", write_bvh(family.joints(), family._placed(tuple(root)), 50.0))
    assert fps == pytest.approx(50.0, rel=1e-4)
    found = body[-1] - body[-1, [J["left_hip"], J["right_hip"]]].mean(axis=0)
    # z up, left +x, facing -y.
    for part, (x, y, z) in (LEG | ARM).items():
        name = "foot" if part == "toe" else part
        for side, sign in (("left", 1), ("right", -1)):
            off = np.linalg.norm(found[J[f"{side}_{name}"]] - [sign * x, -z, y])
            # Collars are mixtures of their neighbours, wherever a rig has its own.
            assert off < (0.06 if part == "collar" else 1e-3), f"{side} {part}"
    middle = ["pelvis", "spine1", "spine2", "spine3", "neck", "head"]
    heights = found[[J[name] for name in middle], 2]
    rest = REST_POSITIONS[:, 2] - REST_POSITIONS[J["left_hip"], 2]
    np.testing.assert_allclose(heights, rest[[J[name] for name in middle]], atol=0.045)
    assert (np.diff(heights) > 0).all()
    # In the world, too: on its feet, where the file has it.
    assert body[-1, J["left_hip"], 2] == pytest.approx(HIPS_HEIGHT - next(iter(family.heights.values())), abs=1e-3)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES.keys())
def test_joints_that_a_rig_places_by_its_proportions_count_as_exact(family: Family) -> None:
    bvh = read_bvh(write_bvh(family.joints(), family._placed((0.0, HIPS_HEIGHT, 0.0)), 50.0).decode())
    rig = file_rig(bvh.joints, bvh.parents, bvh.offsets, Description())
    assert not rig.skeleton.sigma.any(), "a noise-free file stays what it is"


def test_of_points_a_pelvis_and_a_neck_between_others_do_not() -> None:
    names = [f"{side}{part}" for side in "LR" for part in ("Hip", "Shoulder", "Knee", "Ear")]
    assert [JOINTS[j] for j in np.flatnonzero(recognise_points(names).sigma)] == ["pelvis", "neck"]
    assert [JOINTS[j] for j in np.flatnonzero(recognise_points([*names, "Neck"]).sigma)] == ["pelvis"]


def test_cmus_conversion_is_read_with_the_bones_that_it_lost() -> None:
    """It has no thorax (14 cm here), so neck and arms hang too low; and a hand bone without the wrist's third."""
    middle = {"Hips": 0.06, "LowerBack": 0.06, "Spine": 0.16, "Spine1": 0.30, "Neck": 0.30, "Neck1": 0.39, "Head": 0.48}
    heights = list(middle.items())
    parts = [(name, heights[k - 1][0] if k else None, (0.0, y, 0.0)) for k, (name, y) in enumerate(heights)]
    for side, sign in (("Left", 1), ("Right", -1)):
        leg = [
            (f"{side}{name}", point)
            for name, point in zip(("UpLeg", "Leg", "Foot", "ToeBase"), LEG.values(), strict=True)
        ]
        arm = [("Shoulder", (0, 0.30, 0)), ("Arm", (0.18, 0.375, 0)), ("ForeArm", (0.46, 0.375, 0))]
        arm += [("Hand", (0.46 + 0.25 / 1.5, 0.375, 0)), ("FingerBase", (0.46 + 0.25 / 1.5, 0.375, 0))]
        for trunk, limb in (("Hips", leg), ("Spine1", [(f"{side}{name}", point) for name, point in arm])):
            parents = [trunk, *(name for name, _ in limb)]
            parts += [(name, parents[k], (sign * x, y, z)) for k, (name, (x, y, z)) in enumerate(limb)]
    unit = UNITS["CMU"]
    joints = [Joint(name, parent, np.array(at) / unit) for name, parent, at in parts]
    joints = [replace(j, end=j.at + np.array([0, 0.18, 0]) / unit) if j.name == "Head" else j for j in joints]
    fps, body = read_motion("02_01.bvh", write_bvh(joints, np.array([0.0, HIPS_HEIGHT, 0.0]) / unit, 120.0))
    assert fps == pytest.approx(120.0, rel=1e-4)
    found = body[-1] - body[-1, [J["left_hip"], J["right_hip"]]].mean(axis=0)
    for part, x, z in (
        ("shoulder", 0.18, 0.515),
        ("elbow", 0.46, 0.515),
        ("wrist", 0.71, 0.515),
        ("knee", 0.09, -0.42),
    ):
        for side, sign in (("left", 1), ("right", -1)):
            np.testing.assert_allclose(found[J[f"{side}_{part}"]][[0, 2]], [sign * x, z], atol=1e-4, err_msg=part)
    np.testing.assert_allclose(found[[J["spine3"], J["neck"], J["head"]], 2], [0.3, 0.53, 0.62 + 0.2 * 0.18], atol=1e-4)


def test_an_npz_of_smpl_x_is_read_without_a_body_model(tmp_path: Path) -> None:
    """Its names, with hands and face in `poses`, and the frame rate under the name that SMPL-X' files give it."""
    poses, trans = np.zeros((4, 165)), np.tile([1.0, 2.0, 0.9], (4, 1))
    poses[:, 0] = np.pi / 2  # from y up to z up
    np.savez(
        tmp_path / "stageii.npz", poses=poses, trans=trans, mocap_frame_rate=np.array(120.0), betas=np.zeros(16),
        gender=np.array("neutral"), surface_model_type=np.array("smplx"),
    )  # fmt: skip
    source = open_recording(tmp_path / "stageii.npz")
    raws = [message for _, message in source if isinstance(message, PoseRaw)]
    assert np.diff([raw.stamp_ns for raw in raws]) == pytest.approx(1e9 / 120, abs=1)
    joints = raws[-1].bodies[0].positions
    np.testing.assert_allclose(joints[0], [1.0, 2.0, 0.9], atol=1e-6)
    assert joints[J["head"], 2] > joints[J["neck"], 2] > 1.2
    assert joints[J["left_foot"], 2] < joints[J["left_knee"], 2] < 0.7


def test_a_body_of_canonical_names_is_taken_as_it_is() -> None:
    joints = [
        Joint(name, None if k == 0 else JOINTS[parent], 100 * REST_POSITIONS[k][[1, 2, 0]])
        for k, (name, parent) in enumerate(zip(JOINTS, PARENTS, strict=True))
    ]
    _, body = read_motion("own.bvh", write_bvh(joints, np.array([0.0, 90.0, 0.0]), 30.0))
    expected = REST_POSITIONS[:, [1, 0, 2]] * [1, -1, 1]
    np.testing.assert_allclose(body[-1] - body[-1, 0], expected, atol=1e-5)


@pytest.mark.parametrize("unit", UNITS.values(), ids=UNITS.keys())
@pytest.mark.parametrize("size", [0.8, 1.0, 1.15])
def test_the_unit_is_told_by_the_size_of_a_person(unit: float, size: float) -> None:
    joints = [replace(j, at=j.at * size) for j in replace(FAMILIES["LAFAN1"], unit=unit).joints()]
    _, body = read_motion("take.bvh", write_bvh(joints, np.zeros(3), 30.0))
    shin = np.linalg.norm(body[0, J["left_knee"]] - body[0, J["left_ankle"]])
    assert shin == pytest.approx(0.41 * size, rel=0.01)


def test_a_body_of_no_size_that_a_person_has_is_not_guessed_at() -> None:
    giant = replace(FAMILIES["LAFAN1"], unit=0.2).joints()
    with pytest.raises(MotionError, match=r"0\.95 to 2\.3 m.*--rig"):
        read_motion("giant.bvh", write_bvh(giant, np.zeros(3), 30.0))
    _, body = read_motion("giant.bvh", write_bvh(giant, np.zeros(3), 30.0), describe({"metres": 0.2}))
    assert np.linalg.norm(body[0, J["left_knee"]] - body[0, J["left_ankle"]]) == pytest.approx(0.41, rel=0.01)


def test_a_body_without_frames_says_so() -> None:
    with pytest.raises(MotionError, match="expected frames after MOTION, got none"):
        read_motion("still.bvh", write_bvh(FAMILIES["LAFAN1"].joints(), np.zeros(3), 30.0, frames=0))


def test_helpers_inside_a_bone_are_looked_through() -> None:
    joints = FAMILIES["Mixamo"].joints()
    knee = next(k for k, joint in enumerate(joints) if joint.name == "mixamorig:LeftLeg")
    for side in ("Left", "Right"):
        hip, knee = (next(j for j in joints if j.name == f"mixamorig:{side}{n}") for n in ("UpLeg", "Leg"))
        twist = Joint(f"mixamorig:{side}UpLegTwist", hip.name, (hip.at + knee.at) / 2)
        joints[joints.index(knee)] = replace(knee, parent=twist.name)
        joints.insert(joints.index(hip) + 1, twist)
    tree = as_tree(joints)
    table = recognise(tree).skeleton.table
    assert (table["left_hip"], table["right_knee"]) == ({"mixamorig:LeftUpLeg": 1.0}, {"mixamorig:RightLeg": 1.0})


def as_tree(joints: Sequence[Joint]) -> Tree:
    names = [joint.name for joint in joints]
    at = np.array([joint.at for joint in joints])
    parents = [names.index(joint.parent) if joint.parent else -1 for joint in joints]
    return Tree(names, parents, at - np.where(np.array(parents)[:, None] < 0, 0, at[parents]))


def test_what_is_no_body_is_refused_in_words() -> None:
    snake = [Joint(f"bone{k}", f"bone{k - 1}" if k else None, np.array([0.0, 10.0 * k, 0.0])) for k in range(12)]
    with pytest.raises(MotionError, match="legs and arms"):
        recognise(as_tree(snake))
    headless = [j for j in FAMILIES["LAFAN1"].joints() if j.name not in ("Neck", "Head")]
    with pytest.raises(MotionError, match="neck and head above 'Spine2'"):
        recognise(as_tree(headless))
    hips = {"LeftUpLeg": "HipA", "RightUpLeg": "HipB"}
    one = FAMILIES["LAFAN1"].joints()
    sideless = [replace(j, name=hips.get(j.name, j.name), parent=hips.get(j.parent or "", j.parent)) for j in one]
    with pytest.raises(
        MotionError, match=r"expected hips.*'LeftLeg', the first of a leg, lies where a knee does: rename the hips"
    ):
        recognise(as_tree(sideless))
    other = [replace(j, name=f"B{j.name}", parent=j.parent and f"B{j.parent}") for j in one]
    with pytest.raises(MotionError, match="one body, got limbs below the roots Hips and BHips: export each"):
        recognise(as_tree([*one, *other]))


def renamed(**names: str) -> list[Joint]:
    """LAFAN1's joints, some by other names."""
    joints = FAMILIES["LAFAN1"].joints()
    return [replace(j, name=names.get(j.name, j.name), parent=names.get(j.parent or "", j.parent)) for j in joints]


def test_a_limb_that_is_named_on_one_side_alone_or_twice_is_not_taken_for_another() -> None:
    for old, new in (("RightForeArm", "RightForearm"), ("RightLeg", "RightShin")):
        with pytest.raises(
            MotionError, match=rf"'{old.replace('Right', 'Left')}' has no counterpart, or there are two"
        ):
            recognise(as_tree(renamed(**{old: new})))
    content = write_bvh(FAMILIES["LAFAN1"].joints(), np.zeros(3), 30.0)
    for side in (b"Left", b"Right"):
        content = content.replace(b"JOINT " + side + b"ForeArm", b"JOINT " + side + b"Arm")
    with pytest.raises(MotionError, match="'LeftArm' has no counterpart, or there are two"):
        read_motion("twice.bvh", content)
    table = recognise(as_tree(renamed(RightToe="RightToes"))).skeleton.table
    assert not {"left_foot", "right_foot"} & table.keys()


def test_an_offset_that_the_roots_channels_contain_too_does_not_lift_the_body() -> None:
    content = write_bvh(FAMILIES["LAFAN1"].joints(), np.array([50.0, 90.0, -100.0]), 30.0)
    doubled = content.replace(b"OFFSET 0.000000 0.000000 0.000000", b"OFFSET 50 90 -100", 1)
    moved = content.replace(b"OFFSET 0.000000 0.000000 0.000000", b"OFFSET 0 85 0", 1).replace(b" 90.0", b" 5.0")
    for same in (doubled, moved):
        assert same != content
        np.testing.assert_allclose(read_motion("x.bvh", same)[1], read_motion("x.bvh", content)[1], atol=1e-9)


def test_sides_are_told_by_names_that_stay_names() -> None:
    names = ["LowerBack", "L_Arm", "R_Arm", "lowerleg.l", "lowerleg.r", "ball", "Left", "Right"]
    assert mirror_names(names) == {"L_Arm": "R_Arm", "lowerleg.l": "lowerleg.r", "Left": "Right"}


@pytest.mark.parametrize(("axis", "turn"), [("z", [0, 1, 2]), ("y", [0, 2, 1])])
def test_up_is_from_ankles_to_head(axis: str, turn: list[int]) -> None:
    assert up_axis(REST_POSITIONS[None][..., turn]) == axis
    assert up_axis(-REST_POSITIONS[None][..., [0, 2, 1]]) == "-y"
    headless = REST_POSITIONS[None][..., turn].copy()
    headless[:, J["head"]] = np.nan
    assert up_axis(headless) == axis


def test_a_bvh_may_begin_with_a_mark_of_utf_8_and_its_names_contain_spaces() -> None:
    content = write_bvh(FAMILIES["LAFAN1"].joints(), np.array([0.0, 90.0, 0.0]), 30.0)
    other = b"\xef\xbb\xbf" + content.replace(b"Frame Time:", b"Frame time:")
    for name in (b"Leg", b"Foot", b"Arm"):
        for side in (b"Left", b"Right"):
            other = other.replace(b"JOINT " + side + name, b"JOINT " + side + b" lower " + name + b"  ")
    assert other.count(b" lower ") == 6
    assert read_motion("take.bvh", other).fps == read_motion("take.bvh", content).fps
    for same in (other, content.decode().encode("utf-16")):
        np.testing.assert_array_equal(read_motion("x.bvh", same).positions, read_motion("x.bvh", content).positions)


def test_a_description_says_what_a_file_does_not() -> None:
    snake = FAMILIES["LAFAN1"].joints()
    renamed = [replace(j, name=f"b{k}", parent=f"b{[i.name for i in snake].index(j.parent)}" if j.parent else None)
               for k, j in enumerate(snake)]  # fmt: skip
    content = write_bvh(renamed, np.array([0.0, 90.0, 0.0]), 30.0)
    with pytest.raises(MotionError, match="--rig"):
        read_motion("take.bvh", content)
    of = {old.name: new.name for old, new in zip(snake, renamed, strict=True)}
    table = {
        "left_hip": of["LeftUpLeg"], "right_hip": of["RightUpLeg"], "left_shoulder": of["LeftArm"],
        "right_shoulder": of["RightArm"], "neck": [of["LeftArm"], of["RightArm"]], "head": of["Head"],
    }  # fmt: skip
    _, body = read_motion("take.bvh", content, describe({"canonical": table, "metres": 0.01, "up": "y"}))
    assert body[0, J["left_hip"], 2] == pytest.approx(0.89, abs=1e-3)
    assert body[0, J["neck"], 0] == pytest.approx(0.0, abs=1e-6)
    assert np.isnan(body[0, J["left_knee"]]).all()
    with pytest.raises(MotionError, match="no b99"):
        read_motion("take.bvh", content, Description(canonical={"head": "b99"}, metres=0.01))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"unit": 1}, "unit"),
        ({"up": "x"}, "up"),
        ({"canonical": {"nose": "b"}}, "nose"),
        ({"metres": "cm"}, "metres"),
        ({"metres": -1.0}, "metres and fps above 0, got -1"),
    ],
)
def test_a_description_that_says_something_else_is_refused(table: dict[str, object], said: str) -> None:
    with pytest.raises(MotionError, match=said):
        describe(table)
