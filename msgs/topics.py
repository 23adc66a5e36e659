"""The topics, what travels on each, and what every `pose/clean` and `pose/world` promises.

Where a joint's state is not UNKNOWN, its position, its deviation and its rotation are numbers. Rotations have norm 1,
known or not. The root of a body in the world, its velocity and covariance are numbers, and the covariance is symmetric
and positive semi-definite. The nodes publish no body that breaks this. Stamps of a source increase, until its stream
ends or begins anew.
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
POSE_TRUTH = "pose/truth"
"""the ground truth of a simulated stream"""
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
    """Raise `ValueError` unless `message` is of the type that travels on `topic`."""
    if topic not in TOPICS:
        raise ValueError(f"topic: expected one of {', '.join(TOPICS)}, got {topic!r}")
    if type(message) is not TOPICS[topic]:
        raise ValueError(f"{topic}: expected {TOPICS[topic].__name__}, got {type(message).__name__}")


NORM_TOLERANCE = 1e-3
"""how far from 1 the norm of a quaternion may be"""


def broken(body: CleanBody | WorldBody) -> str | None:
    """Which promise a body breaks; None if it keeps them all."""
    known = body.state != JointState.UNKNOWN
    if not np.isfinite(body.positions[known]).all():
        return "a position is not finite though its state is known"
    if not (np.isfinite(body.sigma[known]).all() and (body.sigma[known] >= 0).all()):
        return "a deviation is no number of 0 or more though its state is known"
    if not are_unit(body.rotations).all():
        return "a rotation is not of norm 1"
    if isinstance(body, CleanBody):
        if not (np.isfinite(body.bone_lengths).all() and (body.bone_lengths >= 0).all()):
            return "a bone's length is no number of 0 or more"
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
    """Which of quaternions (..., 4) are of norm 1."""
    with np.errstate(over="ignore"):
        norms = np.sqrt((quaternions.astype(np.float64) ** 2).sum(axis=-1))
    return np.abs(norms - 1.0) < NORM_TOLERANCE
