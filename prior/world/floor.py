"""What feet stand on, in a gravity-aligned frame: the floor, and the steps and platforms above it.

HuMoR's ground is one plane. That of a hall is; a robot's has steps. Ground here is horizontal, at several heights: the
floor, which reaches everywhere, and levels, each as far as feet have stood on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.world.observe import BodyObservation

SOLE_SIGMA = 0.02
"""Standard deviation of a standing foot's height above the floor, between sources and people and from stand to stand,
metres."""

STANDING = 0.5
"""Probability of rest from which on a foot measures the floor."""

UPRIGHT_M = 0.45
"""Height of the pelvis above the sole from which on a body's feet measure the floor, metres: not those of one that
lies."""

CALIBRATED_SIGMA = 0.01
"""Standard deviation of a calibrated floor's height, metres."""

GUESS_SIGMA = 0.15
"""Standard deviation of the floor's height by the lowest foot of a first frame, standing or not, metres."""

CREEP = 0.001
"""Density of the random walk of an estimate that is sure, metres over √s."""

MEMORY_S = 0.5
"""Time for which the error of one standing foot lasts, seconds: frames closer together measure the same again."""

GATE = 3.0
"""Height above the floor from which on a foot stands on something else, standard deviations."""

PATIENCE_S = 5.0
"""Time of feet standing on something else, and none on the floor, after which that is the floor, seconds."""

STEP_M = 0.10
"""Height above the floor, or another level, from which on something is a level of its own, metres."""

STOOD_S = 0.3
"""Time that feet stand on a level before it is one, seconds: no jump hangs in the air for so long."""

REACH_M = 0.4
"""Distance beyond where feet have stood that a level is taken to reach, metres."""

FORGOTTEN_S = 60.0
"""Time of standing elsewhere after which a level is forgotten, seconds."""


@dataclass
class Level:
    """Something to stand on.

    Attributes:
        height: metres, world.
        variance: of that, m².
        low, high: (2,) metres, world: between them feet have stood.
        stood_s: seconds that feet have stood on it.
        idle_s: seconds that feet have stood elsewhere since.
    """

    height: float
    variance: float
    low: Floats
    high: Floats
    stood_s: float = 0.0
    idle_s: float = 0.0

    def reaches(self, place: Floats) -> bool:
        """Whether it is one, and under or near a place (2,)."""
        inside = (place > self.low - REACH_M).all() and (place < self.high + REACH_M).all()
        return self.stood_s > STOOD_S and bool(inside)

    def observe(self, height: float, sigma: float, place: Floats, dt: float) -> None:
        """Update by the height in metres that one foot standing at ``place`` measures; see `Floor.observe`."""
        self.variance += CREEP**2 * dt
        gain = self.variance / (self.variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self.height += gain * (height - self.height)
        self.variance *= 1.0 - gain
        self.low, self.high = np.minimum(self.low, place), np.maximum(self.high, place)
        self.stood_s, self.idle_s = self.stood_s + dt, 0.0


class Floor:
    """A running estimate of the floor's height, which slows down as it grows sure, and of levels above it.

    Feet cannot stand under the floor, so a foot that does is trusted; one well above it stands on a step, or was
    taken to stand when it did not. An uncalibrated floor that no foot touches for `PATIENCE_S` seconds of standing is
    given up for the one that the feet stand on.

    Args:
        calibrated: whether the floor is known to be at z = 0.
    """

    def __init__(self, calibrated: bool) -> None:
        self._calibrated = calibrated
        self._levels: list[Level] = []
        self._height = 0.0
        self._variance = CALIBRATED_SIGMA**2 if calibrated else math.inf
        self._elsewhere_s = 0.0

    @property
    def known(self) -> bool:
        """Whether there is any estimate."""
        return math.isfinite(self._variance)

    @property
    def height(self) -> float:
        """Metres, world, of the floor; 0 while unknown."""
        return self._height

    @property
    def sigma(self) -> float:
        """Metres, the standard deviation of `height`; infinite while unknown."""
        return math.sqrt(self._variance)

    @property
    def levels(self) -> list[float]:
        """Metres, world, of the levels above the floor that feet have stood on for long enough."""
        return [level.height for level in self._levels if level.stood_s > STOOD_S]

    @property
    def plane(self) -> Floats:
        """(4,) a, b, c, d of the floor, with ax + by + cz + d = 0 and the unit normal (a, b, c) up."""
        return np.array([0.0, 0.0, 1.0, -self._height])

    def under(self, sole: Floats) -> float:
        """Metres, world: the height of what a sole at (3,) metres may stand on; NaN if nothing known is near."""
        if not self.known:
            return math.nan
        heights = [self._height, *(level.height for level in self._levels if level.reaches(sole[:2]))]
        near = min(heights, key=lambda height: abs(height - sole[2]))
        return near if sole[2] - near < STEP_M else math.nan

    def update(self, observed: BodyObservation, rest: Floats) -> None:
        """Update by one body's observed feet; (4,) ``rest`` are their probabilities of rest."""
        if not self.known and observed.feet_observed.any():
            self.guess(float(np.nanmin(observed.soles[:, 2])))
        if not observed.root_observed:
            return
        soles, sigma = observed.soles, observed.feet_sigma
        stands = (rest > STANDING) & np.isfinite(soles).all(axis=1) & np.isfinite(sigma)
        for k in np.flatnonzero(stands & (observed.positions[0, 2] - soles[:, 2] > UPRIGHT_M)):
            self.observe(soles[k], math.hypot(sigma[k], SOLE_SIGMA), max(observed.dt, FRAME_S))

    def guess(self, lowest: float) -> None:
        """Start from where the floor would be, in metres, if the lowest foot in sight stood on it."""
        if not self.known:
            self._height, self._variance = lowest, GUESS_SIGMA**2

    def observe(self, sole: Floats, sigma: float, dt: float) -> None:
        """Update by the ground's height that one standing foot measures, with its standard deviation.

        Args:
            sole: (3,) metres, world: the joint, less its height above the sole.
            sigma: metres, of the height.
            dt: seconds for which this foot has stood since it was last taken.
        """
        height = float(sole[2])
        if not self.known:
            self._height, self._variance = height, sigma**2
            return
        for level in self._levels:
            level.idle_s += dt
        self._levels = [level for level in self._levels if level.idle_s < FORGOTTEN_S]
        self._variance += CREEP**2 * dt
        sigmas_off = (height - self._height) / math.sqrt(self._variance + sigma**2)
        if sigmas_off > GATE and height - self._height > STEP_M:
            self._observe_level(sole, sigma, dt)
        if sigmas_off > GATE:
            self._elsewhere_s += dt
            if self._elsewhere_s > PATIENCE_S and not self._calibrated:
                self._height, self._variance, self._elsewhere_s = height, GUESS_SIGMA**2, 0.0
                self._levels = [level for level in self._levels if level.height > height + STEP_M]
            return
        self._elsewhere_s = 0.0
        if sigmas_off < -GATE:
            self._variance = max(self._variance, sigma**2)
        gain = self._variance / (self._variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self._height += gain * (height - self._height)
        self._variance *= 1.0 - gain

    def _observe_level(self, sole: Floats, sigma: float, dt: float) -> None:
        height, place = float(sole[2]), sole[:2]
        near = min(self._levels, key=lambda level: abs(level.height - height), default=None)
        if near is None or abs(near.height - height) > STEP_M / 2:
            near = Level(height, sigma**2, place.copy(), place.copy())
            self._levels.append(near)
        near.observe(height, sigma, place, dt)
