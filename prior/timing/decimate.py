"""For cameras faster than the grid: frames between grid times are not thrown away, they take noise off the others."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

PERIODS = 7
"""Periods of which the median is a stream's."""
REGULAR = (0.5, 1.5)
"""Periods of the frames that are used, as multiples of the median."""
ROUNDED, KEPT = 0.1, 0.55
"""``m`` is the quotient of the rates, less the first, rounded; it is kept as long as it is off by less than the
second."""
MAX_FACTOR = 8
"""Of still faster streams the nearest frames are used alone."""
MEMORY_S = 0.5
"""Of the running means of squared residuals."""
MIN_FRAMES = 6
"""Frames of a joint before its noise is known."""
OUTLIER = 3.0
"""Standard deviations: a residual above this leaves the joint as it came, so that an outlier is not spread over its
neighbours; a square enters the mean at most `OUTLIER` squared times as large as the mean."""


NONE = 1e-14
"""Square metres: a smaller residual is rounding; such joints stay as they came to the last bit, as frozen ones must."""


class Frame(NamedTuple):
    """A frame of a stream: its stamp, positions (S, 22, 3) metres, NaN where unobserved, and confidences (S, 22)."""

    stamp_ns: int
    positions: Floats
    confidence: Floats


class DecimationFilter:
    """Local quadratic regression (Savitzky and Golay 1964, with the frames' own stamps) of each joint, before a stream
    of ``m`` times the grid's rate is decimated.

    A frame is fitted with the frames of two periods of the grid before it, and of half a period after it, for which it
    waits. Noise that differs from frame to frame leaves the same residuals in every ``m``-th frame as in all; what
    motion leaves grows with the third power of their distance. The ratio of the two says how much of a residual is
    noise, and so much of it is taken away: motion without noise stays as it came.

    Args:
        slots: bodies at most.
        delayed: whether answers are delayed anyway; if not, a frame waits for its successor alone, and only if that is
            sooner than half a period.
    """

    def __init__(self, slots: int, *, delayed: bool) -> None:
        self._delayed = delayed
        self._periods: deque[int] = deque(maxlen=PERIODS)
        self._factor, self._successors = 1, 0
        self._frames: deque[Frame] = deque(maxlen=1)
        self._waiting = 0
        self._motion = 1.0  # squared residuals of motion in all frames, by those in every m-th
        self._squares = np.zeros((2, slots, 22))
        self._counted = np.zeros((slots, 22))

    def clear(self, slot: NDArray[np.bool_]) -> None:
        """Forget the joints of these slots (S,)."""
        for frame in self._frames:
            frame.positions[slot] = np.nan
        self._counted[slot] = 0

    def update(self, frame: Frame) -> list[Frame]:
        """Take a frame, and give those that need not wait, oldest first."""
        if self._frames:
            self._periods.append(frame.stamp_ns - self._frames[-1].stamp_ns)
        passed = self.drain() if self._adapt_factor() else []
        self._frames.append(frame._replace(positions=frame.positions.copy()))
        if self._waiting < self._successors:
            self._waiting += 1
        else:
            passed.append(self._filtered())
        return passed

    def drain(self) -> list[Frame]:
        """The frames that wait for successors, as they came."""
        waiting, self._waiting = self._waiting, 0
        return list(self._frames)[len(self._frames) - waiting :]

    def _adapt_factor(self) -> bool:
        """Follow the stream's rate; whether the factor has changed."""
        if len(self._periods) < PERIODS:
            return False
        ratio = min(1e9 / FPS / float(np.median(self._periods)) - ROUNDED, MAX_FACTOR)
        if abs(ratio - self._factor) < KEPT:
            return False
        factor = round(ratio)
        if factor < (2 if self._delayed else 3):
            factor = 1
        if factor == self._factor:
            return False
        self._factor = factor
        self._successors = factor // 2 if self._delayed else min(factor // 2, 1)
        self._frames = deque(self._frames, maxlen=3 * factor + 1)
        self._counted[:] = 0
        if factor > 1:
            time = np.arange(3 * factor + 1.0) / factor
            every, some = (_fit(t, (t**3)[:, None]).square for t in self._windows(time))
            self._motion = float(every / some)
        return True

    def _windows(self, values: Floats) -> tuple[Floats, Floats]:
        """Of ``3 m + 1`` values, those that a frame is fitted to, and every ``m``-th."""
        return values[-1 - self._successors - 2 * self._factor :], values[:: self._factor]

    def _filtered(self) -> Frame:
        """The frame that has its successors."""
        frame = self._frames[-1 - self._successors]
        if self._factor == 1 or len(self._frames) <= 3 * self._factor or not self._is_regular():
            return frame
        positions = np.stack([f.positions for f in self._frames])
        time = (np.array([f.stamp_ns for f in self._frames]) - frame.stamp_ns) * (FPS * 1e-9)
        every, some = (_fit(t, p) for t, p in zip(self._windows(time), self._windows(positions), strict=True))
        known = np.isfinite(every.square) & np.isfinite(some.square)
        self._counted += known
        bound = np.where(self._counted > MIN_FRAMES, OUTLIER**2 * self._squares, np.inf)
        gain = np.maximum(1.0 / np.maximum(self._counted, 1.0), 1.0 / (MEMORY_S * FPS * self._factor))
        change = np.minimum([every.square, some.square], bound) - self._squares
        self._squares += np.where(known, gain * change, 0.0)
        noise, both = self._squares
        share = np.clip((noise / np.maximum(both, 1e-12) - self._motion) / (1.0 - self._motion), 0.0, 1.0)
        usual = (every.largest <= OUTLIER * np.sqrt(noise)) & (every.square > NONE)
        fitted = (known & usual & (self._counted >= MIN_FRAMES) & (share > 0.0))[..., None]
        came = frame.positions
        return frame._replace(positions=np.where(fitted, came + share[..., None] * (every.value - came), came))

    def _is_regular(self) -> bool:
        periods = np.diff([f.stamp_ns for f in self._frames]) / float(np.median(self._periods))
        return bool((periods > REGULAR[0]).all() and (periods < REGULAR[1]).all())


class _Fit(NamedTuple):
    """Quadratics through positions."""

    value: Floats  # (..., 3) at time 0
    square: Floats  # (...) mean squared residual, a vector's, by degrees of freedom
    largest: Floats  # (...) length of the largest residual


def _fit(time: Floats, positions: Floats) -> _Fit:
    """Fit positions (T, ..., 3) at ``time`` (T,)."""
    basis = np.vander(time, 3, increasing=True)
    solved = np.linalg.pinv(basis)
    residuals = positions - np.einsum("st,t...->s...", basis @ solved, positions)
    squares = np.square(residuals).sum(axis=-1)
    value = np.einsum("t,t...->...", solved[0], positions)
    return _Fit(value, squares.sum(axis=0) / (len(time) - 3), np.sqrt(squares.max(axis=0)))
