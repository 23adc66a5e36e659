"""Metrics as the papers define them, and scores of a method over clips: one number per clip, means over people with
confidence intervals, and tables. Units are SI; NaN where there is nothing to compare.

Clips of one person are alike. An interval over clips would say how well these people are known, not people in general.
So the mean is that of the people's own means. Its interval comes from drawing people, with all their clips, with
replacement (cluster bootstrap: Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 3.8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import NONE, Table
from steadypose.prior.arrays import Floats


def position_error(estimate: Floats, truth: Floats) -> Floats:
    """Return the distance between (T, J, 3) and (T, J, 3), metres: (T, J). Its mean is the MPJPE."""
    return np.linalg.norm(estimate - truth, axis=-1)


def acceleration_error(estimate: Floats, truth: Floats) -> Floats:
    """Return the norm of the difference of the second differences, (T-2, J) metres/frame² (Kanazawa et al. 2019).

    Multiply by fps² for m/s²: at 30 Hz, 1 mm/frame² is 0.9 m/s².
    """
    return np.linalg.norm(np.diff(estimate - truth, n=2, axis=0), axis=-1)


def errors_mm(estimate: Floats, truth: Floats) -> dict[str, float]:
    """Return the mean errors of joints (T, ..., 3) metres, NaN left out: position, mm, and acceleration, mm/frame²."""
    errors = {"position_mm": position_error(estimate, truth), "acceleration_mm": acceleration_error(estimate, truth)}
    return {name: mean_mm(values) for name, values in errors.items()}


def mean_mm(values: Floats) -> float:
    """Return the mean of the finite values, metres, in mm; NaN if there is none."""
    known = values[np.isfinite(values)]
    return round(1e3 * float(known.mean()), 4) if len(known) else float("nan")


def length_variation(positions: Floats, bones: Sequence[tuple[int, int]]) -> float:
    """Return the variation of the lengths of ``bones`` (pairs of joints) of positions (T, J, 3): standard deviation
    over time by mean length, averaged over bones.
    """
    ends, starts = np.array(bones).T
    lengths = np.linalg.norm(positions[:, ends] - positions[:, starts], axis=-1)
    return float(np.mean(np.nanstd(lengths, axis=0) / np.nanmean(lengths, axis=0)))


def contact_speed(positions: Floats, contact: NDArray[np.bool_], stamps_s: Floats) -> Floats:
    """Return the horizontal speed of joints (T, J, 3) metres, z up, in contact (T, J) in both frames, m/s: (T-1, J),
    else NaN.

    Each foot counts separately. The mean is the foot skate.
    """
    speed = np.linalg.norm(np.diff(positions[..., :2], axis=0), axis=-1) / np.diff(stamps_s)[:, None]
    return np.where(contact[1:] & contact[:-1], speed, np.nan)


def procrustes(source: Floats, target: Floats) -> Floats:
    """Align ``source`` (..., J, 3) with ``target`` in each frame by rotation, translation and scale, for PA-MPJPE.

    Joints that are not finite in either are left out of the fit (Umeyama 1991).
    """
    both = (np.isfinite(source) & np.isfinite(target)).all(axis=-1, keepdims=True)
    count = np.maximum(both.sum(axis=-2, keepdims=True), 1)
    a, b = np.where(both, source, 0.0), np.where(both, target, 0.0)
    middle_a, middle_b = a.sum(axis=-2, keepdims=True) / count, b.sum(axis=-2, keepdims=True) / count
    a, b = np.where(both, a - middle_a, 0.0), np.where(both, b - middle_b, 0.0)
    u, values, vt = np.linalg.svd(a.swapaxes(-1, -2) @ b)
    mirrored = np.linalg.det(u @ vt) < 0
    signs = np.stack([np.ones_like(mirrored), np.ones_like(mirrored), np.where(mirrored, -1, 1)], axis=-1)
    rotation = (u * signs[..., None, :]) @ vt  # acts from the right
    scale = (values * signs).sum(axis=-1) / np.maximum((a**2).sum(axis=(-1, -2)), 1e-12)
    return scale[..., None, None] * ((source - middle_a) @ rotation) + middle_b


def sigma_ratio(error: Floats, sigma: Floats) -> float:
    """Return the error-to-sigma ratio, 1 when calibrated: the root mean square of ``error`` (distance in space) over
    ``sigma``, along an axis. Entries with infinite sigma or NaN error are left out.
    """
    ratio = error / sigma / np.sqrt(3)
    known = np.isfinite(ratio) & np.isfinite(sigma)
    return float(np.sqrt(np.mean(ratio[known] ** 2))) if known.any() else float("nan")


def reliability(error: Floats, sigma: Floats, bins: int = 10) -> list[tuple[float, float, int]]:
    """Return (predicted, observed, count) for ``bins`` equal parts of the joints, sorted by their predicted deviation.

    Both are root mean squares along an axis, metres. For the arguments see `sigma_ratio`.
    """
    known = np.isfinite(error) & np.isfinite(sigma)
    order = np.argsort(sigma[known], kind="stable")
    return [
        (float(np.sqrt(np.mean(stated**2))), float(np.sqrt(np.mean(found**2) / 3)), len(stated))
        for stated, found in zip(
            np.array_split(sigma[known][order], bins), np.array_split(error[known][order], bins), strict=True
        )
        if len(stated)
    ]


def quaternion_distance(estimate: Floats, truth: Floats) -> Floats:
    """Return LAFAN1's L2Q (Harvey et al. 2020): the norm of the difference of global rotations (T, J, 4), (T,).

    A quaternion and its opposite are the same rotation; the nearer one is compared.
    """
    sign = np.where((estimate * truth).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    return np.sqrt(((sign * estimate - truth) ** 2).sum(axis=(-1, -2)))


def npss(estimate: Floats, truth: Floats) -> float:
    """Return the normalised power spectrum similarity of motions (N, T, D); 0 is identical (Gopalakrishnan et al.
    2019).

    Power spectra over time are normalised to sum 1 and compared by the earth mover's distance over frequencies. Tracks
    are weighted by their true power.
    """
    power = [np.abs(np.fft.fft(x, axis=1)) ** 2 for x in (truth, estimate)]
    total = power[0].sum(axis=1)
    shares = [np.cumsum(p / np.maximum(p.sum(axis=1, keepdims=True), 1e-12), axis=1) for p in power]
    return float((np.abs(shares[1] - shares[0]).sum(axis=1) * total).sum() / total.sum())


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
    cells = [
        [method, "offline" if delay < 0 else str(delay), *(found.get(c, "–") for c in columns)]
        for (method, delay), found in sorted(rows.items(), key=lambda row: (run.index(row[0][0]), row[0][1]))
    ]
    return Table(name, title, ["method", "delay, frames", *columns], cells, note)


def _mean(values: Floats) -> Floats:
    """Return the mean over the frames and joints of every clip: (T, C, J) to (C,)."""
    known = np.isfinite(values)
    total, count = np.where(known, values, 0.0).sum(axis=(0, 2)), known.sum(axis=(0, 2))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


_LEAST = 1e-6  # lower bound of the errors in a ratio, metres


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
    """Mean of the people's own means, NaN without people; its 95 % interval, NaN for one person; number of people."""

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
