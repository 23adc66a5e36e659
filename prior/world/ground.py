"""What feet stand on, in a gravity-aligned frame: the floor, and the steps and platforms above it.

HuMoR's ground is one plane. A kiosk's floor is; a robot's has steps. Ground here is horizontal, at several heights: the
floor, which reaches everywhere, and levels, each as far as feet have stood on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CALIBRATED_SIGMA = 0.01
"""Metres, how well a calibration is taken to know the floor at z = 0."""

GUESS_SIGMA = 0.15
"""Metres, how well the lowest foot of a first frame, standing or not, tells the floor."""

CREEP = 0.001
"""Metres over √s: how fast the estimate may still move once it is sure."""

MEMORY_S = 0.5
"""Seconds for which the error of one standing foot lasts: frames closer together tell the same again."""

GATE = 3.0
"""Standard deviations: a foot that stands higher than this above the floor stands on something else."""

PATIENCE_S = 5.0
"""Seconds of feet standing on something else, and none on the floor, after which that is the floor."""

STEP_M = 0.10
"""Metres above the floor, or another level, from which on something is a level of its own."""

STOOD_S = 0.3
"""Seconds for which feet stand on a level before it is one: no jump hangs in the air for so long."""

REACH_M = 0.4
"""Metres beyond where feet have stood that a level is taken to reach."""

FORGOTTEN_S = 60.0
"""Seconds of standing elsewhere after which a level is forgotten."""


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
    idle_s: float = field(default=0.0)

    def reaches(self, place: Floats) -> bool:
        """Whether it is one, and under or near a place (2,)."""
        inside = (place > self.low - REACH_M).all() and (place < self.high + REACH_M).all()
        return self.stood_s > STOOD_S and bool(inside)

    def observe(self, height: float, sigma: float, place: Floats, dt: float) -> None:
        """Take its height in metres as one foot that stands at ``place`` tells it; see `Ground.observe`."""
        self.variance += CREEP**2 * dt
        gain = self.variance / (self.variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self.height += gain * (height - self.height)
        self.variance *= 1.0 - gain
        self.low, self.high = np.minimum(self.low, place), np.maximum(self.high, place)
        self.stood_s, self.idle_s = self.stood_s + dt, 0.0


class Ground:
    """A running estimate of the floor's height, which slows down as it grows sure, and of levels above it.

    Feet cannot stand under the floor, so a foot that does is believed; one well above it stands on a step, or was
    taken to stand when it did not. An uncalibrated floor that no foot touches for `PATIENCE_S` seconds of standing is
    given up for the one that the feet stand on.

    Args:
        calibrated: whether the floor is known to be at z = 0.

    Attributes:
        levels: above the floor; not all have been stood on for long enough to count.
    """

    def __init__(self, calibrated: bool) -> None:
        self.calibrated = calibrated
        self.levels: list[Level] = []
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
    def plane(self) -> Floats:
        """(4,) a, b, c, d of the floor, with ax + by + cz + d = 0 and the unit normal (a, b, c) up."""
        return np.array([0.0, 0.0, 1.0, -self._height])

    def under(self, sole: Floats) -> float:
        """Metres, world: the height of what a sole at (3,) metres may stand on; NaN if nothing known is near."""
        if not self.known:
            return math.nan
        heights = [self._height, *(level.height for level in self.levels if level.reaches(sole[:2]))]
        near = min(heights, key=lambda height: abs(height - sole[2]))
        return near if sole[2] - near < STEP_M else math.nan

    def guess(self, lowest: float) -> None:
        """Start from where the floor would be, in metres, if the lowest foot in sight stood on it."""
        if not self.known:
            self._height, self._variance = lowest, GUESS_SIGMA**2

    def observe(self, sole: Floats, sigma: float, dt: float) -> None:
        """Take the ground's height as one standing foot tells it, with its standard deviation.

        Args:
            sole: (3,) metres, world: the joint, less its height above the sole.
            sigma: metres, of the height.
            dt: seconds for which this foot has stood since it last told.
        """
        height = float(sole[2])
        if not self.known:
            self._height, self._variance = height, sigma**2
            return
        for level in self.levels:
            level.idle_s += dt
        self.levels = [level for level in self.levels if level.idle_s < FORGOTTEN_S]
        self._variance += CREEP**2 * dt
        surprise = (height - self._height) / math.sqrt(self._variance + sigma**2)
        if surprise > GATE and height - self._height > STEP_M:
            self._observe_level(sole, sigma, dt)
        if surprise > GATE:
            self._elsewhere_s += dt
            if self._elsewhere_s > PATIENCE_S and not self.calibrated:
                self._height, self._variance, self._elsewhere_s = height, GUESS_SIGMA**2, 0.0
                self.levels = [level for level in self.levels if level.height > height + STEP_M]
            return
        self._elsewhere_s = 0.0
        if surprise < -GATE:
            self._variance = max(self._variance, sigma**2)
        gain = self._variance / (self._variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self._height += gain * (height - self._height)
        self._variance *= 1.0 - gain

    def _observe_level(self, sole: Floats, sigma: float, dt: float) -> None:
        height, place = float(sole[2]), sole[:2]
        near = min(self.levels, key=lambda level: abs(level.height - height), default=None)
        if near is None or abs(near.height - height) > STEP_M / 2:
            near = Level(height, sigma**2, place.copy(), place.copy())
            self.levels.append(near)
        near.observe(height, sigma, place, dt)
