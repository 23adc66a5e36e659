"""A body that stands is published standing: its feet still, and its root at the velocity of one that sways.

While a foot stands, the filter learns better and better where, so that its estimate creeps. A reader wants a foot that
stands, and half a standard deviation more adds a tenth to an estimate's error.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DEADBAND = 0.5
"""Standard deviations of a foot's estimate by which it may be published elsewhere."""

EASE_S = 0.1
"""Seconds, the time constant by which a foot that has lifted comes to be where it is estimated."""

SWAY, MOVES = 0.015, 0.1
"""m/s, the standard deviation along an axis of the velocity of a root that sways over both feet, as in half of the
training motion with both at rest, and of one that bends or shifts."""

SWAYS = 0.5
"""Of bodies with both feet at rest, the share that only sways."""

VELOCITY_ERROR = 0.3
"""Of the standard deviation that the filter states of a velocity that is seen, what validation finds of a body that
stands."""

VELOCITY_STATED = 0.6
"""Of the same, what is published: what validation finds in motion, from noise of 0 to 4 cm (docs/experiments.md)."""


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


def standing_velocity(
    velocity: Floats, covariance: Floats, both_rest: float, *, stated: float
) -> tuple[Floats, Floats]:
    """The velocity (3,) m/s of a root that may only sway, and the covariance (6, 6) of [position, velocity] then.

    Mean and covariance under a mixture of two: it sways, or moves, and then as estimated.

    Args:
        velocity: (3,) m/s, as the filter estimates it.
        covariance: (6, 6) of [position, velocity]: m², m²/s, m²/s², as the filter states it.
        both_rest: the probability that both feet rest.
        stated: of the standard deviation of ``velocity`` that the filter states, what is to be published.
    """
    variance = float(np.trace(covariance[3:, 3:])) / 3.0
    error = VELOCITY_ERROR**2 * variance
    squared, sway, moves = float(velocity @ velocity), SWAY**2 + error, MOVES**2 + error
    log_odds = 1.5 * math.log(moves / sway) - 0.5 * squared * (1.0 / sway - 1.0 / moves)
    odds = SWAYS * both_rest / (1.0 - SWAYS * both_rest) * math.exp(log_odds)
    sways, slowed = odds / (1.0 + odds), error / sway
    spread = stated**2 * variance
    within = sways * SWAY**2 * spread / (SWAY**2 + spread) + (1.0 - sways) * spread
    scale = np.repeat([1.0, math.sqrt(within / variance)], 3)
    covariance = covariance * np.outer(scale, scale)
    covariance[3:, 3:] += sways * (1.0 - sways) * slowed**2 * np.outer(velocity, velocity)
    return velocity * (1.0 - sways * slowed), covariance
