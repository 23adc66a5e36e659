"""The steady stage: what a new frame changes about earlier ones is published step by step.

With a delay, a frame's estimate uses the frames up to the delay after it, and the next frame's estimate one frame more.
Each new frame revises both, but the earlier one is published already, so every revision is a step in the published
motion. Here, a revision takes a few frames: each estimate is blended with what the previous answer, moved along as the
joint then seemed to move, expected of it. Where nothing is revised, as in a perfect input, nothing changes.

Where the sensor's noise lasts, a joint is then moved to the middle between the previous answer and the next frame's
estimate, because what bends a slow joint's path within three frames is seldom motion. How far is limited by how far
this joint's estimates lie from its observations: in a perfect input, it stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.timing.rate import FPS

SHARE = 0.2
"""Share of the expectation in the answer. With 0.3 and 0.5, a joint's jitter falls further, but in white noise its
position error grows by 0.7 and 1.8 instead of 0.3 % (validation, benchmarks/NOTEBOOK.md)."""

STRAIGHTEN = 0.4
"""Largest move to the middle of a joint at rest, relative to the mean distance of estimates from observations."""

FAST = 0.5
"""Speed at which the largest move is halved, m/s: the faster a joint, the more of what bends its path is motion. With
1, a Kinect's acceleration error falls by 1 % more, and runners are 0.6 % farther off (validation)."""

LOOK_AHEAD = 3
"""Least delay at which joints are moved to the middle, frames. With less, the next frame's estimate is too uncertain:
at 2, what changes of a Kinect's error is 0.8 % larger (validation)."""

MEMORY_S = 0.5  # time constant of that mean distance, seconds
TINY = 1e-12  # least divisor of a move, metres


class Steady:
    """Blends observed joints with what was expected of them. Without a delay there is nothing to expect."""

    def __init__(self, slots: int, delay: int) -> None:
        """``delay`` is in frames."""
        self._straightens = delay >= LOOK_AHEAD
        self._expected = np.full((slots, 22, 3), np.nan)
        self._last = np.full((slots, 22, 3), np.nan)  # the previous answer
        self._distance = np.zeros((slots, 22))  # metres, mean of estimates from observations

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._expected[slot] = self._last[slot] = np.nan
        self._distance[slot] = 0.0

    def update(self, estimate: Estimate, step: Floats | None, observed: Floats, lasting: Floats) -> Estimate:
        """Return the estimate of one frame with the joints blended that are observed in it and in the frame before.

        Call it with frames in order.

        Args:
            estimate: of one frame.
            step: (S, 22, 3) metres, the joints' motion to the next frame as estimated now; None if there is no later
                frame.
            observed: (S, 22, 3) metres, the joints as observed in this frame; NaN where unobserved or rejected.
            lasting: (S,) certainty that the sensor's noise lasts, from 0 to 1.
        """
        refined = (estimate.state == JointState.REFINED)[..., None]
        off = np.where(refined, self._expected - estimate.positions, np.nan)
        positions = estimate.positions + SHARE * np.where(np.isfinite(off), off, 0.0)
        following = positions + (np.nan if step is None else step)
        self._expected = np.where(refined, following, np.nan)
        if self._straightens:
            positions = positions + self._to_middle(positions, following, observed, lasting)
        self._last = np.where(refined, positions, np.nan)
        return replace(estimate, positions=positions)

    def _to_middle(self, positions: Floats, following: Floats, observed: Floats, lasting: Floats) -> Floats:
        """Return the move (S, 22, 3) metres of each joint towards the middle of its neighbours in time."""
        change = (np.linalg.norm(positions - observed, axis=-1) - self._distance) / (MEMORY_S * FPS)
        self._distance += np.where(np.isfinite(change), change, 0.0)
        way = 0.5 * (self._last + following) - positions
        speed = 0.5 * FPS * np.linalg.norm(following - self._last, axis=-1)
        most = STRAIGHTEN * lasting[:, None] * self._distance / (1.0 + np.square(speed / FAST))
        share = most / np.maximum(np.hypot(np.linalg.norm(way, axis=-1), most), TINY)
        return np.where(np.isfinite(way), way * share[..., None], 0.0)
