"""The last frames of every body, for the models' windows and for the frames that are still to be published."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import Gated
from steadypose.prior.timing.rate import FPS

BRIDGED = 3
"""Longest gap of the whole body that is interpolated linearly, frames. The models are trained on hidden limbs, not on
flickering bodies, and would pass the flicker on."""

BRIEF_S = 2.5 / FPS
"""Longest time for which a joint that is observed again within the delay is treated as observed throughout, seconds.
With 30 % of the joints dropped, the acceleration error is 2.5 instead of 2.8 mm/frame² (validation)."""


class Ring:
    """A ring buffer of the last ``frames`` arrays of one shape, read in order without copying or allocating.

    Each frame is written twice, half the buffer apart, so that the newest ``frames`` are always contiguous.
    """

    def __init__(self, frames: int, shape: tuple[int, ...], fill: float = np.nan) -> None:
        self._data = np.full((2 * frames, *shape), fill)
        self._frames, self._fill = frames, fill
        self._next = 0

    def push(self, frame: NDArray[np.floating] | float) -> None:
        """Append the newest frame and drop the oldest."""
        self._data[self._next] = self._data[self._next + self._frames] = frame
        self._next = (self._next + 1) % self._frames

    @property
    def all(self) -> Floats:
        """(frames, ...) oldest first; a view, for reading only."""
        return self._data[self._next : self._next + self._frames]

    @property
    def newest(self) -> Floats:
        """The newest frame."""
        return self._data[(self._next - 1) % self._frames]

    def amend(self, back: int, slot: int, values: NDArray[np.floating]) -> None:
        """Overwrite one slot (the first axis of a frame) in the frame ``back`` frames before the newest."""
        at = (self._next - 1 - back) % self._frames
        self._data[at, slot] = self._data[at + self._frames, slot] = values

    def clear(self, slot: Bools) -> None:
        """Reset these slots (the first axis of a frame) to the initial value, in all frames."""
        self._data[:, slot] = self._fill


class History:
    """The last frames of S bodies, oldest first. The pipeline appends; all stages read.

    When a body reappears after at most `BRIDGED` frames without any joint, linear interpolation fills in its
    `positions` in those frames. `unobserved_s` still counts them as unobserved.
    """

    def __init__(self, frames: int, slots: int) -> None:
        """Keep the last ``frames``, and at least the longest gap that is interpolated with its two ends."""
        frames = max(frames, BRIDGED + 2)
        self._observed = Ring(frames, (slots, 22, 3))
        self._confidence = Ring(frames, (slots, 22), fill=0.0)
        self._positions = Ring(frames, (slots, 22, 3))
        self._unobserved_s = Ring(frames, (slots, 22), fill=np.inf)
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
        """(T, S, 22, 3) metres after gate and correction; NaN where unobserved or rejected."""
        return self._positions.all

    @property
    def unobserved_s(self) -> Floats:
        """(T, S, 22) seconds since each joint was last observed, at each frame; 0 if in that frame, inf if never."""
        return self._unobserved_s.all

    def observed_since(self, back: int) -> Bools:
        """(S, 22) whether each joint was observed in one of the ``back`` newest frames."""
        return np.asarray((self.unobserved_s[len(self.unobserved_s) - back :] == 0.0).any(axis=0))

    def append(self, gated: Gated) -> None:
        """Append the newest frame."""
        self._observed.push(gated.observation.positions)
        self._confidence.push(gated.observation.confidence)
        self._positions.push(gated.positions)
        seen = np.isfinite(gated.positions[..., 0])
        self._unobserved_s.push(np.where(seen, 0.0, self._unobserved_s.newest + 1 / FPS))
        self._bridge(np.asarray(seen.any(axis=1)))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for ring in (self._observed, self._confidence, self._positions, self._unobserved_s):
            ring.clear(slot)
        self._lost[slot] = 0

    def _bridge(self, seen: Bools) -> None:
        """Interpolate the gap of bodies that are observed again, given the bodies ``seen`` (S,) in this frame."""
        for slot in np.flatnonzero(seen & (self._lost > 0) & (self._lost <= BRIDGED)).tolist():
            lost = int(self._lost[slot])
            before, now = self.positions[-2 - lost][slot], self._positions.newest[slot]
            for back in range(1, lost + 1):
                self._positions.amend(back, slot, now + back / (lost + 1) * (before - now))
        self._lost = np.where(seen, 0, self._lost + 1)
