"""How white a sensor's noise is, measured on bones, whose lengths no motion changes; and what follows for the mixture.

The network's weights were learned on the motion of a few people. In white noise nothing is known better than what the
likelihood of innovations says, whoever moves, so there the multiple-model estimate takes over; noise that lasts, as
real sensors have it, that estimate follows, and there the learned weights stay.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.compiled import median, njit

MEMORY, LEAST = 45, 5
"""Frames over which a bone's length is observed, and after which it counts."""

START, START_NEWEST = 5, 15
"""Frames of observation that count as much as having none; the second without delay, where the network gains more on
the multiple-model estimate."""

SHARE = 1.5
"""White share of the noise, times the square of the whiteness, and at most all. On validation people the whiteness is
0.95 in independent noise, 0.5 in errors in depth that last for 0.05 s, and 0 to 0.1 on a Kinect, on MediaPipe and in
noise of half a second."""

OWN = 3e-3
"""Metres, standard deviation of the slow variation of a bone's length that is not taken for the sensor's: joints that
stem from markers on skin are no rigid bones' ends (UI-PRMD's vary by 2.5 mm in the median)."""

LARGE, LARGE_NEWEST = 0.014, 0.01
"""Metres along an axis, white noise in which the multiple-model estimate has at most three quarters of the weight: all
in much less, half in much more, where what is known of people helps; the second without delay."""

STILL = 1e-3
"""Metres: a bone that varies by less has no noise to speak of."""

_PARENTS = np.array(PARENTS[1:])


class Whiteness:
    """Keeps the moments of each bone's length: its variance, and those of its changes from frame to frame.

    In white noise half the mean square of the change is the variance (von Neumann's ratio, 1941), and each change is
    half undone by the next one. For noise with a correlation of r from frame to frame either ratio is 1 - r. A slow
    variation adds to the variance alone, so that it lowers the first ratio; motion of a sensor that smooths lowers the
    second one. The smaller of the two is the whiteness.

    Args:
        slots: bodies.
        delay: frames.
    """

    def __init__(self, slots: int, delay: int) -> None:
        self._start = START if delay else START_NEWEST
        self._last, self._step = np.full((2, slots, len(_PARENTS)), np.nan)
        self._frames, self._mean, self._variance, self._change = np.zeros((4, slots, len(_PARENTS)))
        self._pairs, self._undone = np.zeros((2, slots, len(_PARENTS)))

    def forget(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots (S,)."""
        self._last[slot] = self._step[slot] = np.nan
        for moment in (self._frames, self._mean, self._variance, self._change, self._pairs, self._undone):
            moment[slot] = 0.0

    def share(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take in joints (S, 22, 3) metres, NaN where unobserved; the share (S,) of the noise that is white."""
        return np.minimum(SHARE * self.update(positions) ** 2, 1.0)

    def update(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take in joints as `share`; whiteness (S,) from 0, lasting or not known, to 1."""
        white = np.zeros(len(positions))
        _update(
            positions, self._last, self._step, self._frames, self._mean, self._variance, self._change, self._pairs,
            self._undone, white,
        )  # fmt: skip
        frames = self._frames.max(axis=1)
        return white * frames / (frames + self._start)


@njit(cache=True)
def _update(positions, last, step, frames, mean, variance, change, pairs, undone, white):
    """Take joints (S, 22, 3) into the moments of `Whiteness`; writes the median ``white`` (S,) of bones' ratios."""
    ratios = np.empty(len(_PARENTS))
    for slot in range(len(positions)):
        count = 0
        for k in range(len(_PARENTS)):
            square = 0.0
            for axis in range(3):
                square += (positions[slot, k + 1, axis] - positions[slot, _PARENTS[k], axis]) ** 2
            length = math.sqrt(square)
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
                # white noise may lie on top of a bone that varies by itself
                own = min(max(variance[slot, k] - change[slot, k], 0.0), OWN**2)
                ratios[count] = min(change[slot, k] / max(variance[slot, k] - own, STILL**2), opposed)
                count += 1
        if count > 0:
            white[slot] = median(ratios[:count])


def fallback(white: NDArray[np.float64], scale: NDArray[np.float64], delay: int) -> NDArray[np.float64]:
    """The share (S,) of the multiple-model estimate.

    Args:
        white: (S,) share of the noise that is white.
        scale: (S,) metres along an axis, estimated noise.
        delay: frames.
    """
    return np.minimum(white, 0.5 + 0.5 / (1.0 + np.square(scale / (LARGE if delay else LARGE_NEWEST))))
