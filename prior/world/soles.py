"""What a floor known well says of the heights of feet: those that stand are on it, and none is under it.

A sensor's error of one foot's height lasts, so that no filter that sees the foot alone finds it; that a foot stands on
the floor, at the height at which this person's feet stand, is another measurement of the same height. It is taken at
publication, not by the filter: a lasting error taken anew each frame would be believed ever more.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SOLE: Floats = np.array([0.07, 0.07, 0.022, 0.022])
"""(4,) metres from the floor to heels and toes (left, right) while they stand: the median over labelled contacts of the
training motion, the mean over its five sources."""

SOLE_SIGMA: Floats = np.array([0.013, 0.006])
"""(2,) metres, the standard deviation of heels' and of toes' between the people of the training motion."""

UNEVEN = 0.006
"""Metres, the standard deviation of the height of one person's foot from stand to stand, there."""

MEMORY_S = 1.5
"""Seconds for which an error of the height of a standing foot lasts: frames closer together tell the same again."""

EASE_S = 0.05
"""Seconds, the time constant by which feet come to be where the floor has them: what they are off by lasts longer."""

AIR_M = 0.1
"""Metres above the floor among which feet that do not stand, or stand on something else, are taken to be."""

SURPRISE = 0.05
"""Probability that the floor is not where it is known to be."""


class Soles:
    """How high this person's heels and toes stand above the floor, as it is learned, and where feet are by that."""

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
        """Weigh where feet are seen against the floor.

        Args:
            heights: (4,) metres, world.
            variances: (4,) m², of these.
            floor: (4,) metres, world, under each; NaN where none is known.
            floor_sigma: metres, its standard deviation.
            rest: (4,) the probability that each rests.
            known: (4,) the probability that the floor, if any, says something of a foot of such a body.
            dt: seconds since the last call.

        Returns:
            (4,) heights and (4,) variances of them; (4,) the probability that each stands on this floor.
        """
        own = np.repeat(self._variances, 2) + UNEVEN**2 + floor_sigma**2
        settled, left, stands = _settle(heights, variances, floor + self.heights, own, rest, known * (1.0 - SURPRISE))
        moved = np.nan_to_num(settled - heights)
        if self._moved is not None:
            moved = self._moved + (1.0 - math.exp(-dt / EASE_S)) * (moved - self._moved)
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
