"""The last frames of every body: source of the models' windows, and of the frames still to be published."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import Gated
from steadypose.prior.timing.rate import FPS

BRIDGED = 3
"""Frames: gaps of the whole body up to this long are interpolated linearly. The models are trained on hidden limbs, not
on flickering bodies, and would pass the flicker on."""

BRIEF_S = 2.5 / FPS
"""Seconds: a joint that was seen less long ago, and is seen again within the delay, is treated like those seen.
Of joints dropped in three of ten frames, the acceleration error is 2.5 instead of 2.8 mm/frame² (validation)."""


class Ring:
    """The last ``frames`` arrays of one shape, readable at once and in order, without copying or allocating.

    Each frame is written twice, half the buffer apart, so that the newest ``frames`` always lie side by side.
    """

    def __init__(self, frames: int, shape: tuple[int, ...], fill: float = np.nan) -> None:
        self._data = np.full((2 * frames, *shape), fill)
        self._frames, self._fill = frames, fill
        self._next = 0

    def push(self, frame: NDArray[np.floating] | float) -> None:
        """Append the newest frame, forgetting the oldest."""
        self._data[self._next] = self._data[self._next + self._frames] = frame
        self._next = (self._next + 1) % self._frames

    @property
    def all(self) -> NDArray[np.float64]:
        """(frames, ...) oldest first; a view, to be read."""
        return self._data[self._next : self._next + self._frames]

    @property
    def newest(self) -> NDArray[np.float64]:
        """The frame pushed last."""
        return self._data[(self._next - 1) % self._frames]

    def replace(self, frame: NDArray[np.floating]) -> None:
        """Write over the newest frame."""
        last = (self._next - 1) % self._frames
        self._data[last] = self._data[last + self._frames] = frame

    def amend(self, back: int, slot: int, values: NDArray[np.floating]) -> None:
        """Write over what the frame ``back`` before the newest holds in a slot, the first axis of a frame."""
        at = (self._next - 1 - back) % self._frames
        self._data[at, slot] = self._data[at + self._frames, slot] = values

    def clear(self, slot: NDArray[np.bool_]) -> None:
        """Refill these slots, the first axis of a frame, with the initial value in all frames."""
        self._data[:, slot] = self._fill


class History:
    """The last frames of S bodies, the newest last. The pipeline appends; all stages read.

    When a body reappears after up to `BRIDGED` frames without any joint, its `positions` in those frames are filled in
    by linear interpolation; `unseen_s` still counts them as unseen.
    """

    def __init__(self, frames: int, slots: int) -> None:
        """Holds the last ``frames``, and at least the longest gap that is bridged with its two ends."""
        frames = max(frames, BRIDGED + 2)
        self._observed = Ring(frames, (slots, 22, 3))
        self._confidence = Ring(frames, (slots, 22), fill=0.0)
        self._positions = Ring(frames, (slots, 22, 3))
        self._unseen_s = Ring(frames, (slots, 22), fill=np.inf)
        self._lost = np.zeros(slots, dtype=np.int64)

    @property
    def observed(self) -> Floats:
        """(T, S, 22, 3) metres, the input; NaN where unobserved."""
        return self._observed.all

    @property
    def confidence(self) -> Floats:
        """(T, S, 22) in 0..1."""
        return self._confidence.all

    @property
    def positions(self) -> Floats:
        """(T, S, 22, 3) metres after gate and correction; NaN where unobserved or refused."""
        return self._positions.all

    @property
    def unseen_s(self) -> Floats:
        """(T, S, 22) seconds since each joint was last seen, at each frame; 0 if then, inf if never."""
        return self._unseen_s.all

    def seen_since(self, back: int) -> Bools:
        """(S, 22) whether a joint was seen in one of the ``back`` newest frames."""
        return np.asarray((self.unseen_s[len(self.unseen_s) - back :] == 0.0).any(axis=0))

    def append(self, gated: Gated) -> None:
        """Take in the newest frame."""
        self._observed.push(gated.observation.positions)
        self._confidence.push(gated.observation.confidence)
        self._positions.push(gated.positions)
        seen = np.isfinite(gated.positions[..., 0])
        self._unseen_s.push(np.where(seen, 0.0, self._unseen_s.newest + 1 / FPS))
        self._bridge(np.asarray(seen.any(axis=1)))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for ring in (self._observed, self._confidence, self._positions, self._unseen_s):
            ring.clear(slot)
        self._lost[slot] = 0

    def _bridge(self, seen: Bools) -> None:
        """Interpolate the gap of bodies that are ``seen`` (S,) again."""
        for slot in np.flatnonzero(seen & (self._lost > 0) & (self._lost <= BRIDGED)).tolist():
            lost = int(self._lost[slot])
            before, now = self.positions[-2 - lost][slot], self._positions.newest[slot]
            for back in range(1, lost + 1):
                self._positions.amend(back, slot, now + back / (lost + 1) * (before - now))
        self._lost = np.where(seen, 0, self._lost + 1)
