"""What a message of `pose/clean` says of a body, turned to the world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import CleanBody, JointState
from steadypose.prior.body.kinematics import quaternion_product, rotation_matrix
from steadypose.prior.body.skeleton import HIPS, J

Floats = NDArray[np.float64]

MIN_SIGMA = 0.001
"""Metres: no joint is taken to be known better, whatever the message says."""

HUNG_SIGMA = 0.05
"""Metres, added to a hidden root's standard deviation where other joints are seen: the prior hung it from them."""

REACH_M = 2.0
"""Metres: no joint is this far from its own root."""

_MIN_NORM = 1e-6
"""Of a quaternion that is to mean a rotation."""

_PELVIS = [J["pelvis"], *HIPS]


@dataclass(frozen=True)
class Sighting:
    """A body of one message, turned to the world.

    Attributes:
        body: as it came.
        positions: (22, 3) metres, world; NaN where there is none.
        orientation: (4,) xyzw of the root in the world, or None if it is not a rotation.
        seen: (22,) whether the sensor saw the joint.
        sigma: (22,) metres, at least `MIN_SIGMA`; infinite where the message has no number.
        root: (3,) metres, world; None if unknown.
        root_sigma: metres, the standard deviation of `root`; infinite if nothing was seen that tells where it is.
        pelvis_seen: whether the sensor saw it or a hip; else `root` was hung by the prior from joints that it saw.
    """

    body: CleanBody
    positions: Floats
    orientation: Floats | None
    seen: NDArray[np.bool_]
    sigma: Floats
    root: Floats | None
    root_sigma: float
    pelvis_seen: bool

    @property
    def root_seen(self) -> bool:
        """Whether the place of `root` rests on observation."""
        return math.isfinite(self.root_sigma)


def sightings(bodies: Sequence[CleanBody], sensor: Floats, place: Floats) -> list[Sighting]:
    """What the bodies of a message are, as seen by a sensor with this orientation (4,), a unit quaternion xyzw, and
    place (3,) in the world."""
    if not bodies:
        return []
    positions = np.array([body.positions for body in bodies], dtype=np.float64)
    positions = np.where(np.isfinite(positions), positions, np.nan) @ rotation_matrix(sensor).T + place
    state = np.array([body.state for body in bodies])
    known = np.isfinite(positions).all(axis=-1) & (state != JointState.UNKNOWN)
    known &= ~(np.linalg.norm(positions - positions[:, :1], axis=-1) > REACH_M)
    positions[~known] = np.nan
    seen = known & ((state == JointState.SEEN) | (state == JointState.REFINED))
    sigma = np.array([body.sigma for body in bodies], dtype=np.float64)
    sigma = np.maximum(np.where(sigma >= 0.0, sigma, math.inf), MIN_SIGMA)
    pelvis_seen = seen[:, _PELVIS].any(axis=1)
    root_sigma = np.where(pelvis_seen, sigma[:, 0], np.hypot(sigma[:, 0], HUNG_SIGMA))
    root_sigma = np.where(known[:, 0] & seen.any(axis=1), root_sigma, math.inf)
    turned, turns = _orientations(np.array([body.rotations[0] for body in bodies], dtype=np.float64), sensor)
    return [
        Sighting(
            body=body,
            positions=positions[k],
            orientation=turned[k] if turns[k] else None,
            seen=seen[k],
            sigma=sigma[k],
            root=positions[k, 0] if known[k, 0] else None,
            root_sigma=float(root_sigma[k]),
            pelvis_seen=bool(pelvis_seen[k]),
        )
        for k, body in enumerate(bodies)
    ]


def _orientations(quaternions: Floats, sensor: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Quaternions (N, 4) of any length turned from the sensor's frame to the world, and which of them are rotations."""
    with np.errstate(invalid="ignore"):
        turns = np.linalg.norm(quaternions, axis=1) >= _MIN_NORM
        turns &= np.isfinite(quaternions).all(axis=1)
    quaternions[~turns] = [0.0, 0.0, 0.0, 1.0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return quaternion_product(sensor, quaternions), turns


def unit_quaternion(quaternion: NDArray[np.floating]) -> Floats | None:
    """A quaternion (4,) of any length at length 1; None if it is no rotation."""
    q = np.asarray(quaternion, dtype=np.float64)
    if not np.isfinite(q).all() or (length := np.linalg.norm(q)) < _MIN_NORM:
        return None
    return q / length
