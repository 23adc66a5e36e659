"""The last frames of a stream, preallocated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
