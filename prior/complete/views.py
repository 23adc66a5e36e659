"""Windows over a recording with gaps: each gap is inside a window with both its ends, and windows overlap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats

LONGEST_GAP = 64
"""Frames of the longest gap that the completer was trained on."""

AROUND = 7
"""Frames of context that a window has on each side of a gap, where the recording has them."""

LONGEST = LONGEST_GAP + 2 * AROUND
"""Frames of a window."""

_HOP = 32


class View(NamedTuple):
    """A window.

    Attributes:
        start: its first frame.
        weight: (frames,) of its output, beside those of the windows that overlap it.
    """

    start: int
    weight: Floats

    @property
    def frames(self) -> slice:
        return slice(self.start, self.start + len(self.weight))


class Gap(NamedTuple):
    """Frames ``start`` to ``end - 1``, of which nothing is known."""

    start: int
    end: int


def gaps(known: Bools) -> list[Gap]:
    """Runs of frames in which no joint is ``known`` (T, 22)."""
    blank = np.concatenate([[False], ~known.any(axis=1), [False]]).astype(np.int8)
    return [Gap(*ends) for ends in zip(*(np.flatnonzero(np.diff(blank) == d) for d in (1, -1)), strict=True)]


def views(known: Bools) -> list[View]:
    """Windows over all frames with a joint that is not ``known`` (T, 22); no gap may be longer than `LONGEST_GAP`.

    Gaps, with what lies between them where that is short, have windows of their own, for both ends have to be inside.
    The other frames have windows that overlap by half.
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
