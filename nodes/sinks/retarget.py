"""Retargets a person's motion to a robot: inverse kinematics by one small quadratic program per frame (mink).

The robot takes over the directions of the person's limbs and the orientations of pelvis, chest and feet. Its lengths
are its own, and distances on the floor are scaled by the ratio of the legs' lengths. A standing foot is held in place,
flat, until it lifts. Position and speed limits are constraints of the program, not penalties, so they hold in every
frame. The sink sends the newest pose as a JSON datagram for each message of ``pose/world``.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# an optional extra that may not be installed; MuJoCo's module has no stubs

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from steadypose.msgs.types import CONTACTS, PoseWorld, WorldBody
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.settings import LaunchError, path_setting
from steadypose.nodes.sinks.datagrams import DatagramNode, DatagramSettings, Followed
from steadypose.nodes.sinks.robot import Robot, load_robot
from steadypose.nodes.sinks.robot_feet import FREE, Foot
from steadypose.nodes.sinks.robot_solver import Solver
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices, rotation_matrix
from steadypose.prior.body.skeleton import J
from steadypose.prior.sim.gait import minimum_jerk


@dataclass(frozen=True)
class RetargetSettings(DatagramSettings):
    """``[retarget]``: a person's motion retargeted to a robot, as JSON datagrams."""

    section = "retarget"

    urdf: str = path_setting()
    """URDF file of the robot"""
    links: dict[str, str] = field(default_factory=dict)
    """part of the body, such as ``left_foot``, to the robot's link, where the link's name does not show it"""
    sole: float = 0.0
    """height of the foot links' origins above the floor when standing, metres"""
    port: int = 8767
    """UDP port of the receiver"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.sole <= 0.5:
            raise LaunchError(f"[retarget] sole: expected 0 to 0.5 metres, got {self.sole:g}")


def check_retarget(launch: Launch) -> None:
    """Raise LaunchError if no URDF is set, or it cannot be used."""
    settings = launch.settings(RetargetSettings)
    if not settings.urdf:
        raise LaunchError("[retarget] urdf: expected the robot's URDF file, got none")
    load_robot(Path(settings.urdf), settings.links)


def datagram(pose: "RobotPose", joints: tuple[str, ...]) -> bytes:
    """A pose as JSON: capture time in seconds, root link in the world (metres, xyzw), joints by name."""
    return json.dumps(
        {
            "stamp": pose.stamp_ns / 1e9,
            "root": pose.root.round(5).tolist(),
            "joints": dict(zip(joints, pose.joints.tolist(), strict=True)),
            "stands": dict(zip(("left", "right"), pose.stands, strict=True)),
        },
        separators=(",", ":"),
    ).encode()


class RetargetNode(DatagramNode):
    """Sends a robot's poses as datagrams."""

    name = "retarget"

    def __init__(self, launch: Launch) -> None:
        super().__init__(launch)
        one_thread()
        self._settings = settings = launch.settings(RetargetSettings)
        self._robot = load_robot(Path(settings.urdf), settings.links)
        self._follower = Follower(Retargeter(self._robot, settings.sole))

    def datagrams(self, world: PoseWorld) -> Sequence[bytes]:
        pose = self._follower.process(world)
        return [] if pose is None else [datagram(pose, self._robot.joints)]


SIDES = ("left", "right")
ANKLE = 0.07  # height of a person's ankle above the floor when standing, metres
CROUCH = 0.98
"""Height of the standing robot's hips relative to its legs' length, ratio. It is below 1 because straight knees are
singular."""
_BONES = np.array(
    [
        (J[f"{side}_{start}"], J[f"{side}_{end}"])
        for side in SIDES
        for start, end in (("hip", "knee"), ("shoulder", "elbow"), ("elbow", "wrist"))
    ]
).T
"""(2, 6) first and last joints of thigh, upper arm and forearm, left and right."""
EASE_S = 1.0  # time to ease into following a person, and to come to rest, seconds


