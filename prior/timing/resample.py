"""From a camera's irregular stamps to the prior's 30 Hz grid, by capture time.

Frames that a tracker at 15 Hz gives twice, because its camera has 30, are dropped (`Republished`). Of cameras faster
than the grid, frames between grid times are not thrown away: they take noise off the others (`DecimationFilter`).
"""

from __future__ import annotations

import statistics
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

PERIOD_NS = round(1e9 / FPS)
MAX_GAP_NS = 150_000_000
"""A joint not seen for longer than this is missing in between, not interpolated."""
LOOK_AHEAD_NS = 10_000_000
"""A frame this much older than its grid time is carried forward to it, rather than waiting for the next frame."""
LOOK_AHEAD_PERIODS = 0.35
"""The same in periods of the stream, for fast ones: extrapolated by a whole period, noise has 5 times its variance."""
PERIOD_GAIN = 0.1
"""Weight of the newest in the running mean of a stream's periods."""

RUNS = 9
"""New frames over which repetitions are counted."""
RARE = 2
"""So many of the longest counts are left out: somebody simulated, who moves without noise, may stand still."""

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


class Resampler:
    """Interpolates every slot's joints to grid times ``anchor + n / 30 s``, as frames come in.

    Between two observations of a joint its position is interpolated linearly, with the lesser confidence. A grid
    frame is returned as soon as a frame is no more than 10 ms older: a stream of 30 Hz whose stamps jitter by a
    few milliseconds then costs no extra frame of delay.

    Args:
        slots: bodies at most.
        aligned: whether the grid lies at whole multiples of its period, rather than at the first frame.
        delayed: whether answers are delayed anyway; see `DecimationFilter`.
    """

    def __init__(self, slots: int, *, aligned: bool = False, delayed: bool = True) -> None:
        self._slots, self._aligned, self._delayed = slots, aligned, delayed
        self.reset()

    def reset(self) -> None:
        """Start a new grid at the next frame."""
        self._tick_ns: int | None = None  # the next grid time
        self._republished = Republished()
        self._decimation = DecimationFilter(self._slots, delayed=self._delayed)
        self._newest_ns: int | None = None
        self._period_ns = float(PERIOD_NS)
        self._seen_ns = np.full((2, self._slots, 22), np.iinfo(np.int64).min // 2)
        self._positions = np.full((2, self._slots, 22, 3), np.nan)
        self._confidence = np.zeros((2, self._slots, 22))

    def clear(self, slot: NDArray[np.bool_]) -> None:
        """Forget the observations of these slots (S,)."""
        self._seen_ns[:, slot] = np.iinfo(np.int64).min // 2
        self._decimation.clear(slot)

    def update(self, stamp_ns: int, positions: Floats, confidence: Floats) -> list[Frame]:
        """Take a frame and give the grid frames that it completes; one that is republished counts as none.

        Args:
            stamp_ns: capture time, later than the last.
            positions: (S, 22, 3) metres, NaN where unobserved.
            confidence: (S, 22).

        Returns:
            Frames of the grid times reached, oldest first.
        """
        if self._tick_ns is None:
            first = -(-(stamp_ns - LOOK_AHEAD_NS) // PERIOD_NS) * PERIOD_NS  # rounded up
            self._tick_ns = first if self._aligned else stamp_ns
        if self._republished.update(positions):
            return []
        return self._gridded(self._decimation.update(Frame(stamp_ns, positions, confidence)))

    def drain(self) -> list[Frame]:
        """The grid frames that the decimation filter still holds, at the end of a stream."""
        return self._gridded(self._decimation.drain())

    def _gridded(self, frames: list[Frame]) -> list[Frame]:
        return [gridded for frame in frames for gridded in self._interpolated(*frame)]

    def _interpolated(self, stamp_ns: int, positions: Floats, confidence: Floats) -> list[Frame]:
        if self._newest_ns is not None:
            self._period_ns += PERIOD_GAIN * (min(stamp_ns - self._newest_ns, PERIOD_NS) - self._period_ns)
        self._newest_ns = stamp_ns
        look_ahead_ns = min(LOOK_AHEAD_NS, round(LOOK_AHEAD_PERIODS * self._period_ns))
        seen = np.isfinite(positions[..., 0])
        # Row 1 is each joint's last observation, row 0 the one before.
        for store, value in (
            (self._seen_ns, np.full(seen.shape, stamp_ns)),
            (self._positions, positions),
            (self._confidence, confidence),
        ):
            store[0][seen] = store[1][seen]
            store[1][seen] = value[seen]
        frames = []
        while self._tick_ns is not None and self._tick_ns <= stamp_ns + look_ahead_ns:
            frames.append(Frame(self._tick_ns, *self._at(self._tick_ns, stamp_ns)))
            self._tick_ns += PERIOD_NS
        return frames

    def _at(self, tick: int, now: int) -> tuple[Floats, Floats]:
        before, after = self._seen_ns
        span = after - before
        between = (span <= MAX_GAP_NS) & (before - LOOK_AHEAD_NS <= tick) & (tick <= after + LOOK_AHEAD_NS)
        alone = ~between & (np.abs(tick - after) <= LOOK_AHEAD_NS)
        share = np.where(between, (tick - before) / np.maximum(span, 1), 1.0)[..., None]
        earlier = np.where(between[..., None], self._positions[0], self._positions[1])
        positions = earlier + share * (self._positions[1] - earlier)
        known = (between | alone) & (now - after <= MAX_GAP_NS)
        confidence = np.where(between, self._confidence.min(axis=0), self._confidence[1])
        return np.where(known[..., None], positions, np.nan), np.where(known, confidence, 0.0)


class Republished:
    """Tells repetitions that a stream makes regularly, which bring nothing new, from a body at rest without noise."""

    def __init__(self) -> None:
        self._newest: NDArray[np.float64] | None = None
        self._run = 0
        self._runs: deque[int] = deque([0] * RUNS, maxlen=RUNS)

    def update(self, positions: NDArray[np.float64]) -> bool:
        """Whether a frame, of joints (S, 22, 3) with NaN where unobserved, is the one before, republished."""
        if self._newest is not None and np.array_equal(positions, self._newest, equal_nan=True):
            self._run += 1
            return self._run <= sorted(self._runs)[-RARE - 1]
        self._runs.append(self._run)
        self._run, self._newest = 0, positions.copy()
        return False


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
        ratio = min(1e9 / FPS / statistics.median(self._periods) - ROUNDED, MAX_FACTOR)
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
