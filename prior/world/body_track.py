"""One body's way through the world: its recent motion, and the fusion of what tells where it is.

Where the root is seen, joints stay where `pose/clean` has them, but for the feet, which stand as far as they rest, and
what of the legs hangs on them by bones. Where it is not, the body goes with its root.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.contract import are_unit
from steadypose.msgs.types import JointState, Tracking, WorldBody
from steadypose.prior.body.kinematics import CONTACT_JOINTS, yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS, J, limbs
from steadypose.prior.models.contacts.inference import Contacts
from steadypose.prior.models.root_velocity.config import FRAME_S
from steadypose.prior.world.body_filter import BodyFilter, BodyNoise
from steadypose.prior.world.contact_reader import Glimpse
from steadypose.prior.world.ground import Ground
from steadypose.prior.world.legs import fit_legs, turn_legs
from steadypose.prior.world.sighting import Sighting
from steadypose.prior.world.soles import SOLE, Soles
from steadypose.prior.world.standing import VELOCITY_STATED, StandingFeet, standing_velocity

Floats = NDArray[np.float64]
Sigma = TypeVar("Sigma", float, NDArray[np.float64])

FEET: tuple[int, ...] = tuple(J[f"{side}_{part}"] for part in ("ankle", "foot") for side in ("left", "right"))
"""The joints that may stand: heels and toes."""

SOLE_SIGMA = 0.02
"""Metres, how well a foot that stands tells the ground, by `SOLE`: between sources and people, from stand to stand."""

STANDING = 0.5
"""Probability of rest from which on a foot tells the ground."""

UPRIGHT_M = 0.45
"""Metres from a foot up to the pelvis, at least, of a body whose feet tell the ground: not of one that lies."""

LYING_M = 0.25
"""Metres from the ground up to the pelvis, at most, of a body whose feet the ground tells nothing: it lies."""

EASE_S = 0.1
"""Seconds in which a body whose root is seen again comes to be where it is seen."""

UNSEEN_SIGMA = 1.0
"""Metres, the standard deviation of a first root that rests on nothing seen."""

JITTER_SHARE = 0.3
"""Of the standard deviation of a joint or velocity, the error that is new in each frame; the rest lasts."""

FOOT_SURPRISE = 3.0
"""Standard deviations from where it is seen at which a standing foot has evidently moved: it stands anew."""

IMPUTED_LEGS_SPEED = 0.5
"""m/s, added to the velocity's standard deviation as the legs that it is read from are themselves inferred."""

DOUBT_MEMORY_S = 0.5
"""Seconds over which the network's velocity is held against how a root seen moves. While it is seen, the network's
error is taken to be larger by what it is off in the mean: there is motion that it does not know."""

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

_UP = np.array([0.0, 0.0, 1.0])
_FOOT_CONTACTS = [CONTACT_JOINTS.index(joint) for joint in FEET]
_LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]


@dataclass(frozen=True)
class Motion:
    """What the network says of one body's newest frame, in the world, with the errors that validation measured.

    Attributes:
        velocity: (3,) m/s.
        sigma: (3,) m/s, standard deviation of that.
    """

    velocity: Floats
    sigma: Floats


