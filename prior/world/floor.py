"""The ground in a gravity-aligned frame: the floor, and the steps and platforms above it.

HuMoR's ground is a single plane, but a robot may meet steps. The ground here is horizontal, at several heights. The
floor extends everywhere; each level above it extends as far as feet have stood on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.world.observe import BodyObservation

SOLE_SIGMA = 0.02
"""Standard deviation of a standing foot's height above the floor, over sources, people and stances, metres."""

STANDING = 0.5  # probability of rest above which a foot measures the floor

UPRIGHT_M = 0.45
"""Height of the pelvis above the sole above which feet measure the floor, metres. It excludes bodies that lie."""

CALIBRATED_SIGMA = 0.01  # standard deviation of a calibrated floor's height, metres
GUESS_SIGMA = 0.15  # standard deviation of a floor height guessed from the lowest foot of the first frame, metres
CREEP = 0.001  # density of the random walk of the floor's height, metres over √s

MEMORY_S = 0.5
"""Correlation time of the error of one standing foot, seconds. Frames closer together repeat a measurement."""

GATE = 3.0  # height above the floor above which a foot stands on something else, standard deviations

PATIENCE_S = 5.0
"""Time after which ground that feet stand on becomes the floor if no foot stands on the old one, seconds."""

STEP_M = 0.10  # least height of a new level above the floor or another level, metres

STOOD_S = 0.3
"""Time for which feet must stand on a level before it counts, seconds. A jump is shorter."""

REACH_M = 0.4  # extent of a level beyond the positions where feet have stood, metres
FORGOTTEN_S = 60.0  # time of standing elsewhere after which a level is forgotten, seconds


@dataclass
class Level:
    """A horizontal surface above the floor."""

    height: float  # metres, world
    variance: float  # m², of the height
    low: Floats  # (2,) metres, world, corners of the area where feet have stood
    high: Floats
    stood_s: float = 0.0  # seconds for which feet have stood on it
    idle_s: float = 0.0  # seconds for which feet have stood elsewhere since

    def reaches(self, place: Floats) -> bool:
        """Whether feet have stood on it long enough and it lies under or near a place (2,)."""
        inside = (place > self.low - REACH_M).all() and (place < self.high + REACH_M).all()
        return self.stood_s > STOOD_S and bool(inside)

    def observe(self, height: float, sigma: float, place: Floats, dt: float) -> None:
        """Update with the height measured by one foot that stands at ``place`` (see `Floor.observe`)."""
        self.variance += CREEP**2 * dt
        gain = self.variance / (self.variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self.height += gain * (height - self.height)
        self.variance *= 1.0 - gain
        self.low, self.high = np.minimum(self.low, place), np.maximum(self.high, place)
        self.stood_s, self.idle_s = self.stood_s + dt, 0.0


class Floor:
    """A recursive estimate of the floor's height, and of levels above it.

    Feet cannot stand below the floor, so a foot below it corrects the floor at once. A foot well above it stands on a
    step, or does not stand at all. If feet stand elsewhere for `PATIENCE_S` seconds, an uncalibrated floor is replaced
    by the ground on which they stand.

    Args:
        calibrated: whether the floor is known to be at z = 0.

    Attributes:
        height: metres, world, height of the floor; 0 while unknown.
    """

    def __init__(self, calibrated: bool) -> None:
        self._calibrated = calibrated
        self._levels: list[Level] = []
        self.height = 0.0
        self._variance = CALIBRATED_SIGMA**2 if calibrated else math.inf
        self._elsewhere_s = 0.0

    @property
    def known(self) -> bool:
        """Whether the floor has an estimate."""
        return math.isfinite(self._variance)

    @property
    def sigma(self) -> float:
        """Standard deviation of `height`, metres; infinite while unknown."""
        return math.sqrt(self._variance)

    @property
    def levels(self) -> list[float]:
        """Heights of the levels on which feet have stood for long enough, metres, world."""
        return [level.height for level in self._levels if level.stood_s > STOOD_S]

    @property
    def plane(self) -> Floats:
        """(4,) coefficients a, b, c, d of the ground plane ax + by + cz + d = 0, with the unit normal (a, b, c) up."""
        return np.array([0.0, 0.0, 1.0, -self.height])

    def under(self, sole: Floats) -> float:
        """Height of the ground near a sole at (3,) metres, metres, world; NaN if no known ground is near."""
        if not self.known:
            return math.nan
        heights = [self.height, *(level.height for level in self._levels if level.reaches(sole[:2]))]
        near = min(heights, key=lambda height: abs(height - sole[2]))
        return near if sole[2] - near < STEP_M else math.nan

    def update(self, observed: BodyObservation, rest: Floats, guessed: Bools) -> None:
        """Update with one body's feet and their probabilities (4,) of ``rest``.

        Feet that are only ``guessed`` (4,) may initialise a floor, as there may be no other feet, but do not move a
        known one. The legs of a person who sits behind a counter are guessed to stand, deep under the floor.
        """
        if observed.feet_observed.any():
            self.initialise(float(np.nanmin(observed.soles[:, 2])))
        if not observed.root_observed:
            return
        soles, sigma = observed.soles, observed.feet_sigma
        stands = (rest > STANDING) & np.isfinite(soles).all(axis=1) & np.isfinite(sigma) & ~(guessed & self.known)
        for k in np.flatnonzero(stands & (observed.positions[0, 2] - soles[:, 2] > UPRIGHT_M)):
            self.observe(soles[k], math.hypot(sigma[k], SOLE_SIGMA), max(observed.dt, FRAME_S))

    def initialise(self, lowest: float) -> None:
        """Initialise an unknown floor as if the lowest observed foot, at this height in metres, stood on it."""
        if not self.known:
            self.height, self._variance = lowest, GUESS_SIGMA**2

    def observe(self, sole: Floats, sigma: float, dt: float) -> None:
        """Update with the point (3,) metres, world, of one standing foot's sole, the deviation of its height, and the
        seconds for which it has stood since the last update."""
        height = float(sole[2])
        if not self.known:
            self.height, self._variance = height, sigma**2
            return
        for level in self._levels:
            level.idle_s += dt
        self._levels = [level for level in self._levels if level.idle_s < FORGOTTEN_S]
        self._variance += CREEP**2 * dt
        sigmas_off = (height - self.height) / math.sqrt(self._variance + sigma**2)
        if sigmas_off > GATE and height - self.height > STEP_M:
            self._observe_level(sole, sigma, dt)
        if sigmas_off > GATE:
            self._elsewhere_s += dt
            if self._elsewhere_s > PATIENCE_S and not self._calibrated:
                self.height, self._variance, self._elsewhere_s = height, GUESS_SIGMA**2, 0.0
                self._levels = [level for level in self._levels if level.height > height + STEP_M]
            return
        self._elsewhere_s = 0.0
        if sigmas_off < -GATE:
            self._variance = max(self._variance, sigma**2)
        gain = self._variance / (self._variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self.height += gain * (height - self.height)
        self._variance *= 1.0 - gain

    def _observe_level(self, sole: Floats, sigma: float, dt: float) -> None:
        height, place = float(sole[2]), sole[:2]
        near = min(self._levels, key=lambda level: abs(level.height - height), default=None)
        if near is None or abs(near.height - height) > STEP_M / 2:
            near = Level(height, sigma**2, place.copy(), place.copy())
            self._levels.append(near)
        near.observe(height, sigma, place, dt)
