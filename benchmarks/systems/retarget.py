"""Retargeting: computing time of a frame, limits of the joints, and how still a standing foot stays.

The bundled streams run through the nodes' own pipelines, as in ``steadypose retarget``, to the robot that ships. Limits
and feet are checked on the published poses alone: MuJoCo places the links for the root and the joints that a receiver
gets.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# an optional extra that may not be installed; MuJoCo's module has no stubs

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.benchmarks.bench import Bench, numpy_ms
from steadypose.benchmarks.provenance import ROOT, WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.types import PoseWorld
from steadypose.nodes.driving import OfflineRun
from steadypose.nodes.sinks.retarget import SIDES, Follower, Retargeter, RobotPose
from steadypose.nodes.sinks.robot import Robot, load_robot
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats

DEPENDS_ON = (*WORLD, "nodes.sinks.retarget", "nodes.sinks.robot", "nodes.sinks.robot_feet", "nodes.sinks.robot_solver")

URDF = ROOT / "launch" / "robots" / "humanoid29.urdf"
STREAMS = ROOT / "sim_data"
ALL = "all"


def faults(robot: Robot, poses: Sequence[RobotPose]) -> dict[str, float]:
    """Return of the published poses of one stream the largest breach of a joint's range, radians; the largest
    speed of a joint, of its limit; the largest distance of a standing foot from where it came to stand, and of any foot
    below the floor, mm; and the percentage of poses in which at least one foot is published as standing."""
    import mujoco

    data = mujoco.MjData(robot.model)
    index = [robot.model.joint(name).qposadr[0] for name in robot.joints]
    stood: dict[str, Floats] = {}
    away = deep = 0.0
    for pose in poses:
        data.qpos[:7] = pose.root[[0, 1, 2, 6, 3, 4, 5]]
        data.qpos[index] = pose.joints
        mujoco.mj_kinematics(robot.model, data)
        for side, stands in zip(SIDES, pose.stands, strict=True):
            at = data.body(robot.links[f"{side}_foot"]).xpos.copy()
            deep = max(deep, -float(at[2]))
            if stands:
                away = max(away, float(np.linalg.norm(at - stood.setdefault(side, at))))
            else:
                stood.pop(side, None)
    joints = np.array([pose.joints for pose in poses])
    speeds = np.abs(np.diff(joints, axis=0)) / np.diff([pose.stamp_ns for pose in poses])[:, None] * 1e9
    return {
        "breach_rad": max(0.0, float((joints - robot.upper).max()), float((robot.lower - joints).max())),
        "speed": float((speeds / robot.speed).max()),
        "foot_mm": 1e3 * away,
        "deep_mm": 1e3 * deep,
        "standing": 100.0 * float(np.mean([any(pose.stands) for pose in poses])),
    }


def followed(recording: Path) -> dict[str, Any]:
    """Retarget a recording, and measure its poses and the processor time of each frame that shows somebody."""
    robot = load_robot(URDF, {})
    follower, poses, spent = Follower(Retargeter(robot)), [], []
    for topic, message in OfflineRun(open_recording(recording), {"prior": {}, "trajectory": {}}):
        if topic == POSE_WORLD and isinstance(message, PoseWorld):
            began = time.thread_time()
            pose = follower.process(message)
            if message.bodies:
                spent.append(1e3 * (time.thread_time() - began))
            poses += [pose] if pose else []
    return {"frames": len(poses), "cpu_ms": [round(ms, 4) for ms in spent], **faults(robot, poses)}


def run(bench: Bench) -> Result:
    streams = sorted(path.parent for path in STREAMS.glob("*/metadata.yaml"))[: 1 if bench.quick else None]
    found = {path.name: followed(path) for path in bench.progress.track(streams, description="retargeting")}
    numpy = round(numpy_ms(), 3)
    return Result(
        [_table(found, numpy)], {"streams": found, "numpy_ms": numpy, "mink": version("mink"), "daqp": version("daqp")}
    )


def _table(found: dict[str, dict[str, Any]], numpy: float) -> Table:
    worst = {name: max(one[name] for one in found.values()) for name in ("breach_rad", "speed", "foot_mm", "deep_mm")}
    frames = [one["frames"] for one in found.values()]
    total = {"frames": sum(frames), "standing": np.average([one["standing"] for one in found.values()], weights=frames)}
    every = {"cpu_ms": [ms for one in found.values() for ms in one["cpu_ms"]]}
    records = []
    for name, one in [*found.items(), (ALL, total | every | worst)]:
        p50, p99 = np.percentile(one["cpu_ms"], (50, 99))
        records.append({"stream": name, "p50": p50, "p99": p99, "ratio": p50 / numpy, **one})
    return Table.of(
        "retarget",
        "One person to a robot of 29 joints: a frame's processor time, limits, standing feet",
        records,
        {"stream": "{stream}", "frames": "{frames}", "cpu, p50, ms": "{p50:.2f}", "cpu, p99, ms": "{p99:.2f}",
         "p50, of numpy's": "{ratio:.2f}", "worst breach of a range, rad": "{breach_rad:.4f}",
         "fastest joint, of its limit": "{speed:.2f}", "standing foot, at most, mm": "{foot_mm:.1f}",
         "foot below the floor, at most, mm": "{deep_mm:.1f}", "some foot stands, % of frames": "{standing:.0f}"},
        "`launch/robots/humanoid29.urdf`. cpu: the thread's processor time, which other processes do not "
        "lengthen, in frames that show somebody. numpy's: 30 steps of a Kalman filter of 44 states in numpy on the "
        f"same core, {numpy:.2f} ms; compare machines by the ratio. Foot: how far it is from where it came to stand.",
    )  # fmt: skip