class RobotPose(NamedTuple):
    """A robot's pose at one time."""

    stamp_ns: int
    root: Floats  # (7,) pose of the root link in the world: metres and xyzw
    joints: Floats  # (N,) radians or metres, in the order of `Robot.joints`
    stands: tuple[bool, bool]  # whether the left and the right foot have landed and are held in place


class Retargeter:
    """Retargets one person's motion to a robot, whose foot links' origins stand ``sole`` metres above the floor."""

    def __init__(self, robot: Robot, sole: float = 0.0) -> None:
        costs = {"pelvis": (2.0, 1.0), "torso": (0.0, 1.0)}
        for side in SIDES:
            costs |= {f"{side}_knee": (0.5, 0.0), f"{side}_foot": FREE}
            costs |= {f"{side}_elbow": (1.0, 0.0), f"{side}_wrist": (1.0, 0.0)}
        self._sole, self._solver = sole, Solver(robot, costs, sole)
        self._rest = {part: self._solver.frame(part) for part in robot.links}
        self._leg = [self._length(f"{side}_hip", f"{side}_knee", f"{side}_foot") for side in SIDES]
        self._arm = [self._length(f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist") for side in SIDES]
        hips = 0.5 * (self._rest["left_hip"][1] + self._rest["right_hip"][1])
        self._hips_from_pelvis = self._rest["pelvis"][0].T @ (hips - self._rest["pelvis"][1])
        self._feet = tuple(Foot(self._rest[f"{side}_foot"][0], sole) for side in SIDES)
        self._stamp_ns: int | None = None
        self._began_ns = 0
        self._scale, self._floor = 1.0, 0.0

    def reset(self) -> None:
        """Forget the person."""
        self._stamp_ns = None
        self._solver.velocity[:] = 0.0
        self._lift()

    def follow(self, stamp_ns: int, body: WorldBody, floor: float = 0.0) -> RobotPose | None:
        """The robot's pose for a person's at ``stamp_ns``, on a floor at height ``floor``, metres; None if that is
        unknown, or not later than the last.
        """
        if not np.isfinite(body.positions).all() or not np.isfinite(body.rotations).all():
            return None
        self._floor = floor
        if self._stamp_ns is None:
            self._begin(stamp_ns, body)
        dt = (stamp_ns - (self._stamp_ns or 0)) / 1e9
        if self._stamp_ns is None or dt > EASE_S:
            self._stamp_ns = stamp_ns
        elif dt <= 0.0:
            return None
        else:
            self._stamp_ns = stamp_ns
            share = float(minimum_jerk((stamp_ns - self._began_ns) / 1e9 / EASE_S))
            self._aim(body, dt, begun=share >= 1.0)
            held = [f"{side}_foot" for side, foot in zip(SIDES, self._feet, strict=True) if foot.landed]
            self._solver.step(dt, share, held)
        return self._pose(stamp_ns)

    def coast(self, stamp_ns: int) -> RobotPose | None:
        """The pose at ``stamp_ns`` while there is nobody to follow: the robot comes to rest and stays there."""
        if self._stamp_ns is None or stamp_ns <= self._stamp_ns:
            return None
        dt = min((stamp_ns - self._stamp_ns) / 1e9, EASE_S)
        self._stamp_ns = self._began_ns = stamp_ns  # so that a person who returns is eased into
        self._lift()
        self._solver.coast(dt, np.exp(-5.0 * dt / EASE_S))
        return self._pose(stamp_ns)

    def _lift(self) -> None:
        for foot in self._feet:
            foot.lift()

    def _begin(self, stamp_ns: int, body: WorldBody) -> None:
        """Place the robot at the person's position and heading. Its joints continue from their current values."""
        p = body.positions.astype(np.float64)
        human = np.mean([_length(p, f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in SIDES])
        self._scale = float(np.mean([sum(leg) for leg in self._leg]) / max(human, 0.1))
        forward = rotation_matrix(body.root_orientation)[:, 0]
        yaw = np.arctan2(forward[1], forward[0])
        q = self._solver.q  # the home pose at first, the current pose for the next person
        low = min(self._rest[f"{side}_foot"][1][2] for side in SIDES)
        q[:3] = [*(self._scale * p[0, :2]), self._sole - low + self._solver.home[2]]
        q[3:7] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        self._solver.q = q
        self._solver.stay_above_floor()
        self._began_ns = stamp_ns

    def _aim(self, body: WorldBody, dt: float, *, begun: bool) -> None:
        solver, p = self._solver, body.positions.astype(np.float64)
        turns = global_rotations(rotation_matrices(body.rotations.astype(np.float64)))
        hips = 0.5 * (p[J["left_hip"]] + p[J["right_hip"]])
        at = self._to_robot(hips) - [0.0, 0.0, (1.0 - CROUCH) * float(np.mean([sum(leg) for leg in self._leg]))]
        turn = turns[J["pelvis"]] @ self._rest["pelvis"][0]
        solver.aim("pelvis", turn, at - turn @ self._hips_from_pelvis)
        solver.aim("torso", turns[J["spine3"]] @ self._rest["torso"][0], np.zeros(3))
        along = p[_BONES[1]] - p[_BONES[0]]
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
        for k, side in enumerate(SIDES):
            thigh, upper_arm, forearm = along[3 * k : 3 * k + 3]
            solver.aim(f"{side}_knee", None, solver.frame(f"{side}_hip")[1] + self._leg[k][0] * thigh)
            elbow = solver.frame(f"{side}_shoulder")[1] + self._arm[k][0] * upper_arm
            solver.aim(f"{side}_elbow", None, elbow)
            solver.aim(f"{side}_wrist", None, elbow + self._arm[k][1] * forearm)
            turn = turns[J[f"{side}_ankle"]] @ self._rest[f"{side}_foot"][0]
            place = self._to_robot(p[J[f"{side}_ankle"]])
            place[2] = max(place[2], self._sole)
            touching = _touching(body, side) if begun else 0.0
            solver.aim(f"{side}_foot", *self._feet[k].target(turn, place, touching, solver.frame(f"{side}_foot"), dt))

    def _to_robot(self, point: Floats) -> Floats:
        """A point (3,) of the person, scaled to the robot's world."""
        return self._scale * (point - [0.0, 0.0, self._floor + ANKLE]) + [0.0, 0.0, self._sole]

    def _length(self, *parts: str) -> tuple[float, float]:
        a, b, c = (self._rest[part][1] for part in parts)
        return float(np.linalg.norm(b - a)), float(np.linalg.norm(c - b))

    def _pose(self, stamp_ns: int) -> RobotPose:
        for side, foot in zip(SIDES, self._feet, strict=True):
            foot.moved(self._solver.frame(f"{side}_foot")[1])
        left, right = self._feet
        return RobotPose(stamp_ns, self._solver.root, self._solver.joints, (left.landed, right.landed))


def _touching(body: WorldBody, side: str) -> float:
    """Probability that a foot stands; 1 if it is unknown, because a robot has to stand on something."""
    heel, toes = (body.contacts[CONTACTS.index(f"{side}_{part}")] for part in ("ankle", "foot"))
    return 1.0 if np.isnan(heel + toes) else float(max(heel, toes))


def _length(p: Floats, *joints: str) -> float:
    return float(sum(np.linalg.norm(p[J[b]] - p[J[a]]) for a, b in pairwise(joints)))


class Follower:
    """Computes a robot's poses for a stream of ``pose/world``, following one person (`Followed`)."""

    def __init__(self, retargeter: Retargeter, body: int | None = None) -> None:
        self._retargeter, self._followed = retargeter, Followed(body)

    def process(self, world: PoseWorld) -> RobotPose | None:
        """The pose at a message's stamp; None until there was anybody."""
        before = self._followed.id
        body = self._followed.update(world)
        if self._followed.id != before:
            self._retargeter.reset()
        floor = -float(world.ground_plane[3])
        pose = None if body is None else self._retargeter.follow(world.stamp_ns, body, floor)
        return pose or self._retargeter.coast(world.stamp_ns)
