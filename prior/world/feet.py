"""Feet for publication: resting feet stand still on the floor, and no foot is below the floor.

A sensor's error in a foot's height is constant or slow, so no filter of that foot alone can estimate it. The floor
gives a second measurement: a standing foot is at this person's standing height above the floor. It is applied at
publication and not in the filter, because its error is a bias: used in every frame, it would make the filter
overconfident.

While a foot stands, the filter's estimate of its position becomes more accurate and therefore creeps. The published
position stays within half a standard deviation of the estimate, which adds only a tenth to the error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.world.filter import RootState
from steadypose.prior.world.floor import UPRIGHT_M, Floor
from steadypose.prior.world.observe import SOLE, BodyObservation

SOLE_SIGMA: Floats = np.array([0.013, 0.006])
"""Standard deviations (2,) of the standing heights of heels and toes, between people of the training motion, metres."""

UNEVEN = 0.006
"""Standard deviation of one person's standing height from stance to stance, in the training motion, metres."""

MEMORY_S = 1.5
"""Correlation time of the error of a standing foot's height, seconds. Frames closer together repeat a measurement."""

FLOOR_EASE_S = 0.05  # time constant with which feet are moved to the floor, seconds

AIR_M = 0.1  # range of heights above the floor assumed for feet that do not stand or stand on something else, metres
OUTLIER = 0.05  # probability that the floor's estimate is wrong

LYING_M = 0.25
"""Height of the pelvis above the floor below which a body lies, and the floor gives no height of its feet, metres."""

DEADBAND = 0.5  # largest distance of a published foot from its estimate, standard deviations
EASE_S = 0.1  # time constant with which a lifted foot returns to its estimate, seconds

_UP = np.array([0.0, 0.0, 1.0])


class FeetState(NamedTuple):
    """Published feet."""

    positions: Floats  # (4, 3) metres, world, positions of `FEET`; NaN where unknown
    sigma: Floats  # (4,) metres, standard deviations along an axis


class Feet:
    """Puts one body's feet on the floor, and keeps resting feet still."""

    def __init__(self) -> None:
        self._soles, self._still = Soles(), StillFeet()

    def update(self, observed: BodyObservation, root: RootState, rest: Floats, floor: Floor) -> FeetState:
        """Return the feet of the newest frame, given their probabilities (4,) of ``rest``."""
        feet, spread = root.feet.copy(), root.feet_sigma.copy()
        under = np.array([floor.under(sole) for sole in feet - self._soles.heights[:, None] * _UP])
        sigma = observed.feet_sigma
        # the filter models the sensor's error as a decaying one, but part of it is a constant offset of the foot
        variance = spread[:, 2] ** 2 + np.where(np.isfinite(sigma), sigma, 0.0) ** 2
        raised = root.position[2] - np.nan_to_num(under)
        upright = np.clip((raised - LYING_M) / (UPRIGHT_M - LYING_M), 0.0, 1.0)
        feet[:, 2], settled, stands = self._soles.settle(
            feet[:, 2], variance, under, floor.sigma, rest, upright, observed.dt
        )
        if observed.root_observed:
            self._soles.learn(observed.feet[:, 2] - under, sigma, stands, max(observed.dt, FRAME_S))
        positions = self._still.update(feet, np.sqrt(np.mean(spread**2, axis=1)), rest, observed.dt)
        spread[:, 2] = np.minimum(spread[:, 2], np.sqrt(settled))  # else fit_legs would move a held foot
        return FeetState(positions, np.sqrt(np.mean(spread**2, axis=1)))


class StillFeet:
    """Keeps feet still while they rest, with a deadband that has memory, like the backlash of gears."""

    def __init__(self) -> None:
        self._offset, self._before = np.zeros((4, 3)), np.full((4, 3), np.nan)

    def update(self, estimates: Floats, sigma: Floats, rest: Floats, dt: float) -> Floats:
        """Return the published position of each foot from estimates (4, 3) metres, world, NaN where there is none,
        their deviations (4,), the probabilities (4,) that they rest, and the seconds since the last call."""
        moved = np.nan_to_num(estimates - self._before)
        offset = (self._offset - rest[:, None] * moved) * np.exp(-dt / EASE_S * (1.0 - rest))[:, None]
        length, most = np.linalg.norm(offset, axis=1), DEADBAND * np.nan_to_num(sigma)
        offset *= np.divide(most, length, out=np.ones_like(length), where=length > most)[:, None]
        offset[np.isnan(estimates).any(axis=1)] = 0.0
        self._offset, self._before = offset, estimates
        return estimates + offset


