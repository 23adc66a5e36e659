"""One body's way through the world: its recent motion, and the fusion of what tells where it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs.contract import are_unit
from steadypose.msgs.types import CleanBody, JointState, Tracking, WorldBody
from steadypose.prior.body.kinematics import CONTACT_JOINTS, yaw_matrix
from steadypose.prior.body.skeleton import HIPS, REST_POSITIONS, J, limbs
from steadypose.prior.models.root_velocity.config import FRAME_S
from steadypose.prior.world.ground import Ground
from steadypose.prior.world.root_filter import RootFilter, RootNoise

Floats = NDArray[np.float64]
Sigma = TypeVar("Sigma", float, NDArray[np.float64])

FEET: tuple[int, ...] = tuple(J[f"{side}_{part}"] for part in ("ankle", "foot") for side in ("left", "right"))
"""The joints that may stand: heels and toes."""

SOLE: Floats = np.array([0.07, 0.07, 0.022, 0.022])
"""(4,) metres from the floor to each of `FEET` while it stands: the median over labelled contacts of the training
motion, the mean over its five sources."""

SOLE_SIGMA = 0.02
"""Metres, the standard deviation of that between sources and people."""

CONTACT_ON, CONTACT_OFF = 0.6, 0.3
"""Probabilities at which a foot comes to stand, and stands no more."""

UNSEEN_SIGMA = 1.0
"""Metres, the standard deviation of a first root that rests on nothing seen."""

JITTER_SHARE = 0.3
"""Of the standard deviation of a joint or velocity, the error that is new in each frame; the rest lasts."""

FOOT_SURPRISE = 4.0
"""Standard deviations from its place at which a standing foot has evidently moved: it stands anew."""

LEAST_SIGMA = 0.005
"""Metres: no joint is taken to be known better, whatever the message says."""

HUNG_SIGMA = 0.05
"""Metres, added to a hidden root's standard deviation where other joints are seen: the prior hung it from them."""

IMPUTED_LEGS_SPEED = 0.5
"""m/s, added to the velocity's standard deviation as the legs that it is read from are themselves inferred."""

REACH_M = 2.0
"""Metres: no joint is this far from its own root."""

JUMP_SIGMAS, JUMP_M, JUMP_FRAMES = 5.0, 0.3, 6
"""A root seen this many standard deviations and metres off is not believed, until it was so often in a row; one that
comes back into sight is believed at once. Both start the filter anew."""

AT_ODDS_SIGMAS, AT_ODDS_MEMORY_S = 2.0, 0.2
"""A root seen so many standard deviations off, in the mean over about so long, is carried along by what it stands on:
what the legs say of the motion, by feet and network, is not the motion in the world."""

AT_ONE_SPEED = 0.3
"""m/s: where the legs say again what is seen, to this much, they are believed again."""

LONGEST_GAP_S = 0.3
"""Seconds without a message over which the motion between is drawn straight, and feet may go on standing."""

_LEAST_NORM = 1e-6
"""Of a quaternion that is to mean a rotation."""

_FOOT_CONTACTS = [CONTACT_JOINTS.index(joint) for joint in FEET]
_PELVIS = [J["pelvis"], *HIPS]
_LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]


@dataclass(frozen=True)
class Sighting:
    """A body of one message, turned to the world.

    Attributes:
        body: as it came.
        positions: (22, 3) metres, world; NaN where there is none.
        orientation: (4,) xyzw of the root in the world, or None if it is not a rotation.
        seen: (22,) whether the sensor saw the joint.
        sigma: (22,) metres, at least `LEAST_SIGMA`; infinite where the message has no number.
        root: (3,) metres, world; None if unknown.
        root_sigma: metres, the standard deviation of `root`; infinite if nothing was seen that tells where it is.
    """

    body: CleanBody
    positions: Floats
    orientation: Floats | None
    seen: NDArray[np.bool_]
    sigma: Floats
    root: Floats | None
    root_sigma: float

    @property
    def root_seen(self) -> bool:
        """Whether the place of `root` rests on observation."""
        return math.isfinite(self.root_sigma)


def sightings(bodies: Sequence[CleanBody], sensor: Rotation, place: Floats) -> list[Sighting]:
    """What the bodies of a message are, as seen by a sensor with this orientation and place (3,) in the world."""
    if not bodies:
        return []
    positions = np.array([body.positions for body in bodies], dtype=np.float64)
    positions = np.where(np.isfinite(positions), positions, np.nan) @ sensor.as_matrix().T + place
    state = np.array([body.state for body in bodies])
    known = np.isfinite(positions).all(axis=-1) & (state != JointState.UNKNOWN)
    known &= ~(np.linalg.norm(positions - positions[:, :1], axis=-1) > REACH_M)
    positions[~known] = np.nan
    seen = known & ((state == JointState.SEEN) | (state == JointState.REFINED))
    sigma = np.array([body.sigma for body in bodies], dtype=np.float64)
    sigma = np.maximum(np.where(sigma >= 0.0, sigma, math.inf), LEAST_SIGMA)
    # A root of which no joint near is seen was hung by the prior from those that are.
    root_sigma = np.where(seen[:, _PELVIS].any(axis=1), sigma[:, 0], np.hypot(sigma[:, 0], HUNG_SIGMA))
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
        )
        for k, body in enumerate(bodies)
    ]


