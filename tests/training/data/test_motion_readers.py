import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.motion_files import AMC, ASF, bvh_text, npz

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J
from steadypose.prior.mocap.bvh import CMU_BVH, read_bvh
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import read_motion
from steadypose.training.data.cmu import read_amc, read_asf, read_expmap


def turn(axes: str, *degrees: float) -> np.ndarray:
    """Turns about coordinate axes, multiplied in this order."""
    found = np.eye(3)
    for axis, angle in zip(axes, degrees, strict=True):
        found = found @ Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    return found


angles = st.lists(st.floats(-180, 180, width=32), min_size=6, max_size=6)
shifts = st.lists(st.floats(-5, 5, width=32), min_size=6, max_size=6)


@given(order=st.permutations("xyz"), frames=st.lists(st.tuples(shifts, angles), min_size=1, max_size=3))
def test_a_bvh_is_turned_joint_by_joint(order: list[str], frames: list[tuple[list[float], list[float]]]) -> None:
    rows = [s[:3] + a[:3] + s[3:] + a[3:] for s, a in frames]
    bvh = read_bvh(bvh_text("".join(order).upper(), rows))
    assert bvh.joints == ("hip", "arm", "arm_end", "arm_end2")
    assert bvh.fps == pytest.approx(25)
    for (shift, angle), got in zip(frames, bvh.positions(), strict=True):
        root = turn("".join(order), *angle[:3])
        arm = root @ turn("yxz", *angle[3:])
        hip_at = np.array([1, 2, 3]) + shift[:3]  # at a root, added to the offset
        arm_at = hip_at + root @ [shift[4], shift[5], shift[3]]  # elsewhere, in the offset's place
        expected = [hip_at, arm_at, arm_at + arm @ [0.3, 0, 0], arm_at + arm @ [0, 0, 0.2]]
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_a_long_bvh_takes_no_more_memory_than_a_few_copies_of_its_text_and_of_its_positions() -> None:
    text = bvh_text(frames=[[float(k % 90)] * 12 for k in range(4000)])
    tracemalloc.start()
    bvh = read_bvh(text)
    read = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    positions = bvh.positions()
    computed = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert read < 7 * len(text)  # of all words at once: 9.8
    assert computed < 2 * (bvh.values.nbytes + 2 * positions.nbytes)  # of all rotations at once: 3.3


def test_motion_within_a_name_does_not_begin_the_motion() -> None:
    assert read_bvh(bvh_text().replace("ROOT hip", "ROOT ROOT_MOTION")).joints[0] == "ROOT_MOTION"


@pytest.mark.parametrize("written", [
    bvh_text().lower(),
    bvh_text().upper(),
    bvh_text().replace("End Site", "End Site Tip"),
    bvh_text().replace("Frames: ", "Frames:").replace("Time: ", "Time:"),
    bvh_text().replace("\nMOTION", " MOTION"),
])  # fmt: skip
def test_keywords_are_read_however_a_program_writes_them(written: str) -> None:
    bvh, expected = read_bvh(written), read_bvh(bvh_text())
    assert [joint.lower() for joint in bvh.joints] == list(expected.joints)
    np.testing.assert_array_equal(bvh.positions(), expected.positions())


def test_a_frame_time_that_is_none_is_refused() -> None:
    with pytest.raises(MotionError, match="expected a frame time above zero, found inf"):
        read_bvh(re.sub("Frame Time: .*", "Frame Time: inf", bvh_text()))


def test_decimal_commas_are_named() -> None:
    for text in (bvh_text().replace("0.3", "0,3"), bvh_text(frames=[[0.5] * 12]).replace("0.5", "0,5")):
        with pytest.raises(MotionError, match=r"cannot be read: .*; write decimal points, not commas"):
            read_bvh(text)


def test_a_bone_that_the_converter_lost_is_put_back_only_where_it_is_lost() -> None:
    bvh = read_bvh(bvh_text().replace("OFFSET 0.3 0 0", "OFFSET 0 0 0"))
    # The arm's own offset is along y: twice as long for one end, untouched for the other.
    mended = bvh.positions({"arm_end": 2.0, "arm_end2": 9.0})[0]
    np.testing.assert_allclose(mended[2:] - mended[1], [[0, 1.0, 0], [0, 0, 0.2]], atol=1e-9)


def test_an_amc_turns_each_bone_about_its_near_end_in_its_own_axes() -> None:
    skeleton = read_asf(ASF.replace("\n", "\r\n"))
    assert skeleton.joints == ("root", "femur", "tibia", "foot")
    positions, unit = read_amc(AMC.replace("\n", "\r\n"), skeleton), 0.0254 / 0.45
    frames = [((1, 2, 3), (10, 20, 30), (-5, 15, 25), 40), ((1, 2, 4), (0, 0, 90), (0, 0, 0), 0)]
    for got, (at, root, femur, tibia) in zip(positions, frames, strict=True):
        world = turn("zyx", *root[::-1])
        place = np.array(at) * unit
        expected = [place]
        for direction, length, axis, turned in (
            ((0, -1, 0), 7, (0, 0, 20), femur),
            ((0.6, -0.8, 0), 8, (10, 20, 30), (tibia, 0, 0)),
            ((0, 0, 1), 2, (0, 0, 0), (0, 0, 0)),
        ):
            frame = turn("zyx", *axis[::-1])
            world = world @ frame @ turn("zyx", *turned[::-1]) @ frame.T
            place = place + world @ np.array(direction) * length * unit
            expected.append(place)
        np.testing.assert_allclose(got, expected, atol=1e-9)


