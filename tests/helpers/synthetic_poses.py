"""A made-up person who walks in a circle, as every topic would tell it: no motion capture, no model, no noise source
but a seeded generator."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs import types
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.prior.body.kinematics import forward_kinematics
from steadypose.prior.body.layouts import SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.skeleton import REST_OFFSETS, J

FPS = 30.0
START_NS = 1_000_000_000
CAMERA = types.Pose(
    np.array([0.0, -4.0, 1.3]),
    (Rotation.from_euler("x", -90, degrees=True) * Rotation.from_euler("x", -5, degrees=True)).as_quat(),
)
"""Optical frame (x right, y down, z forward) at 1.3 m, looking along the world's +y."""


def walker(time: float, phase: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A walker at one moment: positions (22, 3) in the world, local rotations (22, 4) xyzw, root velocity (3,)."""
    stride = 2 * np.pi * 0.9 * time + phase
    circle = 0.45 * time + phase
    heading = circle + np.pi / 2
    turn = np.zeros((22, 3))
    lower = np.zeros((22, 3))
    turn[J["pelvis"], 2] = heading
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = sign * np.sin(stride)
        turn[J[f"{side}_hip"], 1] = -0.45 * swing
        turn[J[f"{side}_knee"], 1] = 0.35 + 0.35 * sign * np.cos(stride)
        lower[J[f"{side}_shoulder"], 0] = -1.2 * sign
        turn[J[f"{side}_shoulder"], 1] = 0.4 * swing
        turn[J[f"{side}_elbow"], 2] = -0.4 * sign
    local = Rotation.from_rotvec(turn) * Rotation.from_rotvec(lower)
    root = np.array([1.1 * np.cos(circle), 1.1 * np.sin(circle), 0.90 + 0.02 * np.cos(2 * stride)])
    positions, _ = forward_kinematics(local.as_matrix(), REST_OFFSETS, root)
    velocity = 1.1 * 0.45 * np.array([-np.sin(circle), np.cos(circle), 0.0])
    return positions, local.as_quat(), velocity


def to_camera(positions: NDArray[np.floating]) -> NDArray[np.float64]:
    """World positions (..., 3) in the camera's optical frame."""
    flat = positions.reshape(-1, 3) - CAMERA.position
    return Rotation.from_quat(CAMERA.orientation).inv().apply(flat).reshape(positions.shape)


def sensor_joints(skeleton: Skeleton, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(J, 3) joints of a sensor at the canonical joints they are closest to in meaning; its others lie at the neck."""
    joints = np.repeat(positions[J["neck"]][None], len(skeleton.joints), axis=0)
    for canonical, row in enumerate(skeleton.to_canonical):
        joints[row > 0] = positions[canonical]
    return joints


def messages(
    seconds: float, *, bodies: int = 1, skeleton: str = "azure_kinect32", delay_frames: int = 4, seed: int = 0
) -> Iterator[tuple[str, types.Message]]:
    """Raw, true, clean and world messages of a stream in the order in which they would arrive.

    From 2 s to 4 s of every 6 s the left arm is hidden, and at 5 s of every 10 s comes half a second of nonsense.
    """
    noise = np.random.default_rng(seed)
    table = SKELETONS[skeleton]
    hidden = np.array([J["left_shoulder"], J["left_elbow"], J["left_wrist"]])
    raw_of: dict[tuple[int, int], tuple[NDArray, NDArray]] = {}
    for frame in range(int(seconds * FPS)):
        stamp = START_NS + round(frame / FPS * 1e9)
        time = frame / FPS
        arm_hidden, nonsense = 2 <= time % 6 < 4, 5 <= time % 10 < 5.5
        raw_bodies, true_bodies = [], []
        for body in range(bodies):
            positions, rotations, velocity = walker(time, body * np.pi)
            joints = sensor_joints(table, positions)
            joints += noise.normal(0, 0.02 + 0.15 * nonsense, joints.shape)
            confidence = noise.uniform(0.6, 1.0, len(joints))
            if arm_hidden:
                lost = table.to_canonical[hidden].any(axis=0)
                joints[lost], confidence[lost] = np.nan, 0.0
            raw_bodies.append(types.RawBody(body, to_camera(joints), confidence))
            raw_of[frame, body] = joints, confidence
            true_bodies.append(_world(body, positions, rotations, velocity, np.full(22, types.JointState.SEEN), 0.0))
        yield POSE_RAW, types.PoseRaw(stamp, "camera", "made-up", skeleton, CAMERA, True, raw_bodies)
        yield POSE_TRUTH, types.PoseWorld(stamp, "world", "made-up", np.array([0, 0, 1.0, 0]), true_bodies)
        ready = frame - delay_frames
        if ready < 0:
            continue
        time = ready / FPS
        stamp = START_NS + round(time * 1e9)
        arm_hidden, nonsense = 2 <= time % 6 < 4, 5 <= time % 10 < 5.5
        clean_bodies, world_bodies = [], []
        for body in range(bodies):
            positions, rotations, velocity = walker(time, body * np.pi)
            state = np.where(table.observable, types.JointState.REFINED, types.JointState.IMPUTED)
            state[[J["pelvis"], J["left_hip"], J["right_hip"]]] = types.JointState.SEEN
            if arm_hidden:
                state[hidden] = types.JointState.IMPUTED
            sigma = np.where(state == types.JointState.IMPUTED, 0.06, 0.012)
            positions = positions + noise.normal(0, 0.003, positions.shape)
            canonical, trust = to_canonical(table, *raw_of.pop((ready, body)))
            anomaly = float(noise.gamma(2.0, 0.15) + 3.0 * nonsense)
            clean_bodies.append(
                types.CleanBody(
                    body, to_camera(positions), rotations, state, sigma, anomaly,
                    nonsense, np.full(22, anomaly), np.linalg.norm(REST_OFFSETS, axis=1),
                    to_camera(canonical), trust,
                )
            )  # fmt: skip
            world_bodies.append(_world(body, positions, rotations, velocity, state, 0.06 if arm_hidden else 0.012))
        yield POSE_CLEAN, types.PoseClean(stamp, "camera", "made-up", CAMERA, True, delay_frames, clean_bodies)
        yield POSE_WORLD, types.PoseWorld(stamp, "world", "made-up", np.array([0, 0, 1.0, 0]), world_bodies)


def _world(body: int, positions, rotations, velocity, state, sigma: float) -> types.WorldBody:
    heights = positions[[J[name] for name in types.CONTACTS], 2]
    contacts = np.clip((0.11 - heights) / 0.05, 0, 1)
    return types.WorldBody(
        body, positions[0], rotations[0], velocity, np.eye(6) * 1e-4, positions, rotations,
        state, np.full(22, sigma), contacts, types.Tracking.OK,
    )  # fmt: skip


def messages_on(topic: str, seconds: float, **options: Any) -> list[Any]:
    return [message for on, message in messages(seconds, **options) if on == topic]