def _orientations(quaternions: Floats, sensor: Rotation) -> tuple[Floats, NDArray[np.bool_]]:
    """Quaternions (N, 4) of any length turned from the sensor's frame to the world, and which of them are rotations."""
    with np.errstate(invalid="ignore"):
        turns = np.linalg.norm(quaternions, axis=1) >= _LEAST_NORM
        turns &= np.isfinite(quaternions).all(axis=1)
    quaternions[~turns] = [0.0, 0.0, 0.0, 1.0]
    return (sensor * Rotation.from_quat(quaternions)).as_quat(), turns


@dataclass(frozen=True)
class Motion:
    """What the network says of one body's newest frame, in the world, with the errors that validation measured.

    Attributes:
        velocity: (3,) m/s.
        sigma: (3,) m/s, standard deviation of that.
        contacts: (8,) probabilities.
    """

    velocity: Floats
    sigma: Floats
    contacts: Floats


class BodyTrack:
    """A body's state between messages.

    Args:
        sighting: the first, with a root.
        stamp_ns: of that.
        context: frames of motion to remember.
        noise: of the root.
    """

    def __init__(self, sighting: Sighting, stamp_ns: int, context: int, noise: RootNoise) -> None:
        assert sighting.root is not None
        self.stamp_ns = stamp_ns
        self._orientation = np.array([0.0, 0.0, 0.0, 1.0]) if sighting.orientation is None else sighting.orientation
        self._window = np.repeat((REST_POSITIONS @ yaw_matrix(self.yaw).T)[None], context, axis=0)
        self._window[:] = self._local(sighting)
        self._window_ns = stamp_ns
        self._noise = noise
        self._filter = self._start(sighting, np.zeros(3))
        self._dt = 0.0
        self._jumps = 0
        self._root_seen = sighting.root_seen
        self._odds = np.zeros(2)
        self._carried = False

    def _start(self, sighting: Sighting, velocity: Floats) -> RootFilter:
        sigma = min(sighting.root_sigma, UNSEEN_SIGMA)
        return RootFilter(self._noise, sighting.positions[0], *_split(sigma), velocity, len(FEET))

    def _local(self, sighting: Sighting) -> Floats:
        """(22, 3) metres from the root, world axes; a joint without a position stays where it last was."""
        local = sighting.positions - sighting.positions[0]
        return np.where(np.isfinite(local), local, self._window[-1])

    @property
    def yaw(self) -> float:
        """Radians, the newest heading."""
        return _heading(self._orientation)

    def window(self) -> Floats:
        """(context, 22, 3) metres from the root, turned so that the body now faces +x: the network's input."""
        return self._window @ yaw_matrix(self.yaw)

    def advance(self, sighting: Sighting, stamp_ns: int) -> None:
        """Take in the pose of the next message, at ``stamp_ns``."""
        self._dt = (stamp_ns - self.stamp_ns) * 1e-9
        self.stamp_ns = stamp_ns
        if sighting.orientation is not None:
            self._orientation = sighting.orientation
        local = self._local(sighting)
        steps = round((stamp_ns - self._window_ns) * 1e-9 / FRAME_S)
        if self._dt > LONGEST_GAP_S:
            self._window[:] = local
        else:
            between = np.linspace(0.0, 1.0, steps + 1)[1:, None, None]
            new = self._window[-1] + between * (local - self._window[-1])
            self._window = np.concatenate([self._window, new])[-len(self._window) :]
            self._window[-1] = local
        if steps:
            self._window_ns = stamp_ns

    def fuse(self, sighting: Sighting, motion: Motion, ground: Ground, network: bool, hold: bool) -> None:
        """Move on to the newest message and weigh what it tells.

        Args:
            sighting: the message's.
            motion: what the network says of it.
            ground: is asked, and told.
            network: whether to use the velocity of ``motion``.
            hold: whether feet in contact hold the root.
        """
        filter_ = self._filter
        inferred = 1.0 if sighting.root is None else 1.0 - float(sighting.seen[_LEGS].mean())
        contacts = motion.contacts[_FOOT_CONTACTS]
        held = hold and sighting.root is not None and self._dt <= LONGEST_GAP_S
        standing = filter_.standing
        if self._dt > 0.0:
            filter_.predict(self._dt)
        self._weigh_legs(sighting, motion)
        if network and not self._carried:
            filter_.observe_velocity(motion.velocity, *_split(np.hypot(motion.sigma, inferred * IMPUTED_LEGS_SPEED)))
        contacts = np.where(held and not self._carried, contacts * sighting.seen[list(FEET)], 0.0)
        self._observe_root(sighting)
        for k, joint in enumerate(FEET):
            if contacts[k] < (CONTACT_OFF if standing[k] else CONTACT_ON):
                filter_.lift(k)
                continue
            from_root = sighting.positions[joint] - sighting.positions[0]
            sigma = float(sighting.sigma[joint])
            if standing[k] and filter_.foot_surprise(k, from_root, sigma) < FOOT_SURPRISE:
                filter_.observe_foot(k, from_root, sigma)
            else:
                filter_.plant(k, from_root, sigma)
        self._meet_ground(sighting, ground)

    def _weigh_legs(self, sighting: Sighting, motion: Motion) -> None:
        """Find out whether what the legs say of the motion can be reconciled with the root seen, horizontally."""
        if sighting.root is None or not sighting.root_seen:
            self._odds[:], self._carried = 0.0, False
            return
        off = (sighting.root - self._filter.position)[:2]
        likely = np.hypot(self._filter.position_sigma[:2], sighting.root_sigma)
        self._odds += (1.0 - math.exp(-self._dt / AT_ODDS_MEMORY_S)) * (off / likely - self._odds)
        at_odds = float(np.linalg.norm(self._odds))
        disagreement = float(np.linalg.norm((self._filter.velocity - motion.velocity)[:2]))
        self._carried = at_odds > AT_ODDS_SIGMAS or (self._carried and disagreement > AT_ONE_SPEED)

    def _observe_root(self, sighting: Sighting) -> None:
        came_back, self._root_seen = sighting.root_seen and not self._root_seen, sighting.root_seen
        if sighting.root is None or not sighting.root_seen:
            return
        sigma = sighting.root_sigma
        off = np.abs(sighting.root - self._filter.position)
        likely = JUMP_SIGMAS * np.hypot(self._filter.position_sigma, sigma)
        self._jumps = self._jumps + 1 if np.any(off > np.maximum(likely, JUMP_M)) else 0
        if not self._jumps:
            self._filter.observe_position(sighting.root, *_split(sigma))
        elif came_back or self._jumps == JUMP_FRAMES:
            self._filter = self._start(sighting, self._filter.velocity if came_back else np.zeros(3))
            self._jumps = 0

    def _meet_ground(self, sighting: Sighting, ground: Ground) -> None:
        """Tell the ground where feet stand while the root is seen, and be told it while it is not."""
        feet = sighting.positions[list(FEET), 2] - SOLE
        if not ground.known and sighting.seen[list(FEET)].any():
            ground.guess(float(np.nanmin(feet)))
        for k in np.flatnonzero(self._filter.standing):
            if sighting.root_seen:
                ground.observe(float(feet[k]), math.hypot(sighting.sigma[FEET[k]], SOLE_SIGMA), max(self._dt, FRAME_S))
            elif ground.known:
                sigma = math.hypot(ground.sigma, SOLE_SIGMA)
                self._filter.observe_foot_height(int(k), ground.height + SOLE[k], sigma)

    def publish(self, sighting: Sighting, contacts: NDArray[np.floating], lost_sigma: float) -> WorldBody:
        """The body in the world, as of the newest message."""
        place, spread = self._filter.position, self._filter.position_sigma
        positions = sighting.positions if sighting.root is None else sighting.positions + (place - sighting.root)
        positions = np.where(np.arange(len(positions))[:, None] == 0, place, positions)
        sigma = np.hypot(sighting.sigma, math.sqrt(float(np.mean(spread**2))))
        told = np.isfinite(positions).all(axis=1) & np.isfinite(sigma)
        state = np.where(told, sighting.body.state, JointState.UNKNOWN)
        rotations = sighting.body.rotations.copy()
        rotations[0] = self._orientation
        rotations[~are_unit(rotations)] = [0.0, 0.0, 0.0, 1.0]  # a message of somebody who knows positions alone
        if math.hypot(*spread[:2]) > lost_sigma:
            tracking = Tracking.LOST
        else:
            tracking = Tracking.OK if sighting.root_seen else Tracking.COASTING
        return WorldBody(
            id=sighting.body.id,
            root_position=place,
            root_orientation=self._orientation,
            root_velocity=self._filter.velocity,
            covariance=self._filter.covariance,
            positions=positions,
            rotations=rotations,
            state=state,
            sigma=sigma,
            contacts=contacts.astype(np.float32),
            tracking=tracking,
        )


def _heading(orientation: Floats) -> float:
    """`kinematics.heading` of a unit quaternion (4,) xyzw: where the body's left axis, R (0, 1, 0), says it looks."""
    x, y, z, w = orientation.tolist()
    return math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))


def _split(sigma: Sigma) -> tuple[Sigma, Sigma]:
    """The standard deviations of the jitter and of the slow error that make up ``sigma``."""
    return JITTER_SHARE * sigma, math.sqrt(1.0 - JITTER_SHARE**2) * sigma


def rotation(quaternion: NDArray[np.floating]) -> Rotation | None:
    """The rotation of a quaternion (4,) xyzw of any length; None if it is none."""
    q = np.asarray(quaternion, dtype=np.float64)
    if not np.isfinite(q).all() or np.linalg.norm(q) < _LEAST_NORM:
        return None
    return Rotation.from_quat(q)
