"""Converts the bodies of a `pose/clean` message to observations in the world's frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import CONTACTS, CleanBody, JointState
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import quaternion_product, rotation_matrix
from steadypose.prior.body.skeleton import HIPS, J

FEET: tuple[int, ...] = tuple(J[f"{side}_{part}"] for part in ("ankle", "foot") for side in ("left", "right"))
"""Joints that can stand on the floor: left and right heel, left and right toes."""

SOLE: Floats = np.array([0.07, 0.07, 0.022, 0.022])
"""Heights (4,) of `FEET` above the floor while they stand, metres. Medians over labelled contacts in each of the five
sources of training motion, averaged over the sources."""

MIN_SIGMA = 0.001  # least standard deviation of a joint, which replaces smaller ones in the message, metres

UNOBSERVED_ROOT_SIGMA = 0.05
"""Standard deviation added to that of a root which the prior inferred from other observed joints, metres."""

ON_SPINE_SIGMA = 0.02
"""Standard deviation of a hidden root relative to an observed joint of the spine above it, along an axis, metres. In
bundled streams with 1 cm of noise, hips and legs hidden, the root's whole error along an axis is 0.005 to 0.012."""

REACH_M = 2.0
"""Largest distance of a joint from its root; joints beyond it are rejected, metres."""

LONGEST_GAP_S = 0.3
"""Longest gap between messages over which motion is interpolated and feet may keep standing, seconds."""

_MIN_NORM = 1e-6  # least norm of a quaternion that is a rotation
_PELVIS, _SPINE = [J["pelvis"], *HIPS], J["spine1"]
_FEET, _SOLE_OFFSETS = list(FEET), SOLE[:, None] * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class BodyObservation:
    """A body of one message, in the world."""

    body: CleanBody  # the body in the message, unchanged
    stamp_ns: int  # stamp of the message
    dt: float  # seconds since the last message with this body; 0 in the first
    positions: Floats  # (22, 3) metres; NaN where unknown
    orientation: Floats  # (4,) xyzw, orientation of the root; the last valid one if the message has none
    observed: Bools  # (22,) whether each joint was observed and not inferred
    sigma: Floats  # (22,) metres, standard deviations, at least `MIN_SIGMA`; infinite where the message has none
    root_sigma: float  # metres, standard deviation of the root's position; infinite if no observation supports it
    pelvis_observed: bool
    """whether the pelvis or a hip was observed; if not, the prior inferred the root from other joints"""

    @property
    def root_known(self) -> bool:
        """Whether the root has a position, observed or inferred."""
        return math.isfinite(self.positions[0, 0])

    @property
    def root_observed(self) -> bool:
        """Whether observations support the root's position."""
        return math.isfinite(self.root_sigma)

    @property
    def after_gap(self) -> bool:
        """Whether this is the body's first observation, or the first after a gap of more than `LONGEST_GAP_S`."""
        return not 0.0 < self.dt <= LONGEST_GAP_S

    @property
    def yaw(self) -> float:
        """Heading in radians: `kinematics.heading` of the orientation R, where R (0, 1, 0) is the body's left."""
        x, y, z, w = self.orientation.tolist()
        return math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))

    @property
    def feet(self) -> Floats:
        """(4, 3) metres, positions of `FEET`."""
        return self.positions[_FEET]

    @property
    def feet_sigma(self) -> Floats:
        """(4,) metres, standard deviations of `FEET`."""
        return self.sigma[_FEET]

    @property
    def feet_observed(self) -> Bools:
        """(4,) whether each of `FEET` was observed."""
        return self.observed[_FEET]

    @property
    def soles(self) -> Floats:
        """(4, 3) metres, the points of the soles under `FEET` if the body stands."""
        return self.feet - _SOLE_OFFSETS


