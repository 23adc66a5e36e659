"""Feet as published: those at rest are on the floor and still, and none is under the floor.

A sensor's error of one foot's height lasts, so that no filter of that foot alone can estimate it; that a foot stands on
the floor, at the height at which this person's feet stand, is another measurement of the same height. It is taken at
publication, not by the filter: a bias taken anew each frame would be trusted ever more.

While a foot stands, the filter learns better and better where, so that its estimate creeps. What is published of it
stays: half a standard deviation more adds a tenth to an estimate's error.
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
"""Standard deviation (2,) of the height of heels and of toes that stand, between the people of the training motion,
metres."""

UNEVEN = 0.006
"""Standard deviation of the height of one person's foot from stand to stand, there, metres."""

MEMORY_S = 1.5
"""Time for which an error of the height of a standing foot lasts, seconds: frames closer together measure the same
again."""

FLOOR_EASE_S = 0.05
"""Time constant by which feet come to be where the floor has them, seconds: what they are off by lasts longer."""

AIR_M = 0.1
"""Height above the floor among which feet that do not stand, or stand on something else, are taken to be, metres."""

OUTLIER = 0.05
"""Probability that the floor is not where it is estimated to be."""

LYING_M = 0.25
"""Height of the pelvis above the floor up to which the floor does not measure a body's feet, metres: it lies."""

DEADBAND = 0.5
"""Distance from its estimate at which a foot may be published, standard deviations."""

EASE_S = 0.1
"""Time constant by which a foot that has lifted comes to be where it is estimated, seconds."""

_UP = np.array([0.0, 0.0, 1.0])


class FeetState(NamedTuple):
    """Where feet are published.

    Attributes:
        positions: (4, 3) metres, world, of `FEET`; NaN where not placed.
        sigma: (4,) metres, standard deviation along an axis.
    """

    positions: Floats
    sigma: Floats


class Feet:
    """Puts one body's feet on the floor, and keeps those still that rest."""

    def __init__(self) -> None:
        self._soles, self._still = Soles(), StillFeet()

    def update(self, observed: BodyObservation, root: RootState, rest: Floats, floor: Floor) -> FeetState:
        """The feet of the newest frame, of which (4,) ``rest`` are the probabilities of rest."""
        feet, spread = root.feet.copy(), root.feet_sigma.copy()
        under = np.array([floor.under(sole) for sole in feet - self._soles.heights[:, None] * _UP])
        sigma = observed.feet_sigma
        # What the filter takes to fade with time is, of a sensor, in part an offset of a foot that stays.
        variance = spread[:, 2] ** 2 + np.where(np.isfinite(sigma), sigma, 0.0) ** 2
        raised = root.position[2] - np.nan_to_num(under)
        upright = np.clip((raised - LYING_M) / (UPRIGHT_M - LYING_M), 0.0, 1.0)
        feet[:, 2], settled, stands = self._soles.settle(
            feet[:, 2], variance, under, floor.sigma, rest, upright, observed.dt
        )
        if observed.root_observed:
            self._soles.learn(observed.feet[:, 2] - under, sigma, stands, max(observed.dt, FRAME_S))
        positions = self._still.update(feet, np.sqrt(np.mean(spread**2, axis=1)), rest, observed.dt)
        spread[:, 2] = np.minimum(spread[:, 2], np.sqrt(settled))  # else bones would draw at a foot that is held
        return FeetState(positions, np.sqrt(np.mean(spread**2, axis=1)))


class StillFeet:
    """Keeps feet still while they rest: a deadband with memory, as the backlash of gears."""

    def __init__(self) -> None:
        self._offset, self._before = np.zeros((4, 3)), np.full((4, 3), np.nan)

    def update(self, estimates: Floats, sigma: Floats, rest: Floats, dt: float) -> Floats:
        """Where each foot is published, (4, 3) metres; NaN where there is no estimate.

        Args:
            estimates: (4, 3) metres, world; NaN where there is none.
            sigma: (4,) metres, their standard deviations.
            rest: (4,) the probability that each rests.
            dt: seconds since the last call.
        """
        moved = np.nan_to_num(estimates - self._before)
        offset = (self._offset - rest[:, None] * moved) * np.exp(-dt / EASE_S * (1.0 - rest))[:, None]
        length, most = np.linalg.norm(offset, axis=1), DEADBAND * np.nan_to_num(sigma)
        offset *= np.divide(most, length, out=np.ones_like(length), where=length > most)[:, None]
        offset[np.isnan(estimates).any(axis=1)] = 0.0
        self._offset, self._before = offset, estimates
        return estimates + offset


class Soles:
    """Learns how high this person's heels and toes stand above the floor, and estimates feet's heights by that."""

    def __init__(self) -> None:
        self._heights, self._variances = SOLE[::2].copy(), SOLE_SIGMA**2
        self._moved: Floats | None = None

    @property
    def heights(self) -> Floats:
        """(4,) metres, of `SOLE`'s points."""
        return np.repeat(self._heights, 2)

    def settle(
        self, heights: Floats, variances: Floats, floor: Floats, floor_sigma: float, rest: Floats, known: Floats,
        dt: float,
    ) -> tuple[Floats, Floats, Floats]:  # fmt: skip
        """Heights of feet, as the filter and the floor have them.

        Args:
            heights: (4,) metres, world.
            variances: (4,) m², of these.
            floor: (4,) metres, world, under each; NaN where none is known.
            floor_sigma: metres, its standard deviation.
            rest: (4,) the probability that each rests.
            known: (4,) the probability that the floor, if any, measures a foot of such a body.
            dt: seconds since the last call.

        Returns:
            (4,) heights and (4,) variances of them; (4,) the probability that each stands on this floor.
        """
        own = np.repeat(self._variances, 2) + UNEVEN**2 + floor_sigma**2
        settled, left, stands = _settle(heights, variances, floor + self.heights, own, rest, known * (1.0 - OUTLIER))
        moved = np.nan_to_num(settled - heights)
        if self._moved is not None:
            moved = self._moved + (1.0 - math.exp(-dt / FLOOR_EASE_S)) * (moved - self._moved)
        self._moved = moved
        return heights + moved, left, stands

    def learn(self, above: Floats, sigma: Floats, stands: Floats, dt: float) -> None:
        """Take at what height above the floor the sensor has the feet, after ``dt`` seconds.

        Args:
            above: (4,) metres; NaN where either is not known.
            sigma: (4,) metres, the standard deviation of the sensor's errors.
            stands: (4,) the probability that each stands.
            dt: seconds, above 0.
        """
        _learn(self._heights, self._variances, above, sigma, stands, max(MEMORY_S / dt, 1.0))


@njit("(f8[:], f8[:], f8[:], f8[:], f8[:], f8[:])", cache=True)
def _settle(heights, variances, stand, stand_variances, rest, known):
    """Means and variances of heights, and the probability that each foot stands; see `Soles.settle`.

    A mixture of three: a foot stands, and its height is ``stand``; it does not, and is anywhere above that, so that
    only if it is seen below is it as if it stood; the floor is not as known. The second has the most likely height,
    not the mean: that of a foot hidden, and so seen with a large deviation, would be far above where it is seen.
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
    """Move (2,) heights and variances on, in place; see `Soles.learn`."""
    for k in range(len(above)):
        if stands[k] > 0.0 and math.isfinite(above[k] + sigma[k]):
            noise = (sigma[k] ** 2 + UNEVEN**2) * repeats / stands[k]
            gain = variances[k // 2] / (variances[k // 2] + noise)
            heights[k // 2] += gain * (above[k] - heights[k // 2])
            variances[k // 2] *= 1.0 - gain
