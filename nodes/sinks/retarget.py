"""Retargets a person's motion to a robot: inverse kinematics by one small quadratic program per frame (mink).

The robot takes over the directions of the person's limbs and the orientations of pelvis, chest and feet. Its lengths
are its own, and distances on the floor are scaled by the ratio of the legs' lengths. A standing foot is held in place,
flat, until it lifts. Position and speed limits are constraints of the program, not penalties, so they hold in every
frame. The sink sends the newest pose as a JSON datagram for each message of ``pose/world``.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# an optional extra that may not be installed; MuJoCo's module has no stubs

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steadypose.msgs.types import CONTACTS, PoseWorld, WorldBody
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.settings import LaunchError, path_setting
from steadypose.nodes.sinks.datagrams import DatagramNode, DatagramSettings, Followed
from steadypose.nodes.sinks.robot import Robot, load_robot
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices, rotation_matrix, yaw_matrix
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
    """Check that the robot's URDF can be used.

    Raises:
        LaunchError: no URDF is set, or it cannot be used.
    """
    settings = launch.settings(RetargetSettings)
    if not settings.urdf:
        raise LaunchError("[retarget] urdf: expected the robot's URDF file, got none")
    load_robot(Path(settings.urdf), settings.links)


def datagram(pose: RobotPose, joints: tuple[str, ...]) -> bytes:
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
ANKLE = 0.07
"""Height of a person's ankle above the floor when standing, metres."""
CROUCH = 0.98
"""Height of the standing robot's hips relative to its legs' length, ratio. It is below 1 because straight knees are
singular."""
EASE_S = 1.0
"""Time to ease into following a person, and to come to rest, seconds."""
RELEASE_S = 0.15
"""Time in which a lifting foot moves from where it stood to its target, seconds."""
STANDS, LIFTS = 0.6, 0.4
"""Contact probabilities above which a foot stands, and below which it lifts."""
ROOT_M_S, ROOT_RAD_S = 4.0, 4.0
"""Largest speeds of the root link. A faster step is shortened as a whole, so that it keeps its direction."""
LANDED = 0.01
"""Distance from where it is held within which a foot has landed and is published as standing, metres. A person's
contact probability rises before the robot's foot, of other proportions, is on the floor."""
TOO_FAR = 0.3
"""Distance between a standing foot and its target at which it is released anyway, metres."""
MARGIN = 1e-4
"""Distance kept between a joint and its limit against rounding, radians or metres."""


class RobotPose(NamedTuple):
    """A robot's pose at one time."""

    stamp_ns: int
    root: Floats
    """(7,) pose of the root link in the world: metres and xyzw"""
    joints: Floats
    """(N,) radians or metres, in the order of `Robot.joints`"""
    stands: tuple[bool, bool]
    """whether the left and the right foot have landed and are held in place"""


@dataclass
class _Foot:
    """The state of one foot: where it is held, whether it has landed there, or its progress of being released
    (``free``, 0 to 1)."""

    stood: tuple[Floats, Floats] | None = None
    stands: bool = False
    landed: bool = False
    free: float = 1.0


