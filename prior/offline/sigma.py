"""How sure to be of joints that were completed, and of those that were given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import finite_joints

Floats = NDArray[np.float64]

LEAST_SIGMA = 0.002
"""Metres along an axis: no joint that was given is taken to be known better."""


@dataclass(frozen=True)
class Doubt:
    """Standard deviations along an axis of what the completer gives, as validation found them.

    Attributes:
        never: (22,) metres, of each joint that is known in no frame.
        half: frames from something known at which it is half of that.
    """

    never: Sequence[float]
    half: float

    def of(self, given: Floats) -> Floats:
        """(T, 22) metres, of joints (T, 22, 3) that are NaN where they were not given.

        A joint that was given is as uncertain as it jumps from frame to frame.
        """
        known = finite_joints(given)
        apart = frames_apart(known)
        bends = np.linalg.norm(np.diff(given, n=2, axis=0), axis=-1)
        noise = np.full(22, LEAST_SIGMA)
        for joint in np.flatnonzero(np.isfinite(bends).any(axis=0)):
            # the median of a normal vector's length, of which a second difference has six times the variance
            noise[joint] = max(np.nanmedian(bends[:, joint]) / (1.538 * np.sqrt(6.0)), LEAST_SIGMA)
        grown = 1.0 - self.half / (apart + self.half)
        guessed = np.hypot(np.array(self.never) * grown, noise)
        return np.where(known, noise, guessed)


def frames_apart(known: NDArray[np.bool_]) -> Floats:
    """(T, K) frames from the nearest in which each of (T, K) is known; infinite where none is."""
    at = np.arange(len(known))[:, None]
    before = np.maximum.accumulate(np.where(known, at, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(known, at, np.inf)[::-1], axis=0)[::-1]
    return np.minimum(at - before, after - at)
