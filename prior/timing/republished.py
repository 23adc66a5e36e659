"""Republished frames: those that a tracker at 15 Hz gives twice, because its camera has 30."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

RUNS = 9
"""New frames over which repetitions are counted."""
RARE = 2
"""So many of the longest counts are left out: somebody simulated, who moves without noise, may stand still."""


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