class Retargeter:
    """Retargets one person's motion to a robot, whose foot links' origins stand ``sole`` metres above the floor."""

    def __init__(self, robot: Robot, sole: float = 0.0) -> None:
        import mink

        self.robot, self._sole, self._mink = robot, sole, mink
        model = robot.model
        self._configuration = mink.Configuration(model)
        self._q_indices = np.array([model.joint(name).qposadr[0] for name in robot.joints])
        self._v_indices = np.array([model.joint(name).dofadr[0] for name in robot.joints])
        self._home = model.qpos0.copy()
        self._home[self._q_indices] = np.clip(0.0, robot.lower + MARGIN, robot.upper - MARGIN)
        for k, name in enumerate(robot.joints):
            model.jnt_range[model.joint(name).id] = robot.lower[k] + MARGIN, robot.upper[k] - MARGIN
            model.jnt_limited[model.joint(name).id] = 1
        self._limits = [
            mink.ConfigurationLimit(model, gain=1.0),
            mink.VelocityLimit(model, dict(zip(robot.joints, robot.speed.tolist(), strict=True))),
        ]
        self._configuration.update(self._home)
        self._rest = {part: self._frame(part) for part in robot.links}
        self._leg = [self._length(f"{side}_hip", f"{side}_knee", f"{side}_foot") for side in SIDES]
        self._arm = [self._length(f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist") for side in SIDES]
        hips = 0.5 * (self._rest["left_hip"][1] + self._rest["right_hip"][1])
        self._hips_from_pelvis = self._rest["pelvis"][0].T @ (hips - self._rest["pelvis"][1])
        self._tasks = self._make_tasks()
        self._feet = (_Foot(), _Foot())
        self._stamp_ns: int | None = None
        self._began_ns = 0
        self._velocity = np.zeros(model.nv)
        self._scale = 1.0

    def _make_tasks(self) -> dict[str, Any]:
        task = self._mink.FrameTask
        costs = {"pelvis": (2.0, 1.0), "torso": (0.0, 1.0)}
        for side in SIDES:
            costs |= {f"{side}_knee": (0.5, 0.0), f"{side}_foot": (100.0, 10.0)}
            costs |= {f"{side}_elbow": (1.0, 0.0), f"{side}_wrist": (1.0, 0.0)}
        tasks = {part: task(self.robot.links[part], "body", *cost, lm_damping=1e-3) for part, cost in costs.items()}
        tasks["posture"] = self._mink.PostureTask(self.robot.model, cost=0.02)
        tasks["posture"].set_target(self._home)
        tasks["damping"] = self._mink.DampingTask(self.robot.model, cost=0.2)
        return tasks

    def reset(self) -> None:
        """Forget the person, so that the next one is started afresh."""
        self._stamp_ns = None
        self._velocity[:] = 0.0
        self._feet = (_Foot(), _Foot())

    def follow(self, stamp_ns: int, body: WorldBody) -> RobotPose | None:
        """The robot's pose for a person's at ``stamp_ns``; None if that is unknown, or not later than the last."""
        if not np.isfinite(body.positions).all() or not np.isfinite(body.rotations).all():
            return None
        if self._stamp_ns is None:
            self._begin(stamp_ns, body)
        dt = (stamp_ns - (self._stamp_ns or 0)) / 1e9
        if self._stamp_ns is None or dt > EASE_S:
            self._stamp_ns, dt = stamp_ns, 0.0
        elif dt <= 0.0:
            return None
        else:
            self._stamp_ns = stamp_ns
            share = float(minimum_jerk((stamp_ns - self._began_ns) / 1e9 / EASE_S))
            self._aim(body, dt, begun=share >= 1.0)
            wanted = self._mink.solve_ik(
                self._configuration, list(self._tasks.values()), dt, "daqp", damping=1e-4, limits=self._limits
            )
            # the program is linear: a large step of the root, which has no limits there, would tear off standing feet
            root = max(np.linalg.norm(wanted[:3]) / ROOT_M_S, np.linalg.norm(wanted[3:6]) / ROOT_RAD_S, 1.0)
            self._velocity = share / root * wanted
            self._integrate(dt)
        return self._pose(stamp_ns)

    def coast(self, stamp_ns: int) -> RobotPose | None:
        """The pose at ``stamp_ns`` while there is nobody to follow: the robot comes to rest and stays there."""
        if self._stamp_ns is None or stamp_ns <= self._stamp_ns:
            return None
        dt = min((stamp_ns - self._stamp_ns) / 1e9, EASE_S)
        self._velocity *= np.exp(-5.0 * dt / EASE_S)
        self._stamp_ns = self._began_ns = stamp_ns  # so that a person who returns is eased into
        self._feet = (_Foot(), _Foot())
        self._integrate(dt)
        return self._pose(stamp_ns)

    def _begin(self, stamp_ns: int, body: WorldBody) -> None:
        """Place the robot at the person's position and heading. Its joints continue from their current values."""
        p = body.positions.astype(np.float64)
        human = np.mean([_length(p, f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in SIDES])
        self._scale = float(np.mean([sum(leg) for leg in self._leg]) / max(human, 0.1))
        forward = rotation_matrix(body.root_orientation)[:, 0]
        yaw = np.arctan2(forward[1], forward[0])
        q = self._configuration.q.copy()  # the home pose at first, the current pose for the next person
        low = min(self._rest[f"{side}_foot"][1][2] for side in SIDES)
        q[:3] = [*(self._scale * p[0, :2]), self._sole - low + self._home[2]]
        q[3:7] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        self._configuration.update(q)
        self._began_ns = stamp_ns

    def _aim(self, body: WorldBody, dt: float, *, begun: bool) -> None:
        """Set the targets of all links."""
        p = body.positions.astype(np.float64)
        turns = global_rotations(rotation_matrices(body.rotations.astype(np.float64)))
        hips = 0.5 * (p[J["left_hip"]] + p[J["right_hip"]])
        at = self._to_robot(hips) - [0.0, 0.0, (1.0 - CROUCH) * float(np.mean([sum(leg) for leg in self._leg]))]
        turn = turns[J["pelvis"]] @ self._rest["pelvis"][0]
        self._set("pelvis", turn, at - turn @ self._hips_from_pelvis)
        self._set("torso", turns[J["spine3"]] @ self._rest["torso"][0], np.zeros(3))
        for k, side in enumerate(SIDES):
            hip = self._frame(f"{side}_hip")[1]
            self._set(f"{side}_knee", None, hip + self._leg[k][0] * _direction(p, f"{side}_hip", f"{side}_knee"))
            shoulder = self._frame(f"{side}_shoulder")[1]
            elbow = shoulder + self._arm[k][0] * _direction(p, f"{side}_shoulder", f"{side}_elbow")
            self._set(f"{side}_elbow", None, elbow)
            self._set(f"{side}_wrist", None, elbow + self._arm[k][1] * _direction(p, f"{side}_elbow", f"{side}_wrist"))
            touching = _touching(body, side)
            turn = turns[J[f"{side}_ankle"]] @ self._rest[f"{side}_foot"][0]
            place = self._to_robot(p[J[f"{side}_ankle"]])
            place[2] = max(place[2], self._sole)
            self._set(f"{side}_foot", *self._held(k, turn, place, touching, dt, begun=begun))

    def _to_robot(self, point: Floats) -> Floats:
        """A point (3,) of the person, scaled to the robot's world."""
        return self._scale * (point - [0.0, 0.0, ANKLE]) + [0.0, 0.0, self._sole]

    def _held(
        self, k: int, turn: Floats, place: Floats, touching: float, dt: float, *, begun: bool
    ) -> tuple[Floats, Floats]:
        """A foot's target: where it stands, the person's foot, or in between while it is released."""
        foot = self._feet[k]
        far = foot.stood is not None and float(np.linalg.norm((foot.stood[1] - place)[:2])) > TOO_FAR
        stands = begun and not far and touching > (LIFTS if foot.stands else STANDS)
        if stands and not foot.stands:
            now, at = self._frame(f"{SIDES[k]}_foot")
            forward = (now @ self._rest[f"{SIDES[k]}_foot"][0].T)[:, 0]
            flat = yaw_matrix(np.arctan2(forward[1], forward[0])) @ self._rest[f"{SIDES[k]}_foot"][0]
            foot.stood, foot.free = (flat, np.array([at[0], at[1], self._sole])), 0.0
        foot.stands, foot.landed = stands, stands and foot.landed
        if stands and foot.stood:
            return foot.stood
        foot.free = min(1.0, foot.free + dt / RELEASE_S)
        if foot.stood is None or foot.free >= 1.0:
            foot.stood = None
            return turn, place
        return turn, foot.stood[1] + float(minimum_jerk(foot.free)) * (place - foot.stood[1])

    def _integrate(self, dt: float) -> None:
        q = self._configuration.integrate(self._velocity, dt)
        before = self._configuration.q[self._q_indices]
        most = self.robot.speed * dt
        q[self._q_indices] = np.clip(
            np.clip(q[self._q_indices], before - most, before + most), self.robot.lower, self.robot.upper
        )
        self._configuration.update(q)

    def _set(self, part: str, turn: Floats | None, place: Floats) -> None:
        rotation = self._mink.SO3.identity() if turn is None else self._mink.SO3.from_matrix(turn)
        self._tasks[part].set_target(self._mink.SE3.from_rotation_and_translation(rotation, place))

    def _frame(self, part: str) -> tuple[Floats, Floats]:
        """Rotation (3, 3) and position (3,) of a part's link, world."""
        link = self._configuration.data.body(self.robot.links[part])
        return link.xmat.reshape(3, 3).copy(), link.xpos.copy()

    def _length(self, *parts: str) -> tuple[float, float]:
        a, b, c = (self._rest[part][1] for part in parts)
        return float(np.linalg.norm(b - a)), float(np.linalg.norm(c - b))

    def _pose(self, stamp_ns: int) -> RobotPose:
        q = self._configuration.q
        root = q[[0, 1, 2, 4, 5, 6, 3]].copy()
        for side, foot in zip(SIDES, self._feet, strict=True):
            if foot.stands and foot.stood:
                foot.landed |= bool(np.linalg.norm(self._frame(f"{side}_foot")[1] - foot.stood[1]) < LANDED)
        return RobotPose(stamp_ns, root, q[self._q_indices].copy(), (self._feet[0].landed, self._feet[1].landed))


def _touching(body: WorldBody, side: str) -> float:
    """Probability that a foot stands; 1 if it is unknown, because a robot has to stand on something."""
    heel, toes = (body.contacts[CONTACTS.index(f"{side}_{part}")] for part in ("ankle", "foot"))
    return 1.0 if np.isnan(heel + toes) else float(max(heel, toes))


def _direction(p: Floats, start: str, end: str) -> Floats:
    along = p[J[end]] - p[J[start]]
    return along / max(float(np.linalg.norm(along)), 1e-6)


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
        pose = None if body is None else self._retargeter.follow(world.stamp_ns, body)
        return pose or self._retargeter.coast(world.stamp_ns)
