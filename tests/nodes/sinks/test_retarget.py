import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import first_datagram, record
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose import PACKAGE
from steadypose.msgs.topics import POSE_TRUTH
from steadypose.msgs.types import CONTACTS, Pose, PoseRaw, PoseWorld, RawBody
from steadypose.nodes.cli import main
from steadypose.nodes.graph.launch import Launch, bundled
from steadypose.nodes.settings import LaunchError
from steadypose.prior.sim.streams import make, read_manifest

pytest.importorskip("mink", reason="the extra 'retarget' is not installed")

from steadypose.benchmarks.systems.retarget import faults
from steadypose.nodes.sinks.datagrams import GONE_NS
from steadypose.nodes.sinks.retarget import EASE_S, SIDES, Follower, Retargeter, RetargetNode, RobotPose
from steadypose.nodes.sinks.robot import Robot, load_robot
from steadypose.nodes.sinks.robot_feet import HELD, LAND_S, RELEASE_S, TURNED, Foot
from steadypose.nodes.sinks.robot_solver import ROOT_M_S, ROOT_RAD_S

URDF = PACKAGE / "launch" / "robots" / "humanoid29.urdf"
FRAME_S = 1 / 30


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(URDF, {})


@cache
def worlds(name: str) -> list[PoseWorld]:
    return make(read_manifest(bundled("sim_data", "manifest.json"))[name])[1]


def followed(robot: Robot, stream: list[PoseWorld]) -> tuple[list[RobotPose], NDArray[np.float64]]:
    """The robot's poses, and how far a foot that stands is from where it came to stand, metres."""
    retargeter = Retargeter(robot)
    poses, away, stood = [], [], {}
    for world in stream:
        pose = retargeter.follow(world.stamp_ns, world.bodies[0])
        assert pose is not None
        poses.append(pose)
        for k, side in enumerate(SIDES):
            at = retargeter._solver.frame(f"{side}_foot")[1]
            if not pose.stands[k]:
                stood.pop(side, None)
            else:
                away.append(float(np.linalg.norm(at - stood.setdefault(side, at))))
    return poses, np.array(away)


@pytest.mark.parametrize(
    "name", ["walk_turn", *(pytest.param(it, marks=pytest.mark.slow) for it in ("sit_rise", "wave_hidden_arm"))]
)
def test_limits_hold_in_every_frame_and_feet_that_stand_stay_within_2_cm(robot: Robot, name: str) -> None:
    poses, away = followed(robot, worlds(name)[:240])
    joints = np.array([pose.joints for pose in poses])
    assert (joints >= robot.lower).all()
    assert (joints <= robot.upper).all()
    speeds = np.abs(np.diff(joints, axis=0)) / np.diff([pose.stamp_ns for pose in poses])[:, None] * 1e9
    assert (speeds <= robot.speed * (1 + 1e-6)).all()
    assert len(away) > len(poses)
    assert away.max() < 0.02


@pytest.mark.slow
def test_a_raised_hand_is_raised_and_a_sitting_person_sits(robot: Robot) -> None:
    retargeter = Retargeter(robot)
    raised, lowest = 0.0, 1.0
    for world in worlds("wave_hidden_arm")[:200]:
        retargeter.follow(world.stamp_ns, world.bodies[0])
        wrist, shoulder = (retargeter._solver.frame(f"left_{name}")[1][2] for name in ("wrist", "shoulder"))
        raised = max(raised, wrist - shoulder)
    retargeter.reset()
    for world in worlds("sit_rise")[:300]:
        retargeter.follow(world.stamp_ns, world.bodies[0])
        lowest = min(lowest, float(retargeter._solver.frame("pelvis")[1][2]))
    assert raised > 0.05
    assert lowest < 0.55


