"""Where a recording with holes is looked at: windows that see both ends of every gap and overlap between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Floats = NDArray[np.float64]

LONGEST_GAP = 64
"""Frames of a gap that the completer has learned to fill."""

AROUND = 7
"""Frames about a gap that a window takes along, where they are known."""

LONGEST = LONGEST_GAP + 2 * AROUND
"""Frames of a window."""

_HOP = 32


class View(NamedTuple):
    """A window.

    Attributes:
        start: its first frame.
        weight: (frames,) how much its answer counts beside those of the windows that overlap it.
    """

    start: int
    weight: Floats

    @property
    def frames(self) -> slice:
        return slice(self.start, self.start + len(self.weight))


class Gap(NamedTuple):
    """Frames of which nothing is known, from ``start`` up to ``end``."""

    start: int
    end: int


def gaps(known: Bools) -> list[Gap]:
    """Runs of frames of which no joint (T, 22) is known."""
    blank = np.concatenate([[False], ~known.any(axis=1), [False]]).astype(np.int8)
    return [Gap(*ends) for ends in zip(*(np.flatnonzero(np.diff(blank) == d) for d in (1, -1)), strict=True)]


def views(known: Bools) -> list[View]:
    """Windows over all frames of which a joint (T, 22) is not known; no gap may be longer than `LONGEST_GAP`.

    Gaps, and what lies between them if it is short, have windows of their own: only they see both ends. The rest is
    looked at by windows that overlap by half.
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
        # within a gap that the next windows or the last ones see but one end of, this one alone is asked
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
