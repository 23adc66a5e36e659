"""Inverse kinematics of a robot for one frame: a small quadratic program (mink, daqp), solved again if feet need it.

The ranges and the speeds of joints, and the speed of the root, are bounds of the program and not penalties, so they
hold in every frame. Only bounds are constraints, which makes the program fast.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# an optional extra that may not be installed; MuJoCo's module has no stubs

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from steadypose.nodes.sinks.robot import Robot
from steadypose.prior.arrays import Floats

MARGIN = 1e-4  # distance kept between a joint and its limit against rounding, radians or metres
ROOT_M_S, ROOT_RAD_S = 4.0, 4.0  # largest speeds of the root link along and about each axis
POSTURE = 0.02  # cost of a radian away from the home pose
SMOOTH, LEG_SMOOTH, ROOT_SMOOTH = 0.1, 0.5, 1.0
"""Costs of a radian (of the root also of a metre) by which a step differs from the last one. Legs near their limits
and the root would leap, because a linear program does not know what a large step does."""
DAMPING = 1e-4  # regularisation of the program
SLIP, ROUNDS, HALVED = 0.004, 3, 3
"""Distance in metres by which a held foot may get farther from its target, or a free one deeper below the floor, in one
frame; how often the program is solved around its last solution until that holds, and how often the step is then halved.
A step of the root of centimetres turns legs so far that the program, which is linear, would let feet slip."""
FEET = ("left_foot", "right_foot")  # parts that stay above the floor


class Solver:
    """Moves a robot's links towards their targets, frame by frame.

    ``costs`` are those of a metre and of a radian of error, for each part with a target; ``sole`` is the height of the
    feet above the floor while the robot stands, metres. ``home`` (nq,) is MuJoCo's configuration in which all joints
    are at 0, or at the limit next to it; ``velocity`` (nv,) is the last one, in MuJoCo's tangent space.
    """

    def __init__(self, robot: Robot, costs: Mapping[str, tuple[float, float]], sole: float) -> None:
        import mink

        self._mink, self._robot, self._sole, model = mink, robot, sole, robot.model
        self._ids = {part: model.body(link).id for part, link in robot.links.items()}
        self._q_indices = np.array([model.joint(name).qposadr[0] for name in robot.joints])
        self._v_indices = np.array([model.joint(name).dofadr[0] for name in robot.joints])
        self.home = model.qpos0.copy()
        self.home[self._q_indices] = np.clip(0.0, robot.lower + MARGIN, robot.upper - MARGIN)
        self._configuration = mink.Configuration(model, self.home)
        self._tasks = {
            part: mink.FrameTask(robot.links[part], "body", *cost, lm_damping=1e-3) for part, cost in costs.items()
        }
        self._targets = {part: mink.SE3(np.eye(7)[0]) for part in costs}
        for part, task in self._tasks.items():
            task.transform_target_to_world = self._targets[part]
        self._places = [part for part, cost in costs.items() if not cost[1]]
        self._speed = np.full(model.nv, np.inf)
        self._speed[:6] = [ROOT_M_S] * 3 + [ROOT_RAD_S] * 3
        self._speed[self._v_indices] = robot.speed
        self._smooth = np.full(model.nv, SMOOTH**2)
        self._smooth[:6] = ROOT_SMOOTH**2
        self._smooth[_between(model, self._ids["pelvis"], [self._ids[foot] for foot in FEET])] = LEG_SMOOTH**2
        self.velocity = np.zeros(model.nv)

    @property
    def q(self) -> Floats:
        """(nq,) MuJoCo's configuration; set it to place the robot."""
        return self._configuration.q

    @q.setter
    def q(self, q: Floats) -> None:
        self._configuration.update(q)

    @property
    def root(self) -> Floats:
        """(7,) pose of the root link in the world: metres and xyzw."""
        return self.q[[0, 1, 2, 4, 5, 6, 3]]

    @property
    def joints(self) -> Floats:
        """(N,) radians or metres, in the order of `Robot.joints`."""
        return self.q[self._q_indices]

    def frame(self, part: str) -> tuple[Floats, Floats]:
        """Rotation (3, 3) and position (3,) of a part's link, world."""
        data, k = self._configuration.data, self._ids[part]
        return data.xmat[k].reshape(3, 3).copy(), data.xpos[k].copy()

    def aim(self, part: str, turn: Floats | None, place: Floats, costs: tuple[float, float] | None = None) -> None:
        """Set the target of a part: rotation (3, 3), unless only its place counts, and position (3,), world; and its
        ``costs``.
        """
        import mujoco

        target = self._targets[part].wxyz_xyz
        target[4:] = place
        if turn is not None:
            mujoco.mju_mat2Quat(target[:4], np.ascontiguousarray(turn).reshape(9))
        if costs:
            self._tasks[part].cost[:3], self._tasks[part].cost[3:] = costs

    def step(self, dt: float, share: float, held: Sequence[str]) -> None:
        """Move to the targets within ``dt`` seconds, by a ``share`` of the way; parts that are ``held`` stay there."""
        before, most = self.q, self._off(held) + SLIP
        low, high = np.full_like(self.velocity, -np.inf), np.full_like(self.velocity, np.inf)
        low[self._v_indices] = np.minimum(self._robot.lower + MARGIN - before[self._q_indices], 0.0)
        high[self._v_indices] = np.maximum(self._robot.upper - MARGIN - before[self._q_indices], 0.0)
        low, high = np.maximum(low, -dt * self._speed), np.minimum(high, dt * self._speed)
        last, moved = dt * self.velocity, np.zeros_like(self.velocity)
        for _ in range(ROUNDS):
            moved += self._solve(dt, low - moved, high - moved, last - moved)
            self._move(before, share * moved)
            if self._off(held) < most:
                break
        for _ in range(HALVED):
            if self._off(held) < most:
                break
            share *= 0.5
            self._move(before, share * moved)
        self.velocity = share * moved / dt
        if not held:
            self.stay_above_floor()

    def coast(self, dt: float, share: float) -> None:
        """Move on for ``dt`` seconds with a ``share`` of the last velocity, within the ranges."""
        self.velocity *= share
        self._move(self.q, dt * self.velocity)
        self.stay_above_floor()

    def stay_above_floor(self) -> None:
        """Raise the root if a foot is below the floor."""
        q = self.q.copy()
        q[2] += max(self._depth(), 0.0)
        self.q = q

    def _solve(self, dt: float, low: Floats, high: Floats, last: Floats) -> Floats:
        from qpsolvers import solve_problem

        for part in self._places:
            self._targets[part].wxyz_xyz[:4] = self._configuration.data.xquat[self._ids[part]]
        problem: Any = self._mink.build_ik(self._configuration, list(self._tasks.values()), dt, DAMPING, limits=[])
        problem.P.flat[:: len(last) + 1] += self._smooth
        problem.P[self._v_indices, self._v_indices] += POSTURE**2
        problem.q -= self._smooth * last
        problem.q[self._v_indices] -= POSTURE**2 * (self.home - self.q)[self._q_indices]
        problem.lb, problem.ub = low, high
        found = solve_problem(problem, "daqp").x
        return np.zeros_like(low) if found is None else found

    def _off(self, held: Sequence[str]) -> float:
        """Largest distance of a held part from its target, or of a foot below the floor, metres."""
        gaps = [self._targets[part].wxyz_xyz[4:] - self.frame(part)[1] for part in held]
        return max(0.0, self._depth(), *(float(np.linalg.norm(gap)) for gap in gaps))

    def _depth(self) -> float:
        """Distance of the lower foot below the floor, metres."""
        return self._sole - min(float(self.frame(foot)[1][2]) for foot in FEET)

    def _move(self, q: Floats, step: Floats) -> None:
        self.q = q  # of which `integrate` starts
        q = self._configuration.integrate(step, 1.0)
        q[self._q_indices] = np.clip(q[self._q_indices], self._robot.lower, self._robot.upper)
        self._configuration.update(q)


def _between(model: Any, start: int, ends: Sequence[int]) -> list[int]:
    """Indices in the tangent space of the joints that move the bodies ``ends`` relative to the body ``start``."""
    bodies = set()
    for body in ends:
        while body not in (start, 0):
            bodies.add(body)
            body = int(model.body_parentid[body])
    return [k for k, body in enumerate(model.dof_bodyid) if body in bodies]