def test_a_jump_of_the_estimate_moves_the_root_no_faster_than_a_person_runs(robot: Robot) -> None:
    stream = worlds("idle")[:60]
    for world in stream[50:]:
        body = world.bodies[0]
        turned = body.positions * [-1.0, -1.0, 1.0]  # by half a turn about the middle of the room
        rotations = body.rotations.copy()
        rotations[0] = (Rotation.from_euler("z", np.pi) * Rotation.from_quat(rotations[0])).as_quat()
        world.bodies[0] = replace(body, positions=turned, rotations=rotations)
    worlds.cache_clear()
    roots = np.array([pose.root for pose in followed(robot, stream)[0]])
    assert np.abs(np.diff(roots[:, :3], axis=0)).max() / FRAME_S < 1.01 * ROOT_M_S
    turns = Rotation.from_quat(roots[:-1, 3:]).inv() * Rotation.from_quat(roots[1:, 3:])
    assert np.abs(turns.as_rotvec()).max() / FRAME_S < 1.01 * ROOT_RAD_S


def test_feet_stay_above_the_floor_where_a_jumping_body_sinks(robot: Robot) -> None:
    stream = worlds("idle")[:75]
    for world in stream[45:]:
        body = world.bodies[0]
        low, contacts = body.positions - [0.0, 0.0, 0.4], np.zeros(len(CONTACTS), np.float32)
        world.bodies[0] = replace(body, positions=low, contacts=contacts)
    worlds.cache_clear()
    assert faults(robot, followed(robot, stream)[0])["deep_mm"] < 20.0


def test_it_begins_and_stops_smoothly(robot: Robot) -> None:
    stream = worlds("walk_turn")[60:180]
    last = stream[-1]
    empty = [replace(last, stamp_ns=last.stamp_ns + k * 33_333_333, bodies=[]) for k in range(1, 90)]
    follower = Follower(Retargeter(robot))
    poses = [pose for world in [*stream, *empty] if (pose := follower.process(world))]
    assert len(poses) == len(stream) + len(empty)
    speeds = np.abs(np.diff([pose.joints for pose in poses], axis=0)).max(axis=1) / FRAME_S
    assert speeds[0] < 0.2
    assert speeds[: round(EASE_S / FRAME_S / 4)].max() < 2.0
    stop = speeds[len(stream) - 1 :]
    assert (np.diff(stop) <= 1e-6).all()
    assert stop[-1] < 1e-3


def test_the_next_person_is_followed_when_the_first_has_gone_without_a_jump_of_the_joints(robot: Robot) -> None:
    stream = worlds("crossing")[:160]
    follower, poses, leaves_ns = Follower(Retargeter(robot)), [], stream[60].stamp_ns
    for world in stream:
        gone = leaves_ns <= world.stamp_ns < leaves_ns + GONE_NS
        there = [body for body in world.bodies if not gone and (body.id == 1) == (world.stamp_ns < leaves_ns)]
        poses.append(follower.process(replace(world, bodies=there)))
    joints = np.array([pose.joints for pose in poses if pose])
    assert (np.abs(np.diff(joints, axis=0)) <= robot.speed * FRAME_S * 1.01).all()


def test_on_feet_of_unknown_contact_the_robot_stands(robot: Robot) -> None:
    """Of one foot at a time: it is held in place, although the person walks, and the other is not."""
    for k, side in enumerate(SIDES):
        stream = worlds("walk_turn")[:120]
        for world in stream:
            world.bodies[0].contacts[:] = 0.0
            world.bodies[0].contacts[[CONTACTS.index(f"{side}_{part}") for part in ("ankle", "foot")]] = np.nan
        stands = np.array([pose.stands for pose in followed(robot, stream)[0]])
        assert stands[-60:, k].mean() > 0.5
        assert not stands[:, 1 - k].any()


@pytest.mark.parametrize("name", ["crossing", pytest.param("sit_rise", marks=pytest.mark.slow)])
def test_feet_stand_and_the_root_follows_where_the_person_turns(robot: Robot, name: str) -> None:
    """A foot that stands is not torn off by the other, and a leg is not wound up by a person who turns over it."""
    follower = Follower(Retargeter(robot), 1)
    poses = [pose for world in worlds(name)[:330] if (pose := follower.process(world))]
    assert faults(robot, poses)["foot_mm"] < 15.0
    yaw = [robot.joints.index(f"{side}_hip_yaw_joint") for side in SIDES]
    assert np.abs([pose.joints[yaw] for pose in poses]).max() < 2.0


