"""Where feet that stand are published: still, while their estimate stays within a deadband.

While a foot stands, the filter learns better and better where, so that its estimate creeps. A reader wants a foot that
stands, and half a standard deviation more adds a tenth to an estimate's error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEADBAND = 0.5
"""Standard deviations of a foot's estimate by which it may be published elsewhere."""

EASE_S = 0.1
"""Seconds, the time constant by which a foot that has lifted comes to be where it is estimated."""


class StandingFeet:
    """Holds ``feet`` points of the feet while they rest: a deadband with memory, as the backlash of gears."""

    def __init__(self, feet: int) -> None:
        self._offset = np.zeros((feet, 3))
        self._before = np.full((feet, 3), np.nan)

    def update(self, estimates: Floats, sigma: Floats, rest: Floats, dt: float) -> Floats:
        """Where each foot is published, (feet, 3) metres; NaN where there is no estimate.

        Args:
            estimates: (feet, 3) metres, world; NaN where there is none.
            sigma: (feet,) metres, their standard deviations.
            rest: (feet,) the probability that each rests.
            dt: seconds since the last call.
        """
        moved = np.nan_to_num(estimates - self._before)
        offset = (self._offset - rest[:, None] * moved) * np.exp(-dt / EASE_S * (1.0 - rest))[:, None]
        length, most = np.linalg.norm(offset, axis=1), DEADBAND * np.nan_to_num(sigma)
        offset *= np.divide(most, length, out=np.ones_like(length), where=length > most)[:, None]
        offset[np.isnan(estimates).any(axis=1)] = 0.0
        self._offset, self._before = offset, estimates
        return estimates + offset
