"""The steady stage: what a new frame changes about earlier ones is published step by step.

With a delay, a frame's estimate uses the frames up to the delay after it, and the next frame's estimate one frame more.
Each new frame revises both, but the earlier one is published already, so every revision is a step in the published
motion. Here, a revision takes a few frames: each estimate is blended with what the previous answer, moved along as the
joint then seemed to move, expected of it. Where nothing is revised, as in a perfect input, nothing changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import Estimate

SHARE = 0.2
"""Share of the expectation in the answer. With 0.3 and 0.5, a joint's jitter falls further, but in white noise its
position error grows by 0.7 and 1.8 instead of 0.3 % (validation, benchmarks/NOTEBOOK.md)."""


class Steady:
    """Blends observed joints with what was expected of them. Without a delay there is nothing to expect."""

    def __init__(self, slots: int) -> None:
        self._expected = np.full((slots, 22, 3), np.nan)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._expected[slot] = np.nan

    def update(self, estimate: Estimate, step: Floats | None) -> Estimate:
        """Return the estimate of one frame with the joints blended that are observed in it and in the frame before.

        Call it with frames in order. ``step`` (S, 22, 3) metres is the joints' motion to the next frame as estimated
        now; None if there is no later frame.
        """
        observed = (estimate.state == JointState.REFINED)[..., None]
        off = np.where(observed, self._expected - estimate.positions, np.nan)
        positions = estimate.positions + SHARE * np.where(np.isfinite(off), off, 0.0)
        self._expected = np.where(observed, positions + (np.nan if step is None else step), np.nan)
        return replace(estimate, positions=positions)
