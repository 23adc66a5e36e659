"""The bones stage: this person's bone lengths, measured for the first ten seconds, with human proportions as a
prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.bone_lengths import estimate_bones
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.clean.frame import Person
from steadypose.prior.timing.fixed_lag import Smoothed


@dataclass(frozen=True)
class PersonSettings:
    """Settings of the bones stage.

    Attributes:
        enabled: whether to measure at all; off, every body has a generic adult's bones.
        samples: frames sampled before the estimate is frozen.
        every: frames between two samples, so that their errors are less correlated.
    """

    enabled: bool = True
    samples: int = 64
    every: int = 5


_MIN_JOINTS = 8  # with a standard deviation below _MAX_SIGMA, for a frame to be sampled
_MAX_SIGMA = 0.05  # metres along an axis, of a joint that counts for bone lengths
_GROWTH = 1.5  # the estimate is renewed when the number of samples has grown by this factor
_SLOTS_PER_RENEWAL = 8  # of so many slots, one is renewed in a frame
_APPROACH = 0.1  # share of the way to a renewed estimate, per frame: a jump of the bones would shake the whole limb
_MIN_SAMPLES = 4  # for the bones to count as measured


class PersonEstimator:
    """The bones of every body: `estimate_bones` over frames sampled from its first ten seconds.

    The estimate is renewed whenever the number of samples has grown by half, so that it costs little and settles, and
    is approached smoothly.

    Attributes:
        current: the bones as of the last frame.
    """

    def __init__(self, settings: PersonSettings, slots: int) -> None:
        self._settings = settings
        self._samples = np.full((slots, settings.samples, 22, 3), np.nan)
        self._target = np.zeros((slots, 22, 3))
        self._target_variance = np.zeros((slots, 22))
        self._count = np.zeros(slots, dtype=np.int64)
        self._used = np.zeros(slots, dtype=np.int64)
        self._wait = np.zeros(slots, dtype=np.int64)
        self.current = Person.generic(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the people in these slots (S,)."""
        self._samples[slot] = np.nan
        self._count[slot] = self._used[slot] = 0
        self._wait[slot] = 0
        before = self.current
        self.current = Person(
            np.where(slot[:, None, None], REST_OFFSETS, before.offsets),
            np.where(slot[:, None], 0.0, before.length_variance),
            before.measured & ~slot,
        )

    def update(self, smoothed: Smoothed | None, bias_sigma: Floats, present: Bools) -> Person:
        """Sample the newest estimate of the bodies ``present`` (S,), where it is due, and renew the bones.

        Args:
            smoothed: joints and their standard deviations; None while there is none.
            bias_sigma: (S,) metres along an axis, the sensor's slow error as found so far.
            present: (S,) who is there.
        """
        if not self._settings.enabled or smoothed is None:
            return self.current
        # smoothed positions: noise lengthens bones
        known = smoothed.sigma < _MAX_SIGMA
        positions = np.where(known[..., None], smoothed.positions, np.nan)
        enough = known.sum(axis=1) >= _MIN_JOINTS
        self._wait -= 1
        due = present & enough & (self._wait < 0) & (self._count < self._settings.samples)
        for slot in np.flatnonzero(due):
            self._samples[slot, self._count[slot]] = positions[slot]
            self._count[slot] += 1
            self._wait[slot] = self._settings.every - 1
        full = self._count == self._settings.samples
        renew = (self._count >= _GROWTH * self._used) | (full & (self._count > self._used))
        # people who came together are due in the same frame: after the first estimate, only a few at a time
        stale = np.flatnonzero(renew & (self._count > 0) & present & enough)
        first, later = stale[self._used[stale] == 0], stale[self._used[stale] > 0]
        offsets, variance = self.current.offsets.copy(), self.current.length_variance.copy()
        measured = self.current.measured.copy()
        for slot in [*first, *later[: max(1, len(self._count) // _SLOTS_PER_RENEWAL)]]:
            count = self._used[slot] = self._count[slot]
            noise = float(np.median(smoothed.sigma[slot, known[slot]]))
            self._target[slot], self._target_variance[slot] = estimate_bones(
                self._samples[slot, :count], float(bias_sigma[slot]), noise, self._settings.samples
            )
            measured[slot] = count >= _MIN_SAMPLES
            if count == 1:
                offsets[slot], variance[slot] = self._target[slot], self._target_variance[slot]
        begun = self._used > 0
        offsets[begun] += _APPROACH * (self._target[begun] - offsets[begun])
        variance[begun] += _APPROACH * (self._target_variance[begun] - variance[begun])
        self.current = Person(offsets, variance, measured)
        return self.current
