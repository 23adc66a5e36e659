"""Where a recording has gaps, and the windows in which they are filled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats

LONGEST_GAP = 64
"""Longest gap on which the completer is trained, frames."""

AROUND = 7
"""Context of a window on each side of a gap, if the recording has it, frames."""

LONGEST = LONGEST_GAP + 2 * AROUND
"""Longest window, frames."""

_HOP = 32


class View(NamedTuple):
    """A window."""

    start: int
    """its first frame"""
    weight: Floats
    """(frames,) weight of its output where windows overlap"""

    @property
    def frames(self) -> slice:
        return slice(self.start, self.start + len(self.weight))


class Gap(NamedTuple):
    """Frames ``start`` to ``end - 1``, in which no joint is known."""

    start: int
    end: int


def frames_apart(known: NDArray[np.bool_]) -> Floats:
    """(T, K) frames to the nearest frame in which each column is ``known`` (T, K); infinite if there is none."""
    return np.minimum(*frames_since_and_until(known))


def frames_since_and_until(known: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """(T, K) frames since the last and until the next frame in which each column is ``known``; infinite if none."""
    at = np.arange(len(known), dtype=np.float64)[:, None]
    before = np.maximum.accumulate(np.where(known, at, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(known, at, np.inf)[::-1], axis=0)[::-1]
    return at - before, after - at


def gaps(known: Bools) -> list[Gap]:
    """Return the runs of frames in which no joint is ``known`` (T, 22)."""
    blank = np.concatenate([[False], ~known.any(axis=1), [False]]).astype(np.int8)
    return [Gap(*ends) for ends in zip(*(np.flatnonzero(np.diff(blank) == d) for d in (1, -1)), strict=True)]


def views(known: Bools) -> list[View]:
    """Return windows over all frames with unknown joints (T, 22). No gap may be longer than `LONGEST_GAP`.

    A gap, or several gaps close together, gets its own window, because both ends must lie inside. The other frames get
    windows that overlap by half.
    """
    frames = len(known)
    own = np.zeros(frames)
    found: list[View] = []
    waiting = gaps(known)
    while waiting:
        first = max(waiting[0].start - AROUND, 0)
        taken = 1
        while taken < len(waiting) and waiting[taken].end + AROUND - first <= LONGEST:
            taken += 1
        last = min(waiting[taken - 1].end + AROUND, frames)
        weight = np.ones(last - first)
        rise, fall = waiting[0].start - first, last - waiting[taken - 1].end
        if rise:
            weight[:rise] = (np.arange(rise) + 1.0) / (rise + 1.0)
        if fall:
            weight[-fall:] = (np.arange(fall, 0, -1)) / (fall + 1.0)
        # a gap of which this window sees only one end is left to the window that contains both
        for gap in gaps(known[first:last]):
            if not any(gap.start + first == whole.start and gap.end + first == whole.end for whole in waiting[:taken]):
                weight[gap.start : gap.end] = 0.0
        found.append(View(first, weight))
        own[first:last] = np.maximum(own[first:last], weight)
        waiting = waiting[taken:]
    for run in _runs(~known.all(axis=1) & (own < 1.0)):
        first = max(run.start - AROUND, 0)
        more = max(-(-(run.end - first - LONGEST) // _HOP), 0)
        for start in range(first, first + more * _HOP + 1, _HOP):
            end = min(start + LONGEST, frames)
            weight = np.minimum(np.arange(1, end - start + 1), np.arange(end - start, 0, -1)) / (end - start)
            found.append(View(start, weight * (1.0 - own[start:end])))
    return found


def _runs(rows: Bools) -> list[Gap]:
    return gaps(~rows[:, None])
