"""The steady stage: revisions of the estimate are published over a few frames instead of at once.

With a delay, a frame's estimate uses the observations up to the delay after it. Each new observation revises the
estimates of all these frames, but the earlier ones are published already, so the revision would be a step in the
published motion. Each estimate is therefore blended with its expectation: the previous output, moved by the joint's
motion as estimated with that output. Without a revision, as for a noise-free input, nothing changes.

In time-correlated noise, a joint is then moved towards the middle between the previous output and the next frame's
estimate, because motion seldom bends a slow joint's trajectory within three frames. The move is limited by the distance
of the joint's estimates from its observations, which is zero for a noise-free input.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.timing.rate import FPS

SHARE = 0.2
"""Share of the expectation in the output. With 0.3 and 0.5, the jitter decreases further, but in white noise the
position error increases by 0.7 and 1.8 instead of 0.3 % (validation, benchmarks/NOTEBOOK.md)."""

STRAIGHTEN = 0.4
"""Largest move to the middle of a joint at rest, relative to the mean distance of estimates from observations."""

FAST = 0.5
"""Speed at which the largest move is halved, m/s, because motion bends the trajectory of fast joints. With 1, a
Kinect's acceleration error is 1 % less, and the position error of runners 0.6 % more (validation)."""

LOOK_AHEAD = 3
"""Least delay at which joints are moved to the middle, frames. With less, the next frame's estimate is too uncertain:
at 2, the varying part of a Kinect's error is 0.8 % larger (validation)."""

MEMORY_S = 0.5  # time constant of the mean distance of estimates from observations, seconds
TINY = 1e-12  # least divisor of a move, metres


class Steady:
    """Blends observed joints with their expectations. ``delay`` is in frames."""

    def __init__(self, slots: int, delay: int) -> None:
        self._straightens = delay >= LOOK_AHEAD
        self._expected = np.full((slots, 22, 3), np.nan)
        self._last = np.full((slots, 22, 3), np.nan)  # the previous output
        self._distance = np.zeros((slots, 22))  # metres, mean of estimates from observations

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._expected[slot] = self._last[slot] = np.nan
        self._distance[slot] = 0.0

    def update(self, estimate: Estimate, step: Floats | None, observed: Floats, correlated: Floats) -> Estimate:
        """Return the estimate with the joints blended that are observed in its frame and in the frame before. Call it
        with frames in order.

        Args:
            estimate: of one frame.
            step: (S, 22, 3) metres, the joints' motion to the next frame as estimated now; None without a later frame.
            observed: (S, 22, 3) metres, the joints as observed in this frame; NaN where unobserved or rejected.
            correlated: (S,) certainty that the sensor's noise is time-correlated, 0 to 1.
        """
        refined = (estimate.state == JointState.REFINED)[..., None]
        off = np.where(refined, self._expected - estimate.positions, np.nan)
        positions = estimate.positions + SHARE * np.where(np.isfinite(off), off, 0.0)
        following = positions + (np.nan if step is None else step)
        self._expected = np.where(refined, following, np.nan)
        if self._straightens:
            positions = positions + self._to_middle(positions, following, observed, correlated)
        self._last = np.where(refined, positions, np.nan)
        return replace(estimate, positions=positions)

    def _to_middle(self, positions: Floats, following: Floats, observed: Floats, correlated: Floats) -> Floats:
        """Return the move (S, 22, 3) metres of each joint towards the mean of its positions before and after."""
        change = (np.linalg.norm(positions - observed, axis=-1) - self._distance) / (MEMORY_S * FPS)
        self._distance += np.where(np.isfinite(change), change, 0.0)
        move = 0.5 * (self._last + following) - positions
        speed = 0.5 * FPS * np.linalg.norm(following - self._last, axis=-1)
        most = STRAIGHTEN * correlated[:, None] * self._distance / (1.0 + np.square(speed / FAST))
        share = most / np.maximum(np.hypot(np.linalg.norm(move, axis=-1), most), TINY)
        return np.where(np.isfinite(move), move * share[..., None], 0.0)