class BodyTrack:
    """A body's state between messages.

    Args:
        sighting: the first, with a root.
        stamp_ns: of that.
        context: frames of motion to remember.
        noise: of root and feet.
        memory: (hidden,) what the contact network remembers before a body's first frame.
    """

    def __init__(
        self, sighting: Sighting, stamp_ns: int, context: int, noise: BodyNoise, memory: NDArray[np.float32]
    ) -> None:
        assert sighting.root is not None
        self.stamp_ns = stamp_ns
        self._orientation = np.array([0.0, 0.0, 0.0, 1.0]) if sighting.orientation is None else sighting.orientation
        self._window = np.repeat((REST_POSITIONS @ yaw_matrix(self.yaw).T)[None], context, axis=0)
        self._window[:] = self._local(sighting)
        self._window_ns = stamp_ns
        self._noise = noise
        self._filter = self._start(sighting, np.zeros(3))
        self._standing, self._feet = StandingFeet(len(FEET)), np.full((len(FEET), 3), np.nan)
        self._soles, self._feet_sigma = Soles(), np.full(len(FEET), np.nan)
        self._both_rest = 0.0
        self._dt = 0.0
        self._jumps = 0
        self._before = sighting
        self._nothing = self._memory = memory
        self._shift = np.zeros(3)
        self._odds = np.zeros(2)
        self._carried = False
        self._off = np.zeros(3)

    def _start(self, sighting: Sighting, velocity: Floats) -> BodyFilter:
        sigma = min(sighting.root_sigma, UNSEEN_SIGMA)
        return BodyFilter(self._noise, sighting.positions[0], *_split(sigma), velocity, len(FEET))

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

    def glimpse(self, sighting: Sighting, ground: Ground) -> Glimpse:
        """What the contact network is to read of the newest message."""
        fresh = not 0.0 < self._dt <= LONGEST_GAP_S
        before = sighting if fresh else self._before
        root_seen = sighting.root_seen and before.root_seen
        known = np.full(len(CONTACT_JOINTS), np.nan)
        if root_seen:
            soles = sighting.positions[list(FEET)] - SOLE[:, None] * _UP
            lowest = np.argmin(np.nan_to_num(soles[:, 2], nan=np.inf))
            known[:] = ground.under(soles[lowest])
            known[_FOOT_CONTACTS] = np.fmax([ground.under(sole) for sole in soles], known[_FOOT_CONTACTS])
        return Glimpse(
            sighting.positions, before.positions, FRAME_S if fresh else self._dt, self.yaw, sighting.sigma, root_seen,
            known, self._nothing if fresh else self._memory,
        )  # fmt: skip

    def fuse(
        self, sighting: Sighting, motion: Motion, contacts: Contacts, ground: Ground, network: bool, hold: bool
    ) -> None:
        """Move on to the newest message and weigh what it tells.

        Args:
            sighting: the message's.
            motion: what the network says of it.
            contacts: what bears load and what rests in it.
            ground: is asked, and told.
            network: whether to use the velocity of ``motion``.
            hold: whether feet that rest hold the root, and stand.
        """
        filter_ = self._filter
        inferred = 1.0 if sighting.root is None else 1.0 - float(sighting.seen[_LEGS].mean())
        if self._dt > LONGEST_GAP_S:
            for foot in range(len(FEET)):
                filter_.lose(foot)
        held = hold and sighting.root is not None
        told = sighting.seen[list(FEET)] | sighting.root_seen  # what nobody saw may stand, but must not hold the root
        believed = told & (filter_.feet_off < FOOT_SURPRISE) & held
        load, rest = (believed * said[_FOOT_CONTACTS].astype(np.float64) for said in (contacts.load, contacts.rest))
        if self._dt > 0.0:
            filter_.predict(self._dt, load, rest)
        self._weigh_legs(sighting, motion)
        if network and not self._carried:
            sigma = np.hypot(motion.sigma, inferred * IMPUTED_LEGS_SPEED)
            if sighting.root_seen:
                sigma = np.hypot(sigma, self._off_by(sighting, motion))
            filter_.observe_velocity(motion.velocity, *_split(sigma))
        in_the_world = self._observe_root(sighting)
        self._observe_feet(sighting, in_the_world)
        self._meet_ground(sighting, rest, ground)
        self._stand(sighting, rest, ground)
        self._both_rest = float(rest.reshape(2, 2).max(axis=0).min()) if sighting.root_seen else 0.0
        if sighting.root is not None and not sighting.root_seen:
            self._shift = self._filter.position - sighting.root
        else:
            self._shift *= math.exp(-self._dt / EASE_S)
        self._before, self._memory = sighting, contacts.state

    def _off_by(self, sighting: Sighting, motion: Motion) -> float:
        """m/s, by how much the network's velocity is off of late from that of the root seen."""
        if self._before.root_seen and self._dt > 0.0:
            moved = (sighting.positions[0] - self._before.positions[0]) / self._dt
            self._off += (1.0 - math.exp(-self._dt / DOUBT_MEMORY_S)) * (moved - motion.velocity - self._off)
        return float(np.linalg.norm(self._off))

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

    def _observe_root(self, sighting: Sighting) -> bool:
        """Take the root as it is seen; whether it is believed, and so where other joints are seen as well."""
        came_back = sighting.root_seen and not self._before.root_seen
        if sighting.root is None or not sighting.root_seen:
            return False
        sigma = sighting.root_sigma
        off = np.abs(sighting.root - self._filter.position)
        likely = JUMP_SIGMAS * np.hypot(self._filter.position_sigma, sigma)
        self._jumps = self._jumps + 1 if np.any(off > np.maximum(likely, JUMP_M)) else 0
        if not self._jumps:
            self._filter.observe_position(sighting.root, *_split(sigma))
        elif came_back or self._jumps == JUMP_FRAMES:
            self._filter = self._start(sighting, self._filter.velocity if came_back else np.zeros(3))
            self._jumps = 0
        return not self._jumps

    def _observe_feet(self, sighting: Sighting, in_the_world: bool) -> None:
        if sighting.root is None:
            return
        places = sighting.positions[list(FEET)] - (0.0 if in_the_world else sighting.root)
        for foot, joint in enumerate(FEET):
            if np.isfinite(places[foot]).all() and math.isfinite(sighting.sigma[joint]):
                jitter, bias = _split(float(sighting.sigma[joint]))
                self._filter.observe_foot(foot, places[foot], jitter, bias, from_root=not in_the_world)
            else:
                self._filter.lose(foot)

    def _meet_ground(self, sighting: Sighting, rest: Floats, ground: Ground) -> None:
        """Tell the ground where feet stand while the root is seen, and be told it while it is not."""
        soles = sighting.positions[list(FEET)] - SOLE[:, None] * _UP
        if not ground.known and sighting.seen[list(FEET)].any():
            ground.guess(float(np.nanmin(soles[:, 2])))
        for k in np.flatnonzero((rest > STANDING) & self._filter.placed):
            if sighting.root_seen:
                if sighting.positions[0, 2] - soles[k, 2] > UPRIGHT_M:
                    sigma = math.hypot(sighting.sigma[FEET[k]], SOLE_SIGMA)
                    ground.observe(soles[k], sigma, max(self._dt, FRAME_S))
            elif ground.known:
                under = ground.under(self._filter.feet[k] - SOLE[k] * _UP)
                if math.isfinite(under):
                    self._filter.observe_foot_height(int(k), under + SOLE[k], math.hypot(ground.sigma, SOLE_SIGMA))

    def _stand(self, sighting: Sighting, rest: Floats, ground: Ground) -> None:
        """Find where the feet are, by filter and ground, and keep those still that rest."""
        feet, spread = np.where(self._filter.placed[:, None], self._filter.feet, np.nan), self._filter.feet_sigma
        floor = np.array([ground.under(foot) for foot in feet - self._soles.heights[:, None] * _UP])
        seen, sigma = sighting.positions[list(FEET), 2], sighting.sigma[list(FEET)]
        # What the filter takes to fade with time is, of a sensor, in part an offset of a foot that stays.
        variance = spread[:, 2] ** 2 + np.where(np.isfinite(sigma), sigma, 0.0) ** 2
        raised = self._filter.position[2] - np.nan_to_num(floor)
        upright = np.clip((raised - LYING_M) / (UPRIGHT_M - LYING_M), 0.0, 1.0)
        feet[:, 2], settled, stands = self._soles.settle(
            feet[:, 2], variance, floor, ground.sigma, rest, upright, self._dt
        )
        if sighting.root_seen:
            self._soles.learn(seen - floor, sigma, stands, max(self._dt, FRAME_S))
        self._feet = self._standing.update(feet, np.sqrt(np.mean(spread**2, axis=1)), rest, self._dt)
        spread[:, 2] = np.minimum(spread[:, 2], np.sqrt(settled))  # else bones would draw at a foot that is held
        self._feet_sigma = np.sqrt(np.mean(spread**2, axis=1))

    def publish(self, sighting: Sighting, contacts: Contacts, lost_sigma: float) -> WorldBody:
        """The body in the world, as of the newest message."""
        place, spread = self._filter.position, self._filter.position_sigma
        strays = 0.0 if sighting.root_seen else float(np.mean(spread**2))
        sigma = np.sqrt(sighting.sigma**2 + strays)
        moved = sighting.positions + self._shift
        placed = self._filter.placed
        feet = np.array(FEET)[placed]
        moved[feet], sigma[feet] = self._feet[placed], self._feet_sigma[placed]
        moved[0], sigma[0] = place, math.sqrt(float(np.mean(spread**2)))
        positions = fit_legs(moved, sigma, sighting.body.bone_lengths)
        rotations = sighting.body.rotations.astype(np.float64)
        rotations[0] = self._orientation
        rotations = turn_legs(rotations, sighting.positions, positions)
        rotations[~are_unit(rotations)] = [0.0, 0.0, 0.0, 1.0]  # a message of somebody who knows positions alone
        told = np.isfinite(positions).all(axis=1) & np.isfinite(sigma)
        state = np.where(told, sighting.body.state, JointState.UNKNOWN)
        if math.hypot(*spread[:2]) > lost_sigma:
            tracking = Tracking.LOST
        else:
            tracking = Tracking.OK if sighting.root_seen else Tracking.COASTING
        velocity, covariance = standing_velocity(
            self._filter.velocity,
            self._filter.covariance,
            self._both_rest,
            stated=VELOCITY_STATED if sighting.pelvis_seen else 1.0,
        )
        return WorldBody(
            id=sighting.body.id,
            root_position=place,
            root_orientation=self._orientation,
            root_velocity=velocity,
            covariance=covariance,
            positions=positions,
            rotations=rotations,
            state=state,
            sigma=sigma,
            contacts=contacts.load,
            tracking=tracking,
        )


def _heading(orientation: Floats) -> float:
    """`kinematics.heading` of a unit quaternion (4,) xyzw: where the body's left axis, R (0, 1, 0), says it looks."""
    x, y, z, w = orientation.tolist()
    return math.atan2(2.0 * (w * z - x * y), 1.0 - 2.0 * (x * x + z * z))


def _split(sigma: Sigma) -> tuple[Sigma, Sigma]:
    """The standard deviations of the jitter and of the slow error that make up ``sigma``."""
    return JITTER_SHARE * sigma, math.sqrt(1.0 - JITTER_SHARE**2) * sigma
