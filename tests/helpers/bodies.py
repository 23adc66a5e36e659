"""Bodies for tests: moving skeletons with known truth, in the messages that carry them."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import CleanBody, JointState, Pose, PoseRaw, RawBody, Tracking, WorldBody
from steadypose.prior.body.kinematics import forward_kinematics
from steadypose.prior.body.skeleton import REST_OFFSETS, J

PERIOD_NS = 33_333_333
UNTURNED = np.tile([0.0, 0.0, 0.0, 1.0], (22, 1))
LEAVES = [J[n] for n in ("left_foot", "right_foot", "head", "left_wrist", "right_wrist")]


def random_pose(rng: np.random.Generator, frames: int, spread: float = 0.35) -> np.ndarray:
    """Local rotations that the solver can recover: leaves at rest, elbows and knees hinges, limbs well bent."""
    vectors = rng.normal(size=(frames, 22, 3)) * spread
    vectors[:, LEAVES] = 0
    vectors[:, [J["spine1"], J["spine2"], J["spine3"], J["neck"]]] *= 0.2
    for joint, axis in (("left_elbow", (0, 0, -1)), ("right_elbow", (0, 0, 1)), ("left_knee", (0, 1, 0)),
                        ("right_knee", (0, 1, 0))):  # fmt: skip
        vectors[:, J[joint]] = rng.uniform(0.6, 1.8, size=(frames, 1)) * np.array(axis)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 22, 3, 3)


def fk(rotations: np.ndarray, offsets: np.ndarray = REST_OFFSETS) -> np.ndarray:
    return forward_kinematics(rotations, offsets, np.zeros(3))[0]


def waving(frames: int, scale: float = 1.0, speed: float = 1.0) -> np.ndarray:
    """(frames, 22, 3) metres at 30 Hz, z up, feet at the floor: somebody who sways, bends knees and waves."""
    t = np.arange(frames) / 30 * speed
    vectors = np.zeros((frames, 22, 3))
    vectors[:, 0, 2] = 0.3 * np.sin(0.7 * t)
    vectors[:, J["spine2"], 1] = 0.2 + 0.1 * np.sin(t)
    vectors[:, J["left_shoulder"], 0] = -0.9 + 0.3 * np.sin(2 * t)
    vectors[:, J["right_shoulder"], 0] = 1.1
    vectors[:, J["left_elbow"], 2] = -1.0 - 0.5 * np.sin(3 * t)
    vectors[:, J["right_elbow"], 2] = 0.7
    for side in ("left", "right"):
        vectors[:, J[f"{side}_hip"], 1] = -0.4 - 0.2 * np.sin(t)
        vectors[:, J[f"{side}_knee"], 1] = 0.8 + 0.4 * np.sin(t)
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(frames, 22, 3, 3)
    way = np.stack([0.1 * np.sin(t), 0.1 * np.cos(t), 0 * t], axis=-1)
    positions = fk(rotations, REST_OFFSETS * scale) + way[:, None]
    return positions - [0.0, 0.0, positions[..., 2].min() - 0.02]


def noisy(frames: int, sigma: float, speed: float = 1.0) -> np.ndarray:
    """The same in white noise of ``sigma`` metres along an axis."""
    return waving(frames, speed=speed) + np.random.default_rng(0).normal(size=(frames, 22, 3)) * sigma


def raw(
    stamp_ns: int, bodies: dict[int, np.ndarray], skeleton: str = "smpl22", confidence: float = 1.0,
    pose: Pose | None = None,
) -> PoseRaw:  # fmt: skip
    return PoseRaw(
        stamp_ns=stamp_ns, frame_id="world", source="test", skeleton=skeleton, sensor_pose=pose or Pose.identity(),
        calibrated=True, bodies=[RawBody(k, p, np.full(len(p), confidence)) for k, p in bodies.items()],
    )  # fmt: skip


def stream(positions: np.ndarray, start_ns: int = 10**18, **keywords) -> list[PoseRaw]:
    return [raw(start_ns + k * PERIOD_NS, {7: p}, **keywords) for k, p in enumerate(positions)]


def clean_body(positions: np.ndarray, **fields: Any) -> CleanBody:
    """As in ``pose/clean``: joints (22, 3) seen to a centimetre, where ``fields`` say nothing else."""
    each, seen = np.full(22, 0.01), np.full(22, JointState.SEEN)
    body = CleanBody(1, positions, UNTURNED, seen, each, 0.0, False, each, each, positions, each)
    return replace(body, **fields)


def world_body(positions: np.ndarray, rotations: np.ndarray = UNTURNED, **fields: Any) -> WorldBody:
    """As in ``pose/world``: joints (22, 3) seen to a centimetre by a body that stands still, and bears no load."""
    each, seen = np.full(22, 0.01), np.full(22, JointState.SEEN)
    root = positions[0], rotations[0], np.zeros(3), np.eye(6)
    body = WorldBody(1, *root, positions, rotations, seen, each, np.zeros(8), Tracking.OK)
    return replace(body, **fields)
