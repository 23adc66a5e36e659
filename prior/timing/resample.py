"""Resamples a camera's frames with irregular stamps to the prior's 30 Hz grid, by capture time.

A tracker at 15 Hz may publish each result twice, because its camera runs at 30 Hz; repetitions are dropped
(`Republished`). If a camera is faster than the grid, frames between grid times reduce the noise of the others
(`DecimationFilter`).
"""

from __future__ import annotations

import statistics
from collections import deque
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.timing.rate import FPS

PERIOD_NS = round(1e9 / FPS)
MAX_GAP_NS = 150_000_000
"""Longest gap of a joint that is interpolated, nanoseconds."""
LOOK_AHEAD_NS = 10_000_000
"""Largest age of a frame at which it is extrapolated to the grid time without waiting for the next one, nanoseconds."""
LOOK_AHEAD_PERIODS = 0.35
"""The same limit for fast streams, periods. Extrapolation by a whole period multiplies the noise variance by 5."""
PERIOD_GAIN = 0.1  # weight of the newest period in the running mean of a stream's periods
RUNS = 9  # number of new frames over which repetitions are counted
RARE = 2  # number of the longest counts that are ignored, because a simulated person without noise may stand still
PERIODS = 7  # number of frame intervals whose median is a stream's period
REGULAR = (0.5, 1.5)  # range of the intervals between the frames used, as multiples of the median
ROUNDED, KEPT = 0.1, 0.55
"""Constants of the factor ``m``. It is the ratio of the rates minus the first constant, rounded, and changes only if it
differs from this by at least the second (hysteresis)."""
MAX_FACTOR = 8  # largest factor ``m``; in faster streams, only the nearest frames are used
MEMORY_S = 0.5  # time constant of the running means of squared residuals, seconds
MIN_FRAMES = 6  # number of frames of a joint before its noise is known
OUTLIER = 3.0
"""Largest residual at which a joint is filtered, standard deviations. Beyond it, the joint does not change, so that an
outlier does not affect its neighbours. Squares are clipped in the mean at `OUTLIER` squared times the mean."""


NONE = 1e-14
"""Largest squared residual that is rounding, m². Such joints stay bit for bit, as frozen joints must."""


class Frame(NamedTuple):
    """A frame of a stream: its stamp, positions (S, 22, 3) metres, NaN where unobserved, and confidences (S, 22)."""

    stamp_ns: int
    positions: Floats
    confidence: Floats