def test_a_robot_stands_upright_over_an_uncalibrated_sensor_s_floor(robot: Robot) -> None:
    stream = worlds("idle")[:60]
    heights = []
    for down in (0.0, 1.3):
        follower, poses = Follower(Retargeter(robot)), []
        for world in stream:
            body = replace(world.bodies[0], positions=world.bodies[0].positions - [0.0, 0.0, down])
            poses.append(follower.process(replace(world, bodies=[body], ground_plane=np.array([0.0, 0.0, 1.0, down]))))
        assert poses[-1] is not None
        heights.append(poses[-1].root[2])
    assert heights[0] == pytest.approx(heights[1], abs=1e-3)


def test_a_landing_foot_comes_down_flat_and_stays_and_a_lifting_one_leaves_by_degrees() -> None:
    foot, turn, place = Foot(np.eye(3), 0.03), np.eye(3), np.array([0.5, 0.1, 0.08])
    now = Rotation.from_euler("y", 0.3).as_matrix(), np.array([0.48, 0.1, 0.08])
    assert foot.target(turn, place, 0.0, now, FRAME_S).place is place
    first = foot.target(turn, place, 1.0, now, LAND_S / 3)
    assert 0.03 < first.place[2] < 0.08
    held = foot.target(turn, place, 1.0, now, LAND_S)
    np.testing.assert_allclose(held.place, [0.48, 0.1, 0.03])
    np.testing.assert_allclose(held.turn, np.eye(3), atol=1e-12)
    assert held.costs == HELD
    foot.moved(np.array([0.485, 0.1, 0.06]))
    assert not foot.landed
    foot.moved(np.array([0.485, 0.1, 0.035]))
    assert foot.landed
    np.testing.assert_allclose(foot.target(turn, place, 0.5, now, FRAME_S).place, [0.485, 0.1, 0.03])
    leaving = foot.target(turn, place, 0.0, now, RELEASE_S / 2)
    assert not foot.landed
    np.testing.assert_allclose(leaving.place, 0.5 * (np.array([0.485, 0.1, 0.03]) + place))
    assert foot.target(turn, place, 0.0, now, RELEASE_S).place is place


@pytest.mark.parametrize(("moved", "turned"), [(0.35, 0.0), (0.0, 1.1 * TURNED)])
def test_a_foot_steps_where_the_person_s_is_far_or_turned_from_it(moved: float, turned: float) -> None:
    foot, now = Foot(np.eye(3), 0.0), (np.eye(3), np.zeros(3))
    for _ in range(10):
        foot.target(np.eye(3), np.zeros(3), 1.0, now, FRAME_S)
        foot.moved(np.zeros(3))
    assert foot.landed
    foot.target(Rotation.from_euler("z", turned).as_matrix(), np.array([moved, 0.0, 0.0]), 1.0, now, FRAME_S)
    assert not foot.landed


def test_a_pose_that_is_not_known_moves_nothing(robot: Robot) -> None:
    retargeter, (first, second) = Retargeter(robot), worlds("idle")[:2]
    before: Any = retargeter.follow(first.stamp_ns, first.bodies[0])
    positions = second.bodies[0].positions.copy()
    positions[4] = np.nan
    assert retargeter.follow(second.stamp_ns, replace(second.bodies[0], positions=positions)) is None
    assert retargeter.follow(first.stamp_ns, first.bodies[0]) is None
    after: Any = retargeter.coast(second.stamp_ns)
    np.testing.assert_array_equal(before.joints, after.joints)


@pytest.mark.parametrize(("old", "new", "match"), [
    ("</robot>", "", "is no URDF"),
    ('lower="-0.09" upper="2.88"', 'lower="2.88" upper="-0.09"', "left_knee_joint: expected lower < upper"),
    ('"left_knee_joint" type="revolute"', '"left_knee_joint" type="continuous"', "expected revolute or prismatic"),
    ("left_knee_link", "left_middle_link", "no link is named for left_knee: with links"),
    ('<child link="waist_yaw_link"/>', '<child link="waist_roll_link"/>', "expected one link without a parent"),
])  # fmt: skip
def test_what_is_wrong_with_a_urdf_is_said(tmp_path: Path, old: str, new: str, match: str) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(URDF.read_text().replace(old, new))
    with pytest.raises(LaunchError, match=match):
        load_robot(file, {})
    if new == "left_middle_link":
        assert load_robot(file, {"left_knee": new}).links["left_knee"] == new
        with pytest.raises(LaunchError, match="no part left_nee"):
            load_robot(file, {"left_nee": new})


