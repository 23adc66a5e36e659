"""Estimates the whiteness of a sensor's noise from bone lengths, which no motion changes. It determines the weight of
the multiple-model estimate.

In white noise, no weights are better than the likelihoods of the innovations, so the multiple-model estimate replaces
the network's, whose weights were learned from the motion of a few people. Time-correlated noise, which real sensors
have, misleads the multiple-model estimate, so the learned weights stay.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.body.vectors import apart
from steadypose.prior.compiled import median, njit

MEMORY, LEAST = 45, 5  # length of the running moments of a bone's length, and least number of observations, frames

START, START_NEWEST = 5, 15
"""Weight of the initial whiteness of 0, frames; the second without delay, where the network gains more over the
multiple-model estimate."""

SHARE = 1.5
"""Factor from the squared whiteness to the white share of the noise, which is at most 1. On validation people, the
whiteness is 0.95 in independent noise, 0.5 in depth errors with a correlation time of 0.05 s, and 0 to 0.1 for a
Kinect, for MediaPipe and in noise with a correlation time of half a second."""

OWN = 3e-3
"""Standard deviation of slow variations of a bone's length that are not attributed to the sensor, metres. Joints
computed from skin markers are not ends of rigid bones: in UI-PRMD, lengths vary by 2.5 mm (median)."""

CERTAIN = 1.25
"""Factor from the share of the noise that is not white to the certainty that the noise is time-correlated, which is
thus 1 for a white share of a fifth or less."""

LARGE, LARGE_NEWEST = 0.014, 0.01
"""White noise along an axis in which the weight of the multiple-model estimate is at most three quarters, metres; the
second without delay. The limit is 1 in much smaller noise and 0.5 in much larger noise, where the network helps."""

STILL = 1e-3  # least standard deviation of a bone's length for its whiteness to count, metres

_BONES = len(PARENT) - 1


class Whiteness:
    """Estimates whiteness from the variance of each bone's length and of its changes from frame to frame.

    In white noise, half the mean squared change equals the variance (von Neumann's ratio, 1941), and the next change
    undoes half of each change. In noise with a correlation of r from frame to frame, both ratios are 1 - r. Slow
    variations increase only the variance, and so lower the first ratio. If the sensor smooths, motion lowers the second
    ratio. The whiteness is the smaller of the two.

    Args:
        slots: number of bodies.
        delay: look-ahead of the smoother, frames.

    Attributes:
        correlated: (S,) certainty that the noise is time-correlated, 0 (at the start) to 1.
    """

    def __init__(self, slots: int, delay: int) -> None:
        self.correlated = np.zeros(slots)
        self._start = START if delay else START_NEWEST
        self._last, self._step = np.full((2, slots, _BONES), np.nan)
        self._frames, self._mean, self._variance, self._change = np.zeros((4, slots, _BONES))
        self._pairs, self._undone = np.zeros((2, slots, _BONES))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._last[slot] = self._step[slot] = np.nan
        for moment in (self._frames, self._mean, self._variance, self._change, self._pairs, self._undone):
            moment[slot] = 0.0

    def share(self, positions: Floats) -> Floats:
        """Process joints (S, 22, 3) metres, NaN where unobserved; returns the white share (S,) of the noise, 0 while it
        is unknown."""
        white = np.zeros(len(positions))
        _update(
            positions, self._last, self._step, self._frames, self._mean, self._variance, self._change, self._pairs,
            self._undone, white,
        )  # fmt: skip
        frames = self._frames.max(axis=1)
        correlated = np.minimum(CERTAIN * (1.0 - np.minimum(SHARE * white**2, 1.0)), 1.0)
        self.correlated = correlated * frames / (frames + START_NEWEST)
        return np.minimum(SHARE * (white * frames / (frames + self._start)) ** 2, 1.0)


@njit(cache=True)
def _update(positions, last, step, frames, mean, variance, change, pairs, undone, white):
    """Add joints (S, 22, 3) to the moments of `Whiteness`, and write the median ``white`` (S,) of the bones' ratios."""
    ratios = np.empty(_BONES)
    for slot in range(len(positions)):
        count = 0
        for k in range(_BONES):
            length = apart(positions[slot], k + 1, PARENT[k + 1])
            moved = length - last[slot, k]
            changed, back = 0.5 * moved * moved, -moved * step[slot, k]
            last[slot, k], step[slot, k] = length, moved
            if math.isfinite(changed):
                frames[slot, k] += 1.0
                share = 1.0 / min(frames[slot, k], MEMORY)
                off = length - mean[slot, k] if frames[slot, k] > 1.0 else 0.0
                mean[slot, k] = mean[slot, k] + share * off if frames[slot, k] > 1.0 else length
                variance[slot, k] = (1.0 - share) * (variance[slot, k] + share * off * off)
                change[slot, k] += share * (changed - change[slot, k])
            if math.isfinite(back):
                pairs[slot, k] += 1.0
                undone[slot, k] += (back - undone[slot, k]) / min(pairs[slot, k], MEMORY)
            if frames[slot, k] >= LEAST and variance[slot, k] > STILL**2:
                opposed = min(max(undone[slot, k] / change[slot, k], 0.0), 1.0) if change[slot, k] > 0.0 else 0.0
                # white noise may be added to a bone whose length varies itself
                own = min(max(variance[slot, k] - change[slot, k], 0.0), OWN**2)
                ratios[count] = min(change[slot, k] / max(variance[slot, k] - own, STILL**2), opposed)
                count += 1
        if count > 0:
            white[slot] = median(ratios[:count])


def fallback(white: Floats, scale: Floats, delay: int) -> Floats:
    """Return the weight (S,) of the multiple-model estimate, by the share of the noise that is white (S,), the
    estimated noise (S,) metres along an axis, and the smoother's look-ahead in frames."""
    return np.minimum(white, 0.5 + 0.5 / (1.0 + np.square(scale / (LARGE if delay else LARGE_NEWEST))))
