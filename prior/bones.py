"""This person's bones: a robust running estimate, frozen once sure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prior.kinematics import estimate_offsets
from prior.skeletons import finite_joints
from prior.window import Window


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
_APPROACH = 0.1  # of the way to a renewed estimate, a frame: bones that jump would shake the whole limb
_ENOUGH_SAMPLES = 4


class Bones:
    """Keeps each slot's ``window.offsets``: the median over frames sampled from the person's first ten seconds.

    The mean of a person's bone lengths would grow with the sensor's noise and follow its outliers. The estimate is
    renewed each time the number of samples has doubled, so that it costs little and soon stands still, and is
    approached smoothly.
    """

    delay_frames = 0

    def __init__(self, settings: BonesSettings, slots: int) -> None:
        self._settings = settings
        self._samples = np.full((slots, settings.samples, 22, 3), np.nan)
        self._target = np.zeros((slots, 22, 3))
        self._count = np.zeros(slots, dtype=np.int64)
        self._wait = np.zeros(slots, dtype=np.int64)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the people in these slots."""
        self._samples[slot] = np.nan
        self._count[slot] = 0
        self._wait[slot] = 0

    def update(self, window: Window) -> Window:
        """Sample the newest frame, where it is due, and renew the estimate."""
        if not self._settings.enabled:
            return window
        enough = finite_joints(window.positions.newest).sum(axis=1) >= _ENOUGH_JOINTS
        self._wait -= 1
        due = window.present & enough & (self._wait < 0) & (self._count < self._settings.samples)
        for slot in np.flatnonzero(due):
            self._samples[slot, self._count[slot]] = window.positions.newest[slot]
            self._count[slot] += 1
            self._wait[slot] = self._settings.every - 1
            count = self._count[slot]
            if count & (count - 1) == 0 or count == self._settings.samples:
                self._target[slot] = estimate_offsets(self._samples[slot, :count])
                window.measured[slot] = count >= _ENOUGH_SAMPLES
                if count == 1:
                    window.offsets[slot] = self._target[slot]
        known = self._count > 0
        window.offsets[known] += _APPROACH * (self._target[known] - window.offsets[known])
        return window
