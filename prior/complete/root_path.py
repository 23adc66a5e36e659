"""The root's path of a body whose joints are known about its root only: its velocity, read from the body's motion, is
integrated (HM-VAE, section 3.3 and Figure 5)."""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT, heading, yaw_matrix
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, velocity_features
from steadypose.prior.timing.rate import FPS

STILL_M, MOVING_M = 1e-3, 0.03
"""Metres: extent of a root below which it is the origin of its coordinates, if another joint's is above the second."""

_FEET = slice(2, 6)
_EDGES = ((np.max, 1.0), (np.min, -1.0))


def is_root_centred(positions: Floats) -> bool:
    """Whether joints (T, 22, 3) metres, NaN where unknown, are about their pelvis: it stays while others move."""
    known = finite_joints(positions)
    if known[:, 0].sum() < FPS // 3:
        return False
    most, least = (edge(np.where(known[..., None], positions, -sign * np.inf), axis=0) for edge, sign in _EDGES)
    ever = np.asarray(known.any(axis=0))
    spread = np.where(ever[:, None], most - least, 0.0).max(axis=-1)
    return bool(spread[0] < STILL_M and spread[1:].max() > MOVING_M)


def velocities(network: LiveRootVelocity, joints: Floats, root_rotations: Floats) -> Floats:
    """(T, 3) m/s, world: velocities of the root.

    Args:
        network: run on one frame after the other.
        joints: (T, 22, 3) metres from the root, z up.
        root_rotations: (T, 3, 3) to the world.
    """
    yaw = heading(root_rotations)
    features = velocity_features(joints, np.concatenate([joints[:1], joints[:-1]]), FRAME_S, yaw)
    state, predicted = network.start(1), np.empty((len(joints), 3))
    for t, frame in enumerate(features):
        velocity, _, state = network(frame[None], state)
        predicted[t] = velocity[0]
    return (yaw_matrix(yaw) @ predicted[..., None])[..., 0]


def root_path(network: LiveRootVelocity, joints: Floats, root_rotations: Floats) -> Floats:
    """(T, 3) metres, world: the root's path from above the origin, with the lower foot always on the floor.

    The arguments are those of `velocities`.
    """
    path = np.cumsum(velocities(network, joints, root_rotations), axis=0) * FRAME_S
    path -= path[0]
    feet = joints[:, list(CONTACT_JOINTS)[_FEET], 2] - REST_HEIGHT[_FEET]
    path[:, 2] = -feet.min(axis=1)
    return path


def bridge(network: LiveRootVelocity, joints: Floats, root_rotations: Floats, ends: Floats) -> Floats:
    """(K, 3) metres, world: the root's path over the last K frames between two known ends; the closing error of the
    integrated velocities is spread evenly over the frames.

    Args:
        network, joints, root_rotations: of `velocities`, of T frames.
        ends: (K, 3) metres, world, of the last K of the T frames; the first row and the last are known.
    """
    steps = velocities(network, joints, root_rotations)[-len(ends) :] * FRAME_S
    way = np.cumsum(steps, axis=0)
    way += ends[0] - way[0]
    return way + np.linspace(0.0, 1.0, len(way))[:, None] * (ends[-1] - way[-1])
