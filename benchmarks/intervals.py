"""Means over people, with the interval that so few people leave.

Clips of one person are alike: an interval over clips says how well these people are known, not people. So the mean is
that of the people's own means, and its interval is found by drawing people, with all their clips, with replacement
(cluster bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.benchmarks.results import NONE

DRAWS = 4000


class Interval(NamedTuple):
    """A mean over people.

    Attributes:
        mean: of the people's own means; NaN of nobody.
        low, high: the 95 % interval; NaN of a single person, about whom it says nothing.
        people: how many.
    """

    mean: float
    low: float
    high: float
    people: int

    def text(self, digits: int, scale: float = 1.0) -> str:
        """For a table: the mean, and in brackets the interval where there is one; a dash where there is no mean."""
        if np.isnan(self.mean):
            return NONE
        mean, low, high = (f"{scale * value:.{digits}f}" for value in self[:3])
        return f"{mean} ({low}–{high})" if np.isfinite(self.low) else mean


def people_means(values: ArrayLike, people: Sequence[str] | NDArray[np.str_]) -> NDArray[np.float64]:
    """(P,) the mean of each person's clips, people in alphabetical order; those of whom nothing is known are left out.

    Args:
        values: (N,) one a clip; NaN where a clip has none.
        people: (N,) whose clip it is.
    """
    values, people = np.asarray(values, dtype=np.float64), np.asarray(people)
    known = np.isfinite(values)
    _, person = np.unique(people[known], return_inverse=True)
    return np.bincount(person, values[known]) / np.bincount(person)


def interval(values: ArrayLike, people: Sequence[str] | NDArray[np.str_], seed: int = 0) -> Interval:
    """The mean over people and its 95 % interval.

    Args:
        values: (N,) one a clip; NaN where a clip has none.
        people: (N,) whose clip it is.
        seed: of the draws.
    """
    return _interval(people_means(values, people), seed)


def ratio(values: ArrayLike, baseline: ArrayLike, people: Sequence[str] | NDArray[np.str_], seed: int = 0) -> Interval:
    """The same of the ratio of two methods on the same clips: the geometric mean of the people's own ratios.

    Args:
        values: (N,) one a clip, above zero.
        baseline: (N,) the same of the other; a clip counts where both have a value.
        people: (N,) whose clip it is.
        seed: of the draws.
    """
    values, baseline = np.asarray(values, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    both = np.isfinite(values) & np.isfinite(baseline)
    own = (people_means(np.where(both, v, np.nan), people) for v in (values, baseline))
    found = _interval(np.log(np.divide(*own)), seed)
    return found._replace(mean=float(np.exp(found.mean)), low=float(np.exp(found.low)), high=float(np.exp(found.high)))


def _interval(means: NDArray[np.float64], seed: int) -> Interval:
    count = len(means)
    if count < 2:
        return Interval(float(means[0]) if count else np.nan, np.nan, np.nan, count)
    drawn = np.random.default_rng(seed).integers(count, size=(DRAWS, count))
    low, high = np.quantile(means[drawn].mean(axis=1), (0.025, 0.975))
    return Interval(float(means.mean()), float(low), float(high), count)
