"""From a camera's irregular stamps to the prior's 30 Hz grid, by capture time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.timing.decimate import DecimationFilter, Frame
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.republished import Republished

PERIOD_NS = round(1e9 / FPS)
MAX_GAP_NS = 150_000_000
"""A joint not seen for longer than this is missing in between, not interpolated."""
LOOK_AHEAD_NS = 10_000_000
"""A frame this much older than its grid time is carried forward to it, rather than waiting for the next frame."""
LOOK_AHEAD_PERIODS = 0.35
"""The same in periods of the stream, for fast ones: extrapolated by a whole period, noise has 5 times its variance."""
PERIOD_GAIN = 0.1
"""Weight of the newest in the running mean of a stream's periods."""


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