# Enough of CMU's tree to reach every joint that the rig wants: name, parent, offset in metres.
TREE = [
    ("Hips", -1, (0, 0, 0)), ("Spine", 0, (0, 0.1, 0)), ("Spine1", 1, (0, 0.12, 0)),
    ("Neck", 2, (0, 0, 0)), ("Neck1", 3, (0, 0.08, 0)), ("Head", 4, (0, 0.08, 0)), ("HeadEnd", 5, (0, 0.1, 0)),
]  # fmt: skip
for side, left in (("Left", 1), ("Right", -1)):
    hip, chest = len(TREE), len(TREE) + 4
    TREE += [
        (f"{side}UpLeg", 0, (0.1 * left, -0.1, 0)), (f"{side}Leg", hip, (0, -0.4, 0)),
        (f"{side}Foot", hip + 1, (0, -0.4, 0)), (f"{side}ToeBase", hip + 2, (0, 0, 0.1)),
        (f"{side}Shoulder", 2, (0, 0, 0)), (f"{side}Arm", chest, (0.2 * left, 0.05, 0)),
        (f"{side}ForeArm", chest + 1, (0.3 * left, 0, 0)), (f"{side}Hand", chest + 2, (0.2 * left, 0, 0)),
        (f"{side}FingerBase", chest + 3, (0, 0, 0)),
    ]  # fmt: skip


def test_exponential_maps_turn_row_vectors_and_lost_bones_return() -> None:
    names, parents, offsets = zip(*TREE, strict=True)
    values = np.zeros((2, 3 + 3 * len(TREE)))
    values[:, :3] = [[1, 2, 3], [4, 5, 6]]
    values[1, 3:6] = [0, 0, np.pi / 2]  # the hips
    arm = 3 + 3 * names.index("LeftArm")
    values[1, arm : arm + 3] = [0, np.pi / 2, 0]
    archive = npz(
        **{"walk_1/expmap": values.astype(np.float32)}, names=np.array(names), parents=np.array(parents),
        offsets_m=np.array(offsets, dtype=float), fps=30.0,
    )  # fmt: skip
    [(share, name, fps, positions)] = list(read_expmap(archive))
    assert (share, name, fps) == (1.0, "walk_1", 30.0)
    at = {joint: positions[:, i] for i, joint in enumerate(CMU_BVH.skeleton.joints)}

    np.testing.assert_allclose(at["Hips"], np.array([[1, 2, 3], [4, 5, 6]]) * CMU_BVH.metres, atol=1e-6)
    # Neck1 stands on Spine1 by the thorax, as long as Spine1's own bone, and the neck.
    np.testing.assert_allclose(at["Neck1"][0] - at["Spine1"][0], [0, 0.12 + 0.08, 0], atol=1e-6)
    # The forearm is half as long again as the file has it.
    np.testing.assert_allclose(at["LeftFingerBase"][0] - at["LeftForeArm"][0], [0.3, 0, 0], atol=1e-6)
    # p_child = p_parent + offset · G_parent, G_child = R · G_parent, with rows.
    np.testing.assert_allclose(at["Spine"][1] - at["Hips"][1], [0, 0.1, 0] @ turn("z", 90), atol=1e-6)
    bent = np.array([0.3, 0, 0]) @ turn("yz", 90, 90)
    np.testing.assert_allclose(at["LeftForeArm"][1] - at["LeftArm"][1], bent, atol=1e-6)


def test_amass_rest_pose_stands_upright_facing_where_it_is_turned() -> None:
    poses = np.zeros((3, 156))
    # AMASS' root turns SMPL's y-up, z-forward rest pose into a z-up world.
    poses[:, :3] = [np.pi / 2, 0, 0]
    poses[2, 3 * J["left_knee"] : 3 * J["left_knee"] + 3] = [np.pi / 2, 0, 0]
    trans = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], dtype=float)
    fps, positions = read_motion("a.npz", npz(poses=poses, trans=trans, mocap_framerate=120.0).getvalue())
    assert fps == 120
    # Facing -y: forward of the rest skeleton to -y, its left to +x.
    bones = positions[:2, 1:] - positions[:2, list(PARENTS[1:])]
    np.testing.assert_allclose(bones, np.tile(REST_OFFSETS[1:] @ yaw_matrix(-np.pi / 2).T, (2, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(positions[:, 0], trans, atol=1e-9)
    # A bent knee takes the ankle behind, away from where the toes point.
    assert positions[2, J["left_ankle"], 1] - positions[2, J["left_knee"], 1] > 0.4