class Resampler:
    """Interpolates every slot's joints to grid times ``anchor + n / 30 s``, as frames arrive.

    Between two observations, a joint's position is interpolated linearly, with the lesser confidence. A grid frame is
    returned as soon as a frame at most 10 ms older has arrived. A stream of 30 Hz whose stamps jitter by a few
    milliseconds then has no extra frame of delay.

    Args:
        slots: largest number of bodies.
        grid_ns: a time of the grid, nanoseconds; if omitted, the grid starts at the first frame.
        delayed: whether the output is delayed anyway; see `DecimationFilter`.
    """

    def __init__(self, slots: int, *, grid_ns: int | None = None, delayed: bool = True) -> None:
        self._slots, self._grid_ns, self._delayed = slots, grid_ns, delayed
        self.reset()

    def reset(self) -> None:
        """Start a new grid at the next frame."""
        self._tick_ns: int | None = None  # the next grid time
        self._republished = Republished()
        self._decimation = DecimationFilter(self._slots, delayed=self._delayed)
        self._newest_ns: int | None = None
        self._period_ns = float(PERIOD_NS)
        self._gap_ns = 0
        self._is_slow = False  # whether the last two frames came after longer gaps than are interpolated
        self._observed_ns = np.full((2, self._slots, 22), np.iinfo(np.int64).min // 2)
        self._positions = np.full((2, self._slots, 22, 3), np.nan)
        self._confidence = np.zeros((2, self._slots, 22))

    def clear(self, slot: Bools) -> None:
        """Forget the observations of these slots (S,)."""
        self._observed_ns[:, slot] = np.iinfo(np.int64).min // 2
        self._decimation.clear(slot)

    def update(self, stamp_ns: int, positions: Floats, confidence: Floats) -> list[Frame]:
        """Process a frame (S, 22, 3) metres, NaN where unobserved, captured later than the last, and return the grid
        frames that it completes, oldest first. A republished frame is ignored."""
        if self._tick_ns is None:
            start_ns = stamp_ns if self._grid_ns is None else self._grid_ns
            self._tick_ns = start_ns - (start_ns - stamp_ns + LOOK_AHEAD_NS) // PERIOD_NS * PERIOD_NS
        if self._republished.update(positions):
            return []
        return self._gridded(self._decimation.update(Frame(stamp_ns, positions, confidence)))

    def drain(self) -> list[Frame]:
        """Return the grid frames that the decimation filter still holds at the end of a stream."""
        return self._gridded(self._decimation.drain())

    def _gridded(self, frames: list[Frame]) -> list[Frame]:
        return [gridded for frame in frames for gridded in self._interpolated(*frame)]

    def _interpolated(self, stamp_ns: int, positions: Floats, confidence: Floats) -> list[Frame]:
        if self._newest_ns is not None:
            before_ns, self._gap_ns = self._gap_ns, stamp_ns - self._newest_ns
            self._is_slow = min(before_ns, self._gap_ns) > MAX_GAP_NS
            self._period_ns += PERIOD_GAIN * (min(stamp_ns - self._newest_ns, PERIOD_NS) - self._period_ns)
        self._newest_ns = stamp_ns
        look_ahead_ns = min(LOOK_AHEAD_NS, round(LOOK_AHEAD_PERIODS * self._period_ns))
        observed = np.isfinite(positions[..., 0])
        # row 1 is each joint's last observation, row 0 the one before
        for store, value in (
            (self._observed_ns, np.full(observed.shape, stamp_ns)),
            (self._positions, positions),
            (self._confidence, confidence),
        ):
            store[0][observed] = store[1][observed]
            store[1][observed] = value[observed]
        frames = []
        while self._tick_ns is not None and self._tick_ns <= stamp_ns + look_ahead_ns:
            frames.append(Frame(self._tick_ns, *self._at(self._tick_ns, stamp_ns)))
            self._tick_ns += PERIOD_NS
        return frames

    def _at(self, tick: int, now: int) -> tuple[Floats, Floats]:
        before, after = self._observed_ns
        span = after - before
        between = (span <= MAX_GAP_NS) & (before - LOOK_AHEAD_NS <= tick) & (tick <= after + LOOK_AHEAD_NS)
        # each frame of a slow stream counts at one grid time, although it may be off by most of a period
        reach_ns = PERIOD_NS - LOOK_AHEAD_NS if self._is_slow else LOOK_AHEAD_NS
        alone = ~between & (after - reach_ns <= tick) & (tick <= after + LOOK_AHEAD_NS)
        share = np.where(between, (tick - before) / np.maximum(span, 1), 1.0)[..., None]
        earlier = np.where(between[..., None], self._positions[0], self._positions[1])
        positions = earlier + share * (self._positions[1] - earlier)
        known = (between | alone) & (now - after <= MAX_GAP_NS)
        confidence = np.where(between, self._confidence.min(axis=0), self._confidence[1])
        return np.where(known[..., None], positions, np.nan), np.where(known, confidence, 0.0)


class Republished:
    """Distinguishes frames that a stream repeats regularly from a body at rest without noise."""

    def __init__(self) -> None:
        self._newest: Floats | None = None
        self._run = 0
        self._runs: deque[int] = deque([0] * RUNS, maxlen=RUNS)

    def update(self, positions: Floats) -> bool:
        """Whether a frame repeats the last one. ``positions`` are (S, 22, 3), NaN where unobserved."""
        if self._newest is not None and np.array_equal(positions, self._newest, equal_nan=True):
            self._run += 1
            return self._run <= sorted(self._runs)[-RARE - 1]
        self._runs.append(self._run)
        self._run, self._newest = 0, positions.copy()
        return False


class DecimationFilter:
    """Anti-aliasing filter of each joint, for a stream of ``m`` times the grid's rate.

    It is a local quadratic regression (Savitzky and Golay 1964, with the frames' own stamps). A frame is fitted
    together with the frames of two grid periods before it and of half a period after it, for which it waits.
    Independent noise leaves the same residuals in every ``m``-th frame as in all frames. Residuals of motion grow with
    the third power of the frames' distance. The ratio of the two gives the share of noise in a residual, and that share
    is removed. Motion without noise does not change.

    Args:
        slots: largest number of bodies.
        delayed: whether the output is delayed anyway. If not, a frame waits only for its successor, and only if that
            arrives within half a period.
    """

    def __init__(self, slots: int, *, delayed: bool) -> None:
        self._delayed = delayed
        self._periods: deque[int] = deque(maxlen=PERIODS)
        self._factor, self._successors = 1, 0
        self._frames: deque[Frame] = deque(maxlen=1)
        self._waiting = 0
        self._motion = 1.0  # ratio of motion's squared residuals in all frames to those in every m-th
        self._squares = np.zeros((2, slots, 22))
        self._counted = np.zeros((slots, 22))

    def clear(self, slot: Bools) -> None:
        """Forget the joints of these slots (S,)."""
        for frame in self._frames:
            frame.positions[slot] = np.nan
        self._counted[slot] = 0

    def update(self, frame: Frame) -> list[Frame]:
        """Process a frame and return the frames that need not wait, oldest first."""
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
        """Return the frames that wait for successors, unfiltered."""
        waiting, self._waiting = self._waiting, 0
        return list(self._frames)[len(self._frames) - waiting :]

    def _adapt_factor(self) -> bool:
        """Adapt the factor to the stream's rate; returns whether it has changed."""
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
        """Select from ``3 m + 1`` values those that a frame is fitted to, and every ``m``-th value."""
        return values[-1 - self._successors - 2 * self._factor :], values[:: self._factor]

    def _filtered(self) -> Frame:
        """Return the frame that now has its successors, filtered."""
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
    """Quadratics fitted to positions."""

    value: Floats  # (..., 3) value at time 0
    square: Floats  # (...) squared residual vectors, summed and divided by the degrees of freedom
    largest: Floats  # (...) length of the largest residual vector


def _fit(time: Floats, positions: Floats) -> _Fit:
    """Fit quadratics to positions (T, ..., 3) at times (T,)."""
    basis = np.vander(time, 3, increasing=True)
    solved = np.linalg.pinv(basis)
    residuals = positions - np.einsum("st,t...->s...", basis @ solved, positions)
    squares = np.square(residuals).sum(axis=-1)
    value = np.einsum("t,t...->...", solved[0], positions)
    return _Fit(value, squares.sum(axis=0) / (len(time) - 3), np.sqrt(squares.max(axis=0)))
