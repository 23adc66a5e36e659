from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, world_body

from steadypose.msgs.types import WorldBody
from steadypose.nodes.sinks.ros2.rep155 import JOINTS, body_name, frames, joint_angles, measures, urdf
from steadypose.prior.body.skeleton import REST_OFFSETS, J


def body(turns: dict[str, Rotation], root: Rotation | None = None) -> WorldBody:
    """A body on the generic bones, with these local rotations."""
    local = Rotation.concatenate([turns.get(name, Rotation.identity()) for name in J])
    local = Rotation.concatenate([(root or Rotation.identity()) * local[0], local[1:]])
    return world_body(fk(local.as_matrix()), local.as_quat(), id=3)


def forward(description: str, angles: dict[str, float], suffix: str) -> dict[str, np.ndarray]:
    """(4, 4) poses of a URDF's links in the frame of its root, by the textbook."""
    robot = ElementTree.fromstring(description)

    def told(joint: ElementTree.Element, part: str, key: str) -> str:
        return next(joint.iter(part)).attrib[key]

    poses = {f"body_{suffix}": np.eye(4)}
    for joint in robot.iter("joint"):  # which comes after the one it hangs from
        here = np.eye(4)
        here[:3, 3] = [float(x) for x in told(joint, "origin", "xyz").split()]
        if joint.get("type") == "revolute":
            axis = np.array([float(x) for x in told(joint, "axis", "xyz").split()])
            angle = angles[joint.attrib["name"].removesuffix(f"_{suffix}")]
            here[:3, :3] = Rotation.from_rotvec(axis * angle).as_matrix()
        poses[told(joint, "child", "link")] = poses[told(joint, "parent", "link")] @ here
    return poses


def about(axis: str, angle: float) -> Rotation:
    return Rotation.from_euler(axis, angle)


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000))
def test_what_the_model_can_say_comes_back(seed: int) -> None:
    """A body that bends only where REP-155's does: its links are where angles and URDF put them."""
    rng = np.random.default_rng(seed)
    bend = rng.uniform(0.1, 2.2, 4)
    stoops = rng.choice([0.0, rng.uniform(-0.2, 1.0)])
    turns = {
        "spine3": about("y", stoops),
        "head": Rotation.from_euler("XZY", rng.uniform(-0.9, 0.9, 3)),
        "left_shoulder": Rotation.random(rng=rng),
        "right_shoulder": Rotation.random(rng=rng),
        # in the T of the canonical skeleton, an arm's hinge is upright
        "left_elbow": about("z", -bend[0]),
        "right_elbow": about("z", bend[1]),
        "left_hip": Rotation.from_euler("ZXY", rng.uniform(-1.2, 1.2, 3)),
        "right_hip": Rotation.from_euler("ZXY", rng.uniform(-1.2, 1.2, 3)),
        "left_knee": about("y", bend[2]),
        "right_knee": about("y", bend[3]),
    }
    bent = body(turns, root=Rotation.random(rng=rng))
    links = frames(bent)
    angles = joint_angles(links)
    assert tuple(angles) == JOINTS
    assert angles["l_elbow"] == pytest.approx(bend[0]), "elbows bend forwards,"
    assert angles["r_elbow"] == pytest.approx(bend[1])
    assert angles["l_knee"] == pytest.approx(-bend[2]), "knees backwards"
    origin, heading = links["body"]
    found = forward(urdf("b3", measures(bent)), angles, "b3")
    for name, (position, turned) in links.items():
        if name in ("head", "l_foot", "r_foot"):
            continue  # a head on a neck that bends, and feet, are not in that model
        pose = found[f"{name}_b3"]
        np.testing.assert_allclose(pose[:3, :3], heading.T @ turned, atol=1e-6, err_msg=name)
        if stoops and not name.endswith(("body", "waist", "hip", "knee", "ankle")):
            continue  # people bend higher up than at the pelvis: shoulders and arms of who stoops are elsewhere
        np.testing.assert_allclose(pose[:3, 3], heading.T @ (position - origin), atol=2e-3, err_msg=name)
    np.testing.assert_allclose(found["head_b3"][:3, :3], heading.T @ links["head"][1], atol=1e-6)


def test_measures_are_the_persons_whatever_the_pose() -> None:
    rng = np.random.default_rng(0)
    still = measures(body({}))
    for _ in range(5):
        moved = measures(body({name: Rotation.random(rng=rng) for name in J}))
        for link, place in still.items():
            np.testing.assert_allclose(moved[link], place, atol=1e-6, err_msg=link)
    assert still["l_elbow"][2] == pytest.approx(-np.linalg.norm(REST_OFFSETS[J["left_elbow"]]))


def test_standing_with_hanging_arms_is_zero() -> None:
    arms = {"left_shoulder": about("x", -np.pi / 2), "right_shoulder": about("x", np.pi / 2)}
    links = frames(body(arms))
    np.testing.assert_allclose(list(joint_angles(links).values()), 0.0, atol=1e-7)
    for name, (_, turned) in links.items():
        np.testing.assert_allclose(turned, np.eye(3), atol=1e-7, err_msg=name)


@pytest.mark.parametrize(
    ("number", "source", "name"),
    [
        (0, "", "b0"),
        (17, "", "b11"),
        (-1, "", "bffffffff"),
        (2**31 - 1, "", "b7fffffff"),
        (0, "front door__2/", "b0_front_door_2"),
        (0, "左", "b0_u5de6"),
    ],
)
def test_names_that_ros_takes(number: int, source: str, name: str) -> None:
    assert body_name(number, source) == name
