"""The floor: its height in a gravity-aligned frame, from the feet that stand on it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

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


class Ground:
    """A running estimate of the floor's height; it slows down as it grows sure.

    Feet cannot stand under the floor, so a foot that does is believed; one well above it stands on a step, or was
    taken to stand when it did not, and is not. An uncalibrated floor that no foot touches for `PATIENCE_S` seconds
    of standing is given up for the one that the feet stand on.

    Args:
        calibrated: whether the floor is known to be at z = 0.
    """

    def __init__(self, calibrated: bool) -> None:
        self.calibrated = calibrated
        self._height = 0.0
        self._variance = CALIBRATED_SIGMA**2 if calibrated else math.inf
        self._elsewhere_s = 0.0

    @property
    def known(self) -> bool:
        """Whether there is any estimate."""
        return math.isfinite(self._variance)

    @property
    def height(self) -> float:
        """Metres, world; 0 while unknown."""
        return self._height

    @property
    def sigma(self) -> float:
        """Metres, the standard deviation of `height`; infinite while unknown."""
        return math.sqrt(self._variance)

    @property
    def plane(self) -> NDArray[np.float64]:
        """(4,) a, b, c, d with ax + by + cz + d = 0 and the unit normal (a, b, c) up."""
        return np.array([0.0, 0.0, 1.0, -self._height])

    def guess(self, lowest: float) -> None:
        """Start from where the floor would be, in metres, if the lowest foot in sight stood on it."""
        if not self.known:
            self._height, self._variance = lowest, GUESS_SIGMA**2

    def observe(self, height: float, sigma: float, dt: float) -> None:
        """Take the floor's height in metres as one standing foot tells it, with its standard deviation.

        Args:
            height: metres, world: of the joint less its height above the sole.
            sigma: metres.
            dt: seconds for which this foot has stood since it last told.
        """
        if not self.known:
            self._height, self._variance = height, sigma**2
            return
        self._variance += CREEP**2 * dt
        surprise = (height - self._height) / math.sqrt(self._variance + sigma**2)
        if surprise > GATE:
            self._elsewhere_s += dt
            if self._elsewhere_s > PATIENCE_S and not self.calibrated:
                self._height, self._variance, self._elsewhere_s = height, GUESS_SIGMA**2, 0.0
            return
        self._elsewhere_s = 0.0
        if surprise < -GATE:
            self._variance = max(self._variance, sigma**2)
        gain = self._variance / (self._variance + sigma**2 * max(MEMORY_S / dt, 1.0))
        self._height += gain * (height - self._height)
        self._variance *= 1.0 - gain