def observe(
    bodies: Sequence[CleanBody], stamp_ns: int, orientation: Floats, position: Floats,
    last: Mapping[int, BodyObservation],
) -> list[BodyObservation]:  # fmt: skip
    """Convert the bodies of a message, each id once, to observations in the world, in which the sensor has this
    orientation (4,) xyzw and position (3,) metres. ``last`` is each body's last observation, by id."""
    if not bodies:
        return []
    positions = np.array([body.positions for body in bodies], dtype=np.float64)
    positions = np.where(np.isfinite(positions), positions, np.nan) @ rotation_matrix(orientation).T + position
    state = np.array([body.state for body in bodies])
    known = np.isfinite(positions).all(axis=-1) & (state != JointState.UNKNOWN)
    known &= ~(np.linalg.norm(positions - positions[:, :1], axis=-1) > REACH_M)
    positions[~known] = np.nan
    observed = known & ((state == JointState.SEEN) | (state == JointState.REFINED))
    sigma = np.array([body.sigma for body in bodies], dtype=np.float64)
    sigma = np.maximum(np.where(sigma >= 0.0, sigma, math.inf), MIN_SIGMA)
    pelvis_observed = observed[:, _PELVIS].any(axis=1)
    root_sigma = np.where(pelvis_observed, sigma[:, 0], np.hypot(sigma[:, 0], UNOBSERVED_ROOT_SIGMA))
    on_spine = np.where(observed[:, _SPINE], np.hypot(sigma[:, _SPINE], ON_SPINE_SIGMA), math.inf)
    root_sigma = np.where(pelvis_observed, root_sigma, np.minimum(root_sigma, on_spine))
    root_sigma = np.where(known[:, 0] & observed.any(axis=1), root_sigma, math.inf)
    roots, valid = _orientations(np.array([body.rotations[0] for body in bodies], dtype=np.float64), orientation)
    observations = []
    for k, body in enumerate(bodies):
        before = last.get(body.id)
        held = np.array([0.0, 0.0, 0.0, 1.0]) if before is None else before.orientation
        observations.append(BodyObservation(
            body, stamp_ns, 0.0 if before is None else (stamp_ns - before.stamp_ns) * 1e-9, positions[k],
            roots[k] if valid[k] else held, observed[k], sigma[k], float(root_sigma[k]), bool(pelvis_observed[k]),
        ))  # fmt: skip
    return observations


def _orientations(quaternions: Floats, sensor: Floats) -> tuple[Floats, Bools]:
    """Turn quaternions (N, 4) of any norm from the sensor's frame to the world; also returns which are rotations."""
    with np.errstate(invalid="ignore"):
        valid = np.linalg.norm(quaternions, axis=1) >= _MIN_NORM
        valid &= np.isfinite(quaternions).all(axis=1)
    quaternions[~valid] = [0.0, 0.0, 0.0, 1.0]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return quaternion_product(sensor, quaternions), valid


def unit_quaternion(quaternion: NDArray[np.floating]) -> Floats | None:
    """Normalise a quaternion (4,); None if it is no rotation."""
    q = np.asarray(quaternion, dtype=np.float64)
    if not np.isfinite(q).all() or (length := np.linalg.norm(q)) < _MIN_NORM:
        return None
    return q / length


GUESSED_S = 2.0
"""Time from which an unobserved joint of a leg is only a guess, seconds. On simulated people, the Brier skill score of
predicted contacts of feet against their mean is 0.36 while the feet are observed, 0.28 in the first 2 s after that,
0.02 later, and -0.21 for feet never observed (benchmarks/NOTEBOOK.md)."""

LEG_CONTACTS = slice(0, 6)  # the joints of legs among `CONTACTS`: knees, ankles and feet, left before right
FEET_OF_LEGS = slice(2, 6)  # `FEET` among them

_JOINTS = [J[name] for name in CONTACTS[LEG_CONTACTS]]


class LegMemory:
    """Time for which one body's knees and feet have been unobserved; a new body's were never observed."""

    def __init__(self) -> None:
        self._unobserved_s = np.full(len(_JOINTS), np.inf)

    def update(self, observed: BodyObservation) -> Bools:
        """Return which joints of legs (6,), in the order of `LEG_CONTACTS`, are only guesses.

        A foot is observed if its ankle or its toes are, because many sensors have no toes. An observed foot also
        determines its knee.
        """
        knees, *feet = observed.observed[_JOINTS].reshape(3, 2)
        foot = np.any(feet, axis=0)
        self._unobserved_s = np.where([*(knees | foot), *foot, *foot], 0.0, self._unobserved_s + observed.dt)
        return self._unobserved_s >= GUESSED_S
