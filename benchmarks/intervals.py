"""Means over people, with confidence intervals.

Clips of one person are alike. An interval over clips would say how well these people are known, not people in general.
So the mean is that of the people's own means. Its interval comes from drawing people, with all their clips, with
replacement (cluster bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
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
        mean: mean of the people's own means; NaN without people.
        low, high: 95 % interval; NaN for a single person.
        people: number of people.
    """

    mean: float
    low: float
    high: float
    people: int

    def text(self, digits: int, scale: float = 1.0) -> str:
        """Format for a table: the mean, with the interval in brackets if there is one; a dash if there is no mean."""
        if np.isnan(self.mean):
            return NONE
        mean, low, high = (f"{scale * value:.{digits}f}" for value in self[:3])
        return f"{mean} ({low}–{high})" if np.isfinite(self.low) else mean


def people_means(values: ArrayLike, people: Sequence[str] | NDArray[np.str_]) -> NDArray[np.float64]:
    """Return the mean of each person's clips (P,), in alphabetical order; ``values`` (N,), NaN where a clip has none,
    and ``people`` (N,) have one entry per clip. People without values are left out.
    """
    values, people = np.asarray(values, dtype=np.float64), np.asarray(people)
    known = np.isfinite(values)
    _, person = np.unique(people[known], return_inverse=True)
    return np.bincount(person, values[known]) / np.bincount(person)


def interval(values: ArrayLike, people: Sequence[str] | NDArray[np.str_]) -> Interval:
    """Return the mean over people of clips' values (N,), NaN where a clip has none, and its 95 % interval."""
    return _interval(people_means(values, people))


def ratio(values: ArrayLike, baseline: ArrayLike, people: Sequence[str] | NDArray[np.str_]) -> Interval:
    """Return the ratio of two methods' values (N,), above zero, on the same clips, with its interval: the geometric
    mean of the people's own ratios. A clip counts if both have a value.
    """
    values, baseline = np.asarray(values, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    both = np.isfinite(values) & np.isfinite(baseline)
    own = (people_means(np.where(both, v, np.nan), people) for v in (values, baseline))
    found = _interval(np.log(np.divide(*own)))
    return found._replace(mean=float(np.exp(found.mean)), low=float(np.exp(found.low)), high=float(np.exp(found.high)))


def _interval(means: NDArray[np.float64]) -> Interval:
    count = len(means)
    if count < 2:
        return Interval(float(means[0]) if count else np.nan, np.nan, np.nan, count)
    drawn = np.random.default_rng(0).integers(count, size=(DRAWS, count))
    low, high = np.quantile(means[drawn].mean(axis=1), (0.025, 0.975))
    return Interval(float(means.mean()), float(low), float(high), count)
