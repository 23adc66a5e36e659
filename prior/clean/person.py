"""This person's bones: what was measured, weighed against human proportions, frozen once sure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.bone_lengths import estimate_bones
from steadypose.prior.clean.frame import Window

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BonesSettings:
    """How long to measure.

    Attributes:
        enabled: whether to measure at all; off, everybody has a generic adult's bones.
        samples: frames to measure before the estimate is frozen.
        every: frames between two of them, so that their errors are not the same one.
    """

    enabled: bool = True
    samples: int = 64
    every: int = 5


_ENOUGH_JOINTS = 8
_RENEWAL = 1.5
_RENEWED = 8  # one in so many slots, at most, in one frame
_SURE = 0.05  # metres: a joint whose place is known less well, hidden for a while, measures no bone
_APPROACH = 0.1  # of the way to a renewed estimate, a frame: bones that jump would shake the whole limb
_ENOUGH_SAMPLES = 4


class Bones:
    """Keeps each slot's ``window.offsets``: `estimate_bones` over frames sampled from the person's first ten seconds.

    The estimate is renewed each time there are half as many samples more, so that it costs little and soon stands
    still, and is approached smoothly. ``window.length_variance`` says how far lengths are still to be learned.
    """

    delay_frames = 0

    def __init__(self, settings: BonesSettings, bias_sigma: float, slots: int) -> None:
        self._settings, self._bias_sigma = settings, bias_sigma
        self._samples = np.full((slots, settings.samples, 22, 3), np.nan)
        self._target = np.zeros((slots, 22, 3))
        self._length_variance = np.zeros((slots, 22))
        self._count = np.zeros(slots, dtype=np.int64)
        self._used = np.zeros(slots, dtype=np.int64)
        self._wait = np.zeros(slots, dtype=np.int64)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the people in these slots."""
        self._samples[slot] = np.nan
        self._count[slot] = self._used[slot] = 0
        self._wait[slot] = 0

    def update(self, window: Window) -> Window:
        """Sample the smoother's newest frame, where it is due, and renew the estimate."""
        if not self._settings.enabled or window.smoothed is None:
            return window
        # Smoothed, for noise makes bones longer.
        sure = window.smoothed.sigma < _SURE
        positions = np.where(sure[..., None], window.smoothed.positions, np.nan)
        enough = sure.sum(axis=1) >= _ENOUGH_JOINTS
        self._wait -= 1
        due = window.present & enough & (self._wait < 0) & (self._count < self._settings.samples)
        for slot in np.flatnonzero(due):
            self._samples[slot, self._count[slot]] = positions[slot]
            self._count[slot] += 1
            self._wait[slot] = self._settings.every - 1
        full = self._count == self._settings.samples
        renew = (self._count >= _RENEWAL * self._used) | (full & (self._count > self._used))
        # People who came together would all be due in the same frame: after the first estimate, a few at a time.
        stale = np.flatnonzero(renew & (self._count > 0) & window.present & enough)
        for slot in [
            *stale[self._used[stale] == 0],
            *stale[self._used[stale] > 0][: max(1, len(self._count) // _RENEWED)],
        ]:
            count = self._used[slot] = self._count[slot]
            noise = float(np.median(window.smoothed.sigma[slot, sure[slot]]))
            samples = self._samples[slot, :count]
            self._target[slot], self._length_variance[slot] = estimate_bones(
                samples, self._bias_sigma, noise, self._settings.samples
            )
            window.measured[slot] = count >= _ENOUGH_SAMPLES
            if count == 1:
                window.offsets[slot], window.length_variance[slot] = self._target[slot], self._length_variance[slot]
        known = self._used > 0
        window.offsets[known] += _APPROACH * (self._target[known] - window.offsets[known])
        window.length_variance[known] += _APPROACH * (self._length_variance[known] - window.length_variance[known])
        return window
