"""Selects and weighs the observations and predictions that update a body's Kalman filter of root and feet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.world.floor import SOLE_SIGMA, STANDING, Floor
from steadypose.prior.world.kalman import BodyFilter, BodyNoise
from steadypose.prior.world.networks import RootVelocity, Stance
from steadypose.prior.world.observe import FEET, SOLE, BodyObservation

Sigma = TypeVar("Sigma", float, Floats)

EASE_S = 0.1  # time constant with which a body returns to its observations when its root is observed again, seconds
FIRST_SIGMA = 1.0  # standard deviation of a body's first root if no observation supports it, metres

JITTER_SHARE = 0.3
"""Share of a joint's or velocity's standard deviation that is independent in each frame; the rest is slow bias."""

INFERRED_LEGS_SPEED = 0.5
"""Standard deviation added to the predicted velocity's if the legs are not observed but inferred, m/s."""

OFF_MEMORY_S = 0.5
"""Time constant of the predicted velocity's mean error against an observed root, seconds. While the root is observed,
this error is added to the standard deviation, because some motion is unlike the network's training data."""

JUMP_SIGMAS, JUMP_M, JUMP_FRAMES = 5.0, 0.3, 6
"""Distance above which an observed root is rejected, standard deviations and metres, and the number of frames in a row
after which it is accepted. A root that was unobserved before is accepted at once. The filter then starts anew."""

CARRIED_SIGMAS, CARRIED_MEMORY_S = 2.0, 0.2
"""Mean distance of the observed root from its estimate above which the body's support is assumed to move with it (a
lift, a vehicle), standard deviations, and time constant of this mean, seconds. Feet and network then do not measure the
motion in the world."""

AGREED_SPEED = 0.3  # difference between predicted and estimated velocity below which the prediction is used again, m/s

_LEGS = [joint for leg in limbs(("knee", "ankle", "foot")) for joint in leg]
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class RootState:
    """A body's estimated root and feet, in the world."""

    position: Floats  # (3,) metres, position of the root
    velocity: Floats  # (3,) m/s, velocity of the root
    covariance: Floats  # (6, 6) of [position, velocity]: m², m²/s, m²/s²
    feet: Floats  # (4, 3) metres, positions of `FEET`; NaN where unknown
    feet_sigma: Floats  # (4, 3) metres, standard deviations along each axis
    shift: Floats
    """(3,) metres by which an unobserved root moves the body's other joints; it decays once the root is observed"""

    @property
    def position_sigma(self) -> Floats:
        """(3,) metres, standard deviation along each axis."""
        return np.sqrt(np.diag(self.covariance)[:3])


class RootFilter:
    """Fuses observations and predictions of one body's root and feet, from its first observation with a root on."""

    def __init__(self, first: BodyObservation, noise: BodyNoise) -> None:
        self._noise, self._before = noise, first
        self._kalman = self._start(first, np.zeros(3))
        self._shift, self._off, self._mean_off = np.zeros(3), np.zeros(3), np.zeros(2)
        self._jumps, self._carried = 0, False

    @property
    def feet_off(self) -> Floats:
        """(4,) distance from each foot to its last observation along the worst axis, in standard deviations."""
        return self._kalman.feet_off

    def update(
        self, observed: BodyObservation, velocity: RootVelocity | None, stance: Stance, floor: Floor
    ) -> RootState:
        """Predict to the newest observation, and update with it, with the predicted root velocity if it is used, and
        with the feet that may anchor the root; ``floor`` gives their height while the root is unobserved."""
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
        """Update with the predicted velocity, unless an observed root contradicts it horizontally."""
        kalman, share = self._kalman, 1.0 - math.exp(-observed.dt / CARRIED_MEMORY_S)
        if not observed.root_observed:
            self._mean_off[:], self._carried = 0.0, False
        else:
            off = (observed.positions[0] - kalman.position)[:2]
            self._mean_off += share * (off / np.hypot(kalman.position_sigma[:2], observed.root_sigma) - self._mean_off)
            disagreement = float(np.linalg.norm((kalman.velocity - velocity.velocity)[:2]))
            contradicted = float(np.linalg.norm(self._mean_off)) > CARRIED_SIGMAS
            self._carried = contradicted or (self._carried and disagreement > AGREED_SPEED)
        if self._carried:
            return
        inferred = 1.0 - float(observed.observed[_LEGS].mean()) if observed.root_known else 1.0
        sigma = np.hypot(velocity.sigma, inferred * INFERRED_LEGS_SPEED)
        if observed.root_observed:
            sigma = np.hypot(sigma, self._mean_error(observed, velocity.velocity))
        kalman.observe_velocity(velocity.velocity, *_split(sigma))

    def _mean_error(self, observed: BodyObservation, velocity: Floats) -> float:
        """Return the length of the predicted velocity's running mean error against the observed root, m/s."""
        if self._before.root_observed and observed.dt > 0.0:
            moved = (observed.positions[0] - self._before.positions[0]) / observed.dt
            self._off += (1.0 - math.exp(-observed.dt / OFF_MEMORY_S)) * (moved - velocity - self._off)
        return float(np.linalg.norm(self._off))

    def _observe_root(self, observed: BodyObservation) -> bool:
        """Update with an observed root; returns whether it, and so the observed world positions, are accepted."""
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
        """Update with the observed feet, in the world or relative to the root."""
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
        """Update the heights of standing feet with the floor under them."""
        for foot in np.flatnonzero((stance.rest > STANDING) & self._kalman.placed).tolist():
            under = floor.under(self._kalman.feet[foot] - SOLE[foot] * _UP)
            if math.isfinite(under):
                self._kalman.observe_foot_height(foot, under + SOLE[foot], math.hypot(floor.sigma, SOLE_SIGMA))


def _split(sigma: Sigma) -> tuple[Sigma, Sigma]:
    """Split ``sigma`` into the standard deviations of jitter and slow bias."""
    return JITTER_SHARE * sigma, math.sqrt(1.0 - JITTER_SHARE**2) * sigma