class Soles:
    """Learns the standing heights of one person's heels and toes, and estimates the heights of feet from them."""

    def __init__(self) -> None:
        self._heights, self._variances = SOLE[::2].copy(), SOLE_SIGMA**2
        self._moved: Floats | None = None

    @property
    def heights(self) -> Floats:
        """(4,) metres, standing heights, in the order of `SOLE`."""
        return np.repeat(self._heights, 2)

    def settle(
        self, heights: Floats, variances: Floats, floor: Floats, floor_sigma: float, rest: Floats, known: Floats,
        dt: float,
    ) -> tuple[Floats, Floats, Floats]:  # fmt: skip
        """Fuse the filter's heights of feet with the floor's.

        Args:
            heights: (4,) metres, world, from the filter.
            variances: (4,) m², their variances.
            floor: (4,) metres, world, height of the floor under each foot; NaN where unknown.
            floor_sigma: metres, standard deviation of the floor's height.
            rest: (4,) probabilities that the feet rest.
            known: (4,) probabilities that the floor, if known, gives the height of such a body's feet.
            dt: seconds since the last call.

        Returns:
            (4,) heights, (4,) their variances, and (4,) probabilities that the feet stand on this floor.
        """
        own = np.repeat(self._variances, 2) + UNEVEN**2 + floor_sigma**2
        settled, left, stands = _settle(heights, variances, floor + self.heights, own, rest, known * (1.0 - OUTLIER))
        moved = np.nan_to_num(settled - heights)
        if self._moved is not None:
            moved = self._moved + (1.0 - math.exp(-dt / FLOOR_EASE_S)) * (moved - self._moved)
        self._moved = moved
        return heights + moved, left, stands

    def learn(self, above: Floats, sigma: Floats, stands: Floats, dt: float) -> None:
        """Update the standing heights from observed heights (4,) above the floor, metres, NaN where foot or floor is
        unknown, their deviations (4,), the probabilities (4,) that feet stand, and seconds since the last frame, above
        0."""
        _learn(self._heights, self._variances, above, sigma, stands, max(MEMORY_S / dt, 1.0))


@njit("(f8[:], f8[:], f8[:], f8[:], f8[:], f8[:])", cache=True)
def _settle(heights, variances, stand, stand_variances, rest, known):
    """Return means and variances of heights, and the probability that each foot stands (see `Soles.settle`).

    The model is a mixture of three cases. In the first, the foot stands at height ``stand``. In the second, it is
    anywhere above; if observed below, it is treated as standing. In the third, the floor's estimate is wrong. The
    second case uses the most likely height and not the mean. The mean of a hidden foot, whose deviation is large, would
    lie far too high.
    """
    means, left, probability = heights.copy(), variances.copy(), np.zeros(len(heights))
    for k in range(len(heights)):
        if not math.isfinite(stand[k] + heights[k] + variances[k]):
            continue
        total = variances[k] + stand_variances[k]
        off, width = (heights[k] - stand[k]) / math.sqrt(total), math.sqrt(2.0 * math.pi * total)
        air = math.hypot(AIR_M, width)
        stands = known[k] * rest[k] * math.exp(-0.5 * off**2) / width
        above = known[k] * (1.0 - rest[k]) * 0.5 * math.erfc(-off / math.sqrt(2.0)) / air
        whole = stands + above + (1.0 - known[k]) / air
        share = (stands + above) / whole if off < 0.0 else stands / whole
        moved = variances[k] / total * (stand[k] - heights[k])
        means[k] += share * moved
        left[k] += share * (1.0 - share) * moved**2 - share * variances[k] ** 2 / total
        probability[k] = stands / whole
    return means, left, probability


@njit("(f8[:], f8[:], f8[:], f8[:], f8[:], f8)", cache=True)
def _learn(heights, variances, above, sigma, stands, repeats):
    """Update heights (2,) and variances (2,), in place (see `Soles.learn`)."""
    for k in range(len(above)):
        if stands[k] > 0.0 and math.isfinite(above[k] + sigma[k]):
            noise = (sigma[k] ** 2 + UNEVEN**2) * repeats / stands[k]
            gain = variances[k // 2] / (variances[k // 2] + noise)
            heights[k // 2] += gain * (above[k] - heights[k // 2])
            variances[k // 2] *= 1.0 - gain
