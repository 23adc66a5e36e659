"""Arrays: the row-vector convention of the exponential maps, and SMPL's axes."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from tests.training.data.test_motion_bvh import turn

from steadypose.prior.body.skeleton import JOINTS, REST_OFFSETS, J
from steadypose.prior.mocap.bvh import CMU_BVH
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import read_amass
from steadypose.training.data.cmu import read_expmap

# Enough of CMU's tree to reach every joint that the rig wants: name, parent, offset in metres.
TREE = [
    ("Hips", -1, (0, 0, 0)),
    ("LeftUpLeg", 0, (0.1, -0.1, 0)),
    ("LeftLeg", 1, (0, -0.4, 0)),
    ("LeftFoot", 2, (0, -0.4, 0)),
    ("LeftToeBase", 3, (0, 0, 0.1)),
    ("RightUpLeg", 0, (-0.1, -0.1, 0)),
    ("RightLeg", 5, (0, -0.4, 0)),
    ("RightFoot", 6, (0, -0.4, 0)),
    ("RightToeBase", 7, (0, 0, 0.1)),
    ("Spine", 0, (0, 0.1, 0)),
    ("Spine1", 9, (0, 0.12, 0)),
    ("Neck", 10, (0, 0, 0)),
    ("Neck1", 11, (0, 0.08, 0)),
    ("Head", 12, (0, 0.08, 0)),
    ("HeadEnd", 13, (0, 0.1, 0)),
    ("LeftShoulder", 10, (0, 0, 0)),
    ("LeftArm", 15, (0.2, 0.05, 0)),
    ("LeftForeArm", 16, (0.3, 0, 0)),
    ("LeftHand", 17, (0.2, 0, 0)),
    ("LeftFingerBase", 18, (0, 0, 0)),
    ("RightShoulder", 10, (0, 0, 0)),
    ("RightArm", 20, (-0.2, 0.05, 0)),
    ("RightForeArm", 21, (-0.3, 0, 0)),
    ("RightHand", 22, (-0.2, 0, 0)),
    ("RightFingerBase", 23, (0, 0, 0)),
]


def as_file(**arrays: Any) -> io.BytesIO:
    file = io.BytesIO()
    np.savez(file, **arrays)
    file.seek(0)
    return file


def expmap_file(values: np.ndarray) -> io.BytesIO:
    names, parents, offsets = zip(*TREE, strict=True)
    return as_file(
        **{"walk_1/expmap": values.astype(np.float32)}, names=np.array(names), parents=np.array(parents),
        offsets_m=np.array(offsets, dtype=float), fps=30.0,
    )  # fmt: skip


def test_exponential_maps_turn_row_vectors_and_lost_bones_return() -> None:
    values = np.zeros((2, 3 + 3 * len(TREE)))
    values[:, :3] = [[1, 2, 3], [4, 5, 6]]
    values[1, 3:6] = [0, 0, np.pi / 2]  # the hips
    values[1, 3 + 3 * 16 : 6 + 3 * 16] = [0, np.pi / 2, 0]  # the left arm
    [(share, name, fps, positions)] = list(read_expmap(expmap_file(values)))
    assert (share, name, fps) == (1.0, "walk_1", 30.0)
    at = {joint: positions[:, i] for i, joint in enumerate(CMU_BVH.skeleton.joints)}

    np.testing.assert_allclose(at["Hips"], np.array([[1, 2, 3], [4, 5, 6]]) * CMU_BVH.metres, atol=1e-6)
    # Neck1 stands on Spine1 by the thorax, as long as Spine1's own bone, and the neck.
    np.testing.assert_allclose(at["Neck1"][0] - at["Spine1"][0], [0, 0.12 + 0.08, 0], atol=1e-6)
    # The forearm is half as long again as the file has it.
    np.testing.assert_allclose(at["LeftFingerBase"][0] - at["LeftForeArm"][0], [0.3, 0, 0], atol=1e-6)
    # p_child = p_parent + offset · G_parent, G_child = R · G_parent, with rows.
    hips, arm = turn("Z", 90), turn("Y", 90)
    np.testing.assert_allclose(at["Spine"][1] - at["Hips"][1], np.array([0, 0.1, 0]) @ hips, atol=1e-6)
    np.testing.assert_allclose(at["LeftForeArm"][1] - at["LeftArm"][1], np.array([0.3, 0, 0]) @ (arm @ hips), atol=1e-6)


def test_amass_rest_pose_stands_upright_facing_where_it_is_turned() -> None:
    poses = np.zeros((3, 156))
    # AMASS' root turns SMPL's y-up, z-forward rest pose into a z-up world.
    poses[:, :3] = [np.pi / 2, 0, 0]
    poses[2, 3 * J["left_knee"] : 3 * J["left_knee"] + 3] = [np.pi / 2, 0, 0]
    trans = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], dtype=float)
    fps, positions = read_amass(as_file(poses=poses, trans=trans, mocap_framerate=120.0))
    assert fps == 120
    # Facing -y: forward of the rest skeleton to -y, its left to +x.
    turned = turn("Z", -90)
    for frame in (0, 1):
        bones = (
            positions[frame, 1:]
            - positions[frame, [0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]]
        )
        np.testing.assert_allclose(bones, REST_OFFSETS[1:] @ turned.T, atol=1e-9)
        np.testing.assert_allclose(positions[frame, 0], trans[frame], atol=1e-9)
    # A bent knee takes the ankle behind, away from where the toes point.
    shank = positions[2, JOINTS.index("left_ankle")] - positions[2, JOINTS.index("left_knee")]
    assert shank[1] > 0.4


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"poses": np.zeros((2, 156))}, "expected arrays trans"),
        ({"poses": np.zeros((2, 156)), "trans": np.zeros((2, 3))}, "mocap_framerate"),
        ({"poses": np.zeros((2, 9)), "trans": np.zeros((2, 3)), "mocap_framerate": 30.0}, "66 or more"),
        ({"poses": np.zeros((2, 156)), "trans": np.zeros((3, 3)), "mocap_framerate": 30.0}, "66 or more"),
    ],
)
def test_what_amass_would_not_hold_is_refused_in_words(arrays: dict[str, Any], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        read_amass(as_file(**arrays))