def test_the_node_sends_datagrams(make_launch: Callable[..., Launch]) -> None:
    sent = json.loads(first_datagram(make_launch, RetargetNode, cycle(worlds("idle")), retarget__urdf=str(URDF)))
    assert len(sent["joints"]) == 29
    assert len(sent["root"]) == 7
    assert set(sent["stands"]) == {"left", "right"}


def test_the_command_follows_the_cleaned_poses_and_not_the_truth_beside_them(tmp_path: Path) -> None:
    stream = []
    for world in worlds("idle")[:20]:
        body = RawBody(1, world.bodies[0].positions, np.ones(22))
        stream.append(PoseRaw(world.stamp_ns, "world", "test", "smpl22", Pose.identity(), True, [body]))
        elsewhere = replace(world.bodies[0], positions=world.bodies[0].positions + [50.0, 0, 0])
        stream.append((POSE_TRUTH, replace(world, bodies=[elsewhere])))
    record(tmp_path / "in", stream)
    assert main(["retarget", str(tmp_path / "in"), str(tmp_path / "out.npz"), "--urdf", str(URDF)]) == 0
    with np.load(tmp_path / "out.npz") as found:
        assert found["root"][:, 0].max() < 20.0


def test_the_command_writes_csv_and_npz_and_tells_what_is_wrong(tmp_path: Path, capsys) -> None:
    upright, given = np.stack([world.bodies[0].positions for world in worlds("idle")[:60]]), ["--urdf", str(URDF)]
    for name, joints in (("in.npz", upright[:20]), ("y.npz", upright[..., [1, 2, 0]])):  # y is up
        np.savez(tmp_path / name, positions=joints, skeleton="smpl22", fps=30.0)

    def retarget(source: str, out: str, *more: str) -> int:
        return main(["retarget", str(tmp_path / source), str(tmp_path / out), *more])

    assert [retarget("in.npz", name, *given) for name in ("out.csv", "out.npz")] == [0, 0]
    table: Any = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    arrays = np.load(tmp_path / "out.npz")
    assert table.dtype.names[0] == "time"
    assert list(table.dtype.names[8:]) == arrays["joint_names"].tolist()
    np.testing.assert_allclose(table["left_knee_joint"], arrays["joints"][:, 3], atol=1e-5)
    assert retarget("in.npz", "out.csv", *given) == 2
    assert "--force to replace it" in capsys.readouterr().err
    assert [retarget("in.npz", "out.bvh", *given), retarget("in.npz", "out2.csv")] == [2, 2]
    printed = capsys.readouterr().err
    assert "expected --urdf FILE" in printed
    assert str(URDF) in printed, "which is there wherever the package is installed"
    assert retarget("y.npz", "y.csv", *given) == 1
    assert "up_axis" in capsys.readouterr().err


def test_the_study_finds_a_breach_a_joint_too_fast_and_feet_that_slide_or_sink(robot: Robot) -> None:
    still = np.clip(np.zeros(29), robot.lower, robot.upper)
    knee = robot.joints.index("left_knee_joint")
    begun, moved, lifted = (RobotPose(k * 33_333_333, np.eye(7)[6], still.copy(), (True, k < 2)) for k in range(3))
    assert faults(robot, [begun, moved, lifted]) | {"deep_mm": 0.0} == {
        "breach_rad": 0.0, "speed": 0.0, "foot_mm": 0.0, "deep_mm": 0.0, "standing": 100.0,
    }  # fmt: skip
    sunk = faults(robot, [begun, lifted._replace(root=np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0, 1.0]))])["deep_mm"]
    assert sunk == pytest.approx(faults(robot, [begun, lifted])["deep_mm"] + 2000.0)
    moved.root[0] = 0.05
    lifted.root[1] = 3.0
    lifted.joints[knee] = robot.upper[knee] + 0.1
    found = faults(robot, [begun, moved, lifted._replace(stands=(False, False))])
    assert found["breach_rad"] == pytest.approx(0.1)
    assert found["speed"] > 1.0
    assert found["foot_mm"] == pytest.approx(50.0)
    assert found["standing"] == pytest.approx(200 / 3)
