"""A body's root and feet: which observations and predictions its Kalman filter takes, and how far it trusts them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.world.floor import SOLE_SIGMA, STANDING, Floor
from steadypose.prior.world.kalman import BodyFilter, BodyNoise
from steadypose.prior.world.networks import RootVelocity, Stance
from steadypose.prior.world.observe import FEET, SOLE, BodyObservation

Sigma = TypeVar("Sigma", float, NDArray[np.float64])

EASE_S = 0.1
"""Time constant by which a body whose root is observed again comes to be where it is observed, seconds."""

FIRST_SIGMA = 1.0
"""Standard deviation of a first root that rests on no observation, metres."""

JITTER_SHARE = 0.3
"""Share of the standard deviation of a joint or velocity that is new in each frame; the rest is slow bias."""

INFERRED_LEGS_SPEED = 0.5
"""Standard deviation added to the predicted velocity's as the legs that it is read from are themselves inferred,
m/s."""

OFF_MEMORY_S = 0.5
"""Time constant of the predicted velocity's mean error against an observed root, seconds. While the root is observed,
that is added to its standard deviation: there is motion that the network does not know."""

JUMP_SIGMAS, JUMP_M, JUMP_FRAMES = 5.0, 0.3, 6
"""Distance from which on an observed root is gated out, standard deviations and metres; and for how many frames in a
row. One that was unobserved before is not. Either way the filter then starts anew."""

AT_ODDS_SIGMAS, AT_ODDS_MEMORY_S = 2.0, 0.2
"""Mean distance of the observed root from which on the body is carried along by what it stands on, standard deviations,
and its time constant, seconds: motion as feet and network have it is then not the motion in the world."""

AT_ONE_SPEED = 0.3
"""Difference between predicted and estimated velocity up to which the prediction is used again, m/s."""

_LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class RootState:
    """A body's estimated root and feet, in the world.

    Attributes:
        position: (3,) metres, of the root.
        velocity: (3,) m/s, of the root.
        covariance: (6, 6) of [position, velocity]: m², m²/s, m²/s².
        feet: (4, 3) metres, of `FEET`; NaN where not placed.
        feet_sigma: (4, 3) metres, standard deviations along each axis.
        shift: (3,) metres by which the body's other joints go with an unobserved root; fades once it is observed.
    """

    position: Floats
    velocity: Floats
    covariance: Floats
    feet: Floats
    feet_sigma: Floats
    shift: Floats

    @property
    def position_sigma(self) -> Floats:
        """(3,) metres, standard deviation along each axis."""
        return np.sqrt(np.diag(self.covariance)[:3])


class RootFilter:
    """Fuses what is observed and predicted of one body's root and feet.

    Args:
        first: the body's first observation with a root.
        noise: of root and feet.
    """

    def __init__(self, first: BodyObservation, noise: BodyNoise) -> None:
        self._noise, self._before = noise, first
        self._kalman = self._start(first, np.zeros(3))
        self._shift, self._off, self._odds = np.zeros(3), np.zeros(3), np.zeros(2)
        self._jumps, self._carried = 0, False

    @property
    def feet_off(self) -> Floats:
        """(4,) standard deviations, of the sensor's error of each foot along its worst axis, as of the last frame."""
        return self._kalman.feet_off

    def update(
        self, observed: BodyObservation, velocity: RootVelocity | None, stance: Stance, floor: Floor
    ) -> RootState:
        """Predict to the newest observation, and take in what is known of it.

        Args:
            observed: the newest observation.
            velocity: the predicted root velocity; None if it is not to be used.
            stance: feet that may hold the root.
            floor: measures the height of feet that stand under an unobserved root.
        """
        if observed.after_gap:
            for foot in range(len(FEET)):
                self._kalman.lose(foot)
        if observed.dt > 0.0:
            self._kalman.predict(observed.dt, stance.load, stance.rest)
        if velocity is not None:
            self._observe_velocity(observed, velocity)
        self._observe_feet(observed, in_world=self._observe_root(observed))
        if not observed.root_observed:
            self._observe_floor(stance, floor)
        self._before, kalman = observed, self._kalman
        if observed.root_known and not observed.root_observed:
            self._shift = kalman.position - observed.positions[0]
        else:
            self._shift = self._shift * math.exp(-observed.dt / EASE_S)
        feet = np.where(kalman.placed[:, None], kalman.feet, np.nan)
        return RootState(kalman.position, kalman.velocity, kalman.covariance, feet, kalman.feet_sigma, self._shift)

    def _start(self, observed: BodyObservation, velocity: Floats) -> BodyFilter:
        sigma = min(observed.root_sigma, FIRST_SIGMA)
        return BodyFilter(self._noise, observed.positions[0], *_split(sigma), velocity, len(FEET))

    def _observe_velocity(self, observed: BodyObservation, velocity: RootVelocity) -> None:
        """Take the predicted velocity, unless it cannot be reconciled with an observed root, horizontally."""
        kalman, share = self._kalman, 1.0 - math.exp(-observed.dt / AT_ODDS_MEMORY_S)
        if not observed.root_observed:
            self._odds[:], self._carried = 0.0, False
        else:
            off = (observed.positions[0] - kalman.position)[:2]
            self._odds += share * (off / np.hypot(kalman.position_sigma[:2], observed.root_sigma) - self._odds)
            disagreement = float(np.linalg.norm((kalman.velocity - velocity.velocity)[:2]))
            at_odds = float(np.linalg.norm(self._odds)) > AT_ODDS_SIGMAS
            self._carried = at_odds or (self._carried and disagreement > AT_ONE_SPEED)
        if self._carried:
            return
        inferred = 1.0 - float(observed.observed[_LEGS].mean()) if observed.root_known else 1.0
        sigma = np.hypot(velocity.sigma, inferred * INFERRED_LEGS_SPEED)
        if observed.root_observed:
            sigma = np.hypot(sigma, self._mean_error(observed, velocity.velocity))
        kalman.observe_velocity(velocity.velocity, *_split(sigma))

    def _mean_error(self, observed: BodyObservation, velocity: Floats) -> float:
        """m/s, the length of the predicted velocity's mean error, of late, against the observed root's."""
        if self._before.root_observed and observed.dt > 0.0:
            moved = (observed.positions[0] - self._before.positions[0]) / observed.dt
            self._off += (1.0 - math.exp(-observed.dt / OFF_MEMORY_S)) * (moved - velocity - self._off)
        return float(np.linalg.norm(self._off))

    def _observe_root(self, observed: BodyObservation) -> bool:
        """Take an observed root; whether it is gated in, so that other joints are where they are observed as well."""
        if not observed.root_observed:
            return False
        off = np.abs(observed.positions[0] - self._kalman.position)
        gate = JUMP_SIGMAS * np.hypot(self._kalman.position_sigma, observed.root_sigma)
        self._jumps = self._jumps + 1 if np.any(off > np.maximum(gate, JUMP_M)) else 0
        came_back = not self._before.root_observed
        if not self._jumps:
            self._kalman.observe_position(observed.positions[0], *_split(observed.root_sigma))
        elif came_back or self._jumps == JUMP_FRAMES:
            self._kalman = self._start(observed, self._kalman.velocity if came_back else np.zeros(3))
            self._jumps = 0
        return not self._jumps

    def _observe_feet(self, observed: BodyObservation, *, in_world: bool) -> None:
        """Take the feet, in the world or against the root."""
        if not observed.root_known:
            return
        places, sigma = observed.feet - (0.0 if in_world else observed.positions[0]), observed.feet_sigma
        for foot in range(len(FEET)):
            if np.isfinite(places[foot]).all() and math.isfinite(sigma[foot]):
                jitter, bias = _split(float(sigma[foot]))
                self._kalman.observe_foot(foot, places[foot], jitter, bias, from_root=not in_world)
            else:
                self._kalman.lose(foot)

    def _observe_floor(self, stance: Stance, floor: Floor) -> None:
        """Take the height of feet that stand from the floor under them."""
        for foot in np.flatnonzero((stance.rest > STANDING) & self._kalman.placed).tolist():
            under = floor.under(self._kalman.feet[foot] - SOLE[foot] * _UP)
            if math.isfinite(under):
                self._kalman.observe_foot_height(foot, under + SOLE[foot], math.hypot(floor.sigma, SOLE_SIGMA))


def _split(sigma: Sigma) -> tuple[Sigma, Sigma]:
    """The standard deviations of the jitter and of the slow bias that make up ``sigma``."""
    return JITTER_SHARE * sigma, math.sqrt(1.0 - JITTER_SHARE**2) * sigma
