"""Standard deviations of completed joints, and of those that were given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import finite_joints

MIN_SIGMA = 0.002
"""Metres along an axis: the least of a joint that was given."""

MIN_NEVER = 0.015
"""The same of a joint that was never given."""

DRIFT, MAX_DRIFT, LONG = 0.0045, 0.14, 60.0
"""Drift of a body in a gap without the pelvis: metres along an axis a frame from the gap's nearer end, its maximum, and
the frames of a gap from which on it is in full; in shorter ones it is in proportion. By validation people, where root
mean squares reach 135 mm."""


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of the completer's answers, as found on validation people.

    Attributes:
        never: (22,) metres along an axis, standard deviation of each joint that is known in no frame.
        half: frames from the nearest in which a joint is known at which it is half of that.
    """

    never: Sequence[float]
    half: float

    def of(self, given: Floats) -> Floats:
        """(T, 22) metres along an axis, of joints (T, 22, 3) metres, NaN where not given.

        The noise of joints that were given is estimated from their second differences.
        """
        known = finite_joints(given)
        apart = frames_apart(known)
        bends = np.linalg.norm(np.diff(given, n=2, axis=0), axis=-1)
        noise = np.full(22, MIN_SIGMA)
        for joint in np.flatnonzero(np.isfinite(bends).any(axis=0)):
            # the median of a normal vector's length, of which a second difference has six times the variance
            noise[joint] = max(np.nanmedian(bends[:, joint]) / (1.538 * np.sqrt(6.0)), MIN_SIGMA)
        grown = 1.0 - self.half / (apart + self.half)
        guessed = np.hypot(np.maximum(self.never, MIN_NEVER) * grown, noise)
        since, until = frames_since_and_until(known[:, :1])
        rootless = np.minimum(since, until) * np.minimum((since + until) / LONG, 1.0)
        drift = np.minimum(DRIFT * np.where(np.isfinite(rootless), rootless, 0.0), MAX_DRIFT)
        guessed = np.hypot(guessed, drift)
        return np.where(known, noise, guessed)


def frames_apart(known: NDArray[np.bool_]) -> Floats:
    """(T, K) frames to the nearest one in which each is ``known`` (T, K); infinite where there is none."""
    return np.minimum(*frames_since_and_until(known))


def frames_since_and_until(known: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """(T, K) frames since the last and until the next one in which each is ``known`` (T, K); infinite where none."""
    at = np.arange(len(known), dtype=np.float64)[:, None]
    before = np.maximum.accumulate(np.where(known, at, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(known, at, np.inf)[::-1], axis=0)[::-1]
    return at - before, after - at
