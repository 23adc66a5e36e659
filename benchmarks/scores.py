"""Scores of a method over clips: one number per clip, means over people with confidence intervals, and tables.

Clips of one person are alike. An interval over clips would say how well these people are known, not people in general.
So the mean is that of the people's own means. Its interval comes from drawing people, with all their clips, with
replacement (cluster bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.benchmarks.metrics import acceleration_error, mean_mm, position_error
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import NONE, Table
from steadypose.prior.arrays import Floats


class Scores(NamedTuple):
    """One number per clip, (C,), NaN where a clip has no such joint."""

    position: Floats  # metres: MPJPE
    seen: Floats  # metres, of observed joints
    hidden: Floats  # metres, of hidden joints
    acceleration: Floats  # metres/frame², the error


def score(answer: Floats, truth: Floats, hidden: NDArray[np.bool_]) -> Scores:
    """Compare (T, C, 22, 3) metres; ``hidden`` (T, C, 22)."""
    error = position_error(answer, truth)
    groups = error, np.where(hidden, np.nan, error), np.where(hidden, error, np.nan), acceleration_error(answer, truth)
    return Scores(*map(_mean, groups))


def figures(scores: Scores) -> dict[str, float]:
    """Return means over C clips, mm and mm/frame², of what has a value."""
    found = {f"{name}_mm": mean_mm(values) for name, values in scores._asdict().items()}
    return {name: value for name, value in found.items() if not np.isnan(value)}


def pivot(
    records: Sequence[Mapping[str, Any]], column: str, figure: str, name: str, title: str, note: str, digits: int = 1
) -> Table:
    """Build a table with a row for each method and delay, and a column for each value of ``column``; text is kept as it
    is."""
    columns = list(dict.fromkeys(record[column] for record in records))
    rows: dict[tuple[str, int], dict[str, str]] = {}
    for record in records:
        value = record.get(figure)
        cell = "–" if value is None else value if isinstance(value, str) else f"{value:.{digits}f}"
        rows.setdefault((record["method"], record["delay"]), {})[record[column]] = cell
    run = list(dict.fromkeys(method for method, _ in rows))
    return Table(
        name=name,
        title=title,
        columns=["method", "delay, frames", *columns],
        rows=[
            [method, "offline" if delay < 0 else str(delay), *(cells.get(c, "–") for c in columns)]
            for (method, delay), cells in sorted(rows.items(), key=lambda row: (run.index(row[0][0]), row[0][1]))
        ],
        note=note,
    )


def _mean(values: Floats) -> Floats:
    """Return the mean over the frames and joints of every clip: (T, C, J) to (C,)."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=(0, 2)), known.sum(axis=(0, 2))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


_LEAST = 1e-6
"""Lower bound of the errors in a ratio, metres."""


def source_table(
    name: str, title: str, errors: Mapping[tuple[str, str], NDArray[np.float64]], clips: MotionClips, baseline: str
) -> Table:
    """Build a table with a column for each source, the mean over people, and its ratio to ``baseline`` in the same
    condition.

    ``errors`` are (C,) metres by condition and method, NaN for a clip without such an error.
    """
    sources = list(dict.fromkeys(clips.data_set.tolist()))
    rows = []
    for (condition, method), found in errors.items():
        by_source = [interval(found[clips.data_set == s], clips.person[clips.data_set == s]).mean for s in sources]
        of_baseline = ratio(np.maximum(found, _LEAST), np.maximum(errors[condition, baseline], _LEAST), clips.person)
        rows.append([
            f"{condition}: {method}", *(NONE if np.isnan(mean) else f"{1e3 * mean:.1f}" for mean in by_source),
            interval(found, clips.person).text(1, 1e3), of_baseline.text(2),
        ])  # fmt: skip
    note = (
        f"{len(clips.offsets)} clips of {len(set(clips.person.tolist()))} people, each of whom counts once; in "
        "brackets, the 95 % interval over people."
    )
    return Table(name, title, ["", *sources, "mean over people", f"of: {baseline}"], rows, note)


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
