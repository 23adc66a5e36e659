"""The topics, their message types, and the guarantees of `pose/clean` and `pose/world`.

If a joint's state is not UNKNOWN, its position, standard deviation and rotation are finite. Rotations have norm 1 in
every state. In the world, a body's root pose, velocity and covariance are finite, and the covariance is symmetric and
positive semi-definite. The nodes publish no body that violates this. A source's stamps increase until its stream ends
or restarts.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import (
    CleanBody,
    Diagnostics,
    JointState,
    Message,
    PoseClean,
    PoseEvents,
    PoseRaw,
    PoseWorld,
    WorldBody,
)

POSE_RAW = "pose/raw"
POSE_CLEAN = "pose/clean"
POSE_WORLD = "pose/world"
POSE_EVENTS = "pose/events"
POSE_TRUTH = "pose/truth"  # topic of a simulated stream's ground truth
DIAGNOSTICS = "diagnostics"

TOPICS: Mapping[str, type[Message]] = MappingProxyType(
    {
        POSE_RAW: PoseRaw,
        POSE_CLEAN: PoseClean,
        POSE_WORLD: PoseWorld,
        POSE_EVENTS: PoseEvents,
        POSE_TRUTH: PoseWorld,
        DIAGNOSTICS: Diagnostics,
    }
)


def check_topic(topic: str, message: Message) -> None:
    """Raise `ValueError` unless `message` has the type of `topic`."""
    if topic not in TOPICS:
        raise ValueError(f"topic: expected one of {', '.join(TOPICS)}, got {topic!r}")
    if type(message) is not TOPICS[topic]:
        raise ValueError(f"{topic}: expected {TOPICS[topic].__name__}, got {type(message).__name__}")


NORM_TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1


def broken(body: CleanBody | WorldBody) -> str | None:
    """The guarantee that a body violates, as a text; None if it violates none."""
    known = body.state != JointState.UNKNOWN
    if not np.isfinite(body.positions[known]).all():
        return "a position is not finite though its state is known"
    if not (np.isfinite(body.sigma[known]).all() and (body.sigma[known] >= 0).all()):
        return "a standard deviation is not a number of 0 or more though its state is known"
    if not are_unit(body.rotations).all():
        return "a rotation is not of norm 1"
    if isinstance(body, CleanBody):
        if not (np.isfinite(body.bone_lengths).all() and (body.bone_lengths >= 0).all()):
            return "a bone's length is not a number of 0 or more"
        return None
    root = np.concatenate([body.root_position, body.root_velocity, body.covariance.ravel()])
    if not np.isfinite(root).all():
        return "the root is not finite"
    if not are_unit(body.root_orientation).all():
        return "the root's orientation is not of norm 1"
    scale = np.abs(body.covariance).max()
    if np.abs(body.covariance - body.covariance.T).max() > 1e-6 * scale:
        return "the covariance is not symmetric"
    if np.linalg.eigvalsh(body.covariance)[0] < -1e-6 * scale:
        return "the covariance has a negative variance"
    return None


def are_unit(quaternions: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which of the quaternions (..., 4) have norm 1, shape (...)."""
    with np.errstate(over="ignore"):
        norms = np.sqrt((quaternions.astype(np.float64) ** 2).sum(axis=-1))
    return np.abs(norms - 1.0) < NORM_TOLERANCE
