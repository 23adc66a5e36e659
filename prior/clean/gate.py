"""The gate stage: rejects jumps, impossible bone lengths and frozen joints; swaps and mirrors limbs back."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.exchanged import ExchangedLimbs, distances
from steadypose.prior.clean.frame import Gated, Observation
from steadypose.prior.clean.history import Ring
from steadypose.prior.clean.mirrored import MirroredLimbs
from steadypose.prior.clean.outliers import RECENT, BoneOutliers, frozen_joints
from steadypose.prior.clean.settings import GateSettings
from steadypose.prior.compiled import median, njit
from steadypose.prior.timing.kalman import ConstantVelocityFilter, Smoothed
from steadypose.prior.timing.rate import FPS

_JUMP_FACTOR = 7.0  # threshold in multiples of the jitter; one observation in a thousand exceeds it
_JITTER_FRAMES = 15  # length of the running mean of the jitter, frames
_UNIT_DISTANCE = 2.6  # median distance to the filter's prediction in white noise with sigma 1 along each axis
_MEAN_FRAMES, _MEAN_FACTOR = 9, 3.0  # length of a joint's running mean distance, frames; threshold as multiple of it
_HIDDEN_SPEED = 4.0  # speed that a joint at rest may reach while it is hidden, m/s
_BODY_JUMP = 0.5  # share of joints that jump at once above which the whole body jumped (a bad frame, a new track)
_BAD_FRAMES = 6  # largest number of frames in a row in which a body that jumped is rejected


class Gate:
    """Outlier rejection. A rejected joint becomes unobserved; the sides of exchanged limbs are swapped back, and limbs
    mirrored about the image plane are mirrored back.

    A constant-velocity Kalman filter, updated with the accepted joints, predicts each joint. A joint far from its
    prediction is still accepted if its bones kept their lengths and the sensor's bone lengths are constant enough
    (`BoneOutliers`). No jump is rejected for longer than ``patience``: by then the prediction is assumed to be wrong. A
    body that jumps as a whole is rejected for a few frames only, and not after a gap.
    """

    def __init__(self, settings: GateSettings, slots: int, counters: Counter[str]) -> None:
        self._settings = settings
        self._counters = counters
        self._filter = ConstantVelocityFilter(acceleration_density=8.0, measurement_sigma=0.015)
        self._bones = BoneOutliers(slots)
        self._exchanged = ExchangedLimbs(settings.patience, slots)
        self._mirrored = MirroredLimbs(slots)
        self._observed = Ring(RECENT + 1, (slots, 22, 3))
        self._jitter = np.zeros(slots)
        self._mean_distance = np.zeros((slots, 22))
        self._frames = np.zeros(slots, dtype=np.int64)
        self._lost = np.zeros((slots, 22))
        self._refused = np.zeros((slots, 22))
        self._bad_frames = np.zeros(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        if slot.all():
            self._filter.reset()  # a new stream: its stamps may be earlier
        self._filter.forget(np.repeat(slot[:, None], 22, axis=1))
        self._bones.forget(slot)
        self._exchanged.forget(slot)
        self._mirrored.forget(slot)
        self._observed.clear(slot)
        for values in (self._jitter, self._mean_distance, self._frames, self._lost, self._refused, self._bad_frames):
            values[slot] = 0

    def update(self, observation: Observation) -> Gated:
        """Return the newest frame without rejected joints."""
        s = self._settings
        self._observed.push(observation.positions)
        positions = observation.positions.copy()
        positions[observation.confidence < s.min_confidence] = np.nan
        slots = np.flatnonzero(observation.present)
        frozen, mirrored = np.zeros((2, *positions.shape[:2]), dtype=bool)
        frozen[slots] = frozen_joints(self._observed.all[:, slots].swapaxes(0, 1))
        if s.enabled and frozen.any():
            self._counters["joints_stuck"] += int(frozen.sum())
            positions[frozen] = np.nan
        if s.enabled:
            self._restart(self._exchanged.begin(positions))
        expected = self._filter.predict(observation.stamp_s)
        if expected is not None:
            distance = distances(positions, expected.positions)
            jitter = self._jitter.copy()
            self._measure_jitter(distance)
            if s.enabled and self._put_back(positions, expected, distance):
                distance = distances(positions, expected.positions)
            if s.enabled:
                mirrored = self._reject(positions, expected, distance, observation.sensor_position)
                self._jitter = np.where(self._bad_frames > 0, jitter, self._jitter)
        self._lost = np.where(np.isfinite(observation.positions[..., 0]), 0, self._lost + 1)
        self._filter.update(positions, observation.stamp_s)
        return Gated(observation, positions, self._jitter.copy(), frozen | mirrored)

    def _put_back(self, positions: Floats, expected: Smoothed, distance: Floats) -> bool:
        """Swap exchanged limbs back, in place; return whether a distance from a prediction has changed."""
        exchanged, given_up = self._exchanged.update(positions, expected.positions, distance)
        if not (exchanged or given_up.any()):
            return False
        self._counters["limbs_exchanged"] += exchanged
        self._restart(given_up)
        expected.positions[given_up] = np.nan
        return True

    def _reject(self, positions: Floats, expected: Smoothed, distance: Floats, camera: Floats) -> Bools:
        """Mirror limbs back and set rejected joints to NaN, in place; return the joints that were mirrored."""
        s = self._settings
        known = np.isfinite(expected.positions[..., 0])
        mirrored, given_up = self._mirrored.update(positions, expected.positions, camera)
        if mirrored.any() or given_up.any():
            self._counters["joints_mirrored"] += int(mirrored.sum())
            self._restart(given_up)
            expected.positions[given_up] = np.nan
            distance = distances(positions, expected.positions)
        seen = np.isfinite(positions[..., 0])
        # a fast limb is far from its prediction in every frame, a joint that jumps only once
        least = np.maximum(np.maximum(s.jump, _JUMP_FACTOR * self._jitter)[:, None], _MEAN_FACTOR * self._mean_distance)
        # a joint may have changed its velocity while it was hidden
        speed = np.maximum(2 * np.linalg.norm(self._filter.velocity, axis=-1), _HIDDEN_SPEED)
        away = self._lost / FPS * speed + 3 * expected.sigma
        away[self._bad_frames > 0] = 0.0  # frames interpolated from a bad one are bad too, but nearer
        jumped = seen & known & (distance > least + away)
        everywhere = jumped.sum(axis=1) > _BODY_JUMP * np.maximum((seen & known).sum(axis=1), 1)
        self._bad_frames = np.where(everywhere & ~self._lost.all(axis=1), self._bad_frames + 1, 0)
        self._bad_frames[self._bad_frames > _BAD_FRAMES] = 0
        bad = self._bad_frames > 0
        counts = seen & known & ~bad[:, None]
        self._mean_distance += np.where(counts, distance - self._mean_distance, 0.0) / _MEAN_FRAMES
        if bad.any():
            self._counters["joints_refused"] += int(seen[bad].sum())
            positions[bad] = np.nan
        self._restart((everywhere & ~bad)[:, None] & jumped)
        jumped &= ~everywhere[:, None] & ~self._bones.intact(positions, distance)
        self._refused = np.where(jumped, self._refused + 1, 0)
        overruled = self._refused > s.patience * FPS
        self._restart(overruled)
        self._refused[overruled] = 0
        refused = jumped & ~overruled
        # bones are tested without joints that jumped, so that their neighbours are not rejected too
        refused |= self._bones.update(np.where(refused[..., None], np.nan, positions))
        if refused.any():
            self._counters["joints_refused"] += int(refused.sum())
            positions[refused] = np.nan
        return mirrored

    def _measure_jitter(self, distance: Floats) -> None:
        """Update the jitter from the median of a body's distances (S, 22) between joints and predictions.

        The median ignores fast limbs and joints that jump. Time-correlated noise does not show here; it counts as bias.
        """
        jitter = _median_by_row(distance) / _UNIT_DISTANCE
        for slot in np.flatnonzero(np.isfinite(jitter)):
            self._frames[slot] += 1
            self._jitter[slot] += (jitter[slot] - self._jitter[slot]) / min(self._frames[slot], _JITTER_FRAMES)

    def _restart(self, joints: Bools) -> None:
        if joints.any():
            self._filter.forget(joints)


@njit(cache=True)
def _median_by_row(distance):
    """(S,) median of each row's finite values; NaN if it has none."""
    middle, known = np.full(len(distance), np.nan), np.empty(distance.shape[1])
    for row in range(len(distance)):
        count = 0
        for value in distance[row]:
            if math.isfinite(value):
                known[count] = value
                count += 1
        if count:
            middle[row] = median(known[:count])
    return middle
