"""The solve stage: local rotations of the newest frame, for the refinement model to read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.clean.frame import Window


class Solve:
    """Turns positions into rotations; what is not seen keeps the rotation it had a frame ago."""

    delay_frames = 0

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Nothing is kept here: the rotations of a slot go with its window."""

    def update(self, window: Window) -> Window:
        """Push the newest frame's rotations."""
        slots = np.flatnonzero(window.present)
        last = window.rotations.newest[slots]
        fallback = np.where(np.isnan(last), np.eye(3), last)
        rotations = np.full_like(window.rotations.newest, np.nan)
        rotations[slots] = solve_rotations(window.positions.newest[slots], window.offsets[slots], fallback)
        window.rotations.push(rotations)
        return window
