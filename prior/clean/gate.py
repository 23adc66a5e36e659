"""The gate stage: rejects jumps, impossible bone lengths, exchanged limbs and frozen joints."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import MIRROR, limbs
from steadypose.prior.clean.frame import Gated, Observation
from steadypose.prior.clean.history import Ring
from steadypose.prior.clean.outliers import RECENT, BoneOutliers, frozen_joints
from steadypose.prior.compiled import median, njit
from steadypose.prior.timing.kalman import ConstantVelocityFilter, Smoothed
from steadypose.prior.timing.rate import FPS


@dataclass(frozen=True)
class GateSettings:
    """Thresholds of the gate.

    Attributes:
        enabled: off, all observed joints pass.
        jump: metres that a joint may be from its prediction, in addition to three standard deviations of it.
        patience: seconds after which a joint that is refused (or a limb that is exchanged) throughout is accepted.
        min_confidence: joints below it are unobserved.
    """

    enabled: bool = True
    jump: float = 0.18
    patience: float = 0.3
    min_confidence: float = 0.1


# limbs that detectors exchange: whole arms and whole legs, on both sides
_EXCHANGED = tuple(np.concatenate(limbs(chain)) for chain in (("elbow", "wrist"), ("knee", "ankle", "foot")))
# Shoulders or hips, which detectors exchange with them, or not.
_BASES = tuple(np.concatenate(limbs((joint,))) for joint in ("shoulder", "hip"))
_SWAP_APART = 0.15  # metres between prediction and observation, mean of a limb's joints, for an exchange to be tested
_SWAP_BETTER = 0.4  # an exchange must reduce that distance to this share
_JUMP_FACTOR = 7.0  # times the jitter: one observation in a thousand is further from its prediction
_JITTER_FRAMES = 15  # of the running mean of the jitter
_UNIT_DISTANCE = 2.6  # median distance to this filter's prediction, of white noise of 1 along each axis
_MEAN_FRAMES, _MEAN_FACTOR = 9, 3.0  # of a joint's running mean distance to its prediction; and multiple of it
_HIDDEN_SPEED = 4.0  # m/s that a joint at rest may reach while it is hidden
_BODY_JUMP = 0.5  # if a larger share of the joints jumps at once, the body did (a new track, a gap), not the joints


class Gate:
    """Outlier rejection: a refused joint becomes unobserved, exchanged limbs are put back.

    Predictions are those of a constant-velocity Kalman filter, updated with what passes. A joint far from its own that
    kept the lengths of its bones moved, where lengths show it. No jump is refused for longer than ``patience``: then
    the prediction is wrong, not the sensor. Bone lengths are tested by `BoneOutliers`.
    """

    def __init__(self, settings: GateSettings, slots: int, counters: Counter[str]) -> None:
        self._settings = settings
        self._counters = counters
        self._filter = ConstantVelocityFilter(acceleration_density=8.0, measurement_sigma=0.015)
        self._bones = BoneOutliers(slots)
        self._observed = Ring(RECENT + 1, (slots, 22, 3))
        self._jitter = np.zeros(slots)
        self._mean_distance = np.zeros((slots, 22))
        self._frames = np.zeros(slots, dtype=np.int64)
        self._lost = np.zeros((slots, 22))
        self._refused = np.zeros((slots, 22))
        self._swapped = np.zeros((slots, len(_EXCHANGED)))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        if slot.all():
            self._filter.reset()  # a new stream: its stamps may be earlier
        self._filter.forget(np.repeat(slot[:, None], 22, axis=1))
        self._bones.forget(slot)
        self._observed.clear(slot)
        self._jitter[slot] = 0.0
        self._mean_distance[slot] = 0.0
        self._frames[slot] = 0
        self._lost[slot] = 0
        self._refused[slot] = 0
        self._swapped[slot] = 0

    def update(self, observation: Observation) -> Gated:
        """The newest frame, without refused joints."""
        s = self._settings
        self._observed.push(observation.positions)
        positions = observation.positions.copy()
        positions[observation.confidence < s.min_confidence] = np.nan
        slots = np.flatnonzero(observation.present)
        frozen = np.zeros(positions.shape[:2], dtype=bool)
        frozen[slots] = frozen_joints(self._observed.all[:, slots].swapaxes(0, 1))
        if s.enabled and frozen.any():
            self._counters["joints_stuck"] += int(frozen.sum())
            positions[frozen] = np.nan
        expected = self._filter.predict(observation.stamp_s)
        if expected is not None:
            distance = _apart(positions, expected.positions)
            self._measure_jitter(distance)
            if s.enabled:
                self._reject(positions, expected, distance)
        self._lost = np.where(np.isfinite(observation.positions[..., 0]), 0, self._lost + 1)
        self._filter.update(positions, observation.stamp_s)
        return Gated(observation, positions, self._jitter.copy(), frozen)

    def _reject(self, positions: Floats, expected: Smoothed, distance: Floats) -> None:
        """Put exchanged limbs back, and set refused joints to NaN, in place."""
        s = self._settings
        known = np.isfinite(expected.positions[..., 0])
        if (distance > _SWAP_APART).any() or self._swapped.any():
            self._exchange(positions, expected.positions, known)
            distance = _apart(positions, expected.positions)
        seen = np.isfinite(positions[..., 0])
        # a limb in violent motion is far from its prediction all the time, a joint that jumps only once
        least = np.maximum(np.maximum(s.jump, _JUMP_FACTOR * self._jitter)[:, None], _MEAN_FACTOR * self._mean_distance)
        self._mean_distance += np.where(seen & known, distance - self._mean_distance, 0.0) / _MEAN_FRAMES
        # a joint may have changed its velocity while it was hidden
        speed = np.maximum(2 * np.linalg.norm(self._filter.velocity, axis=-1), _HIDDEN_SPEED)
        jumped = seen & known & (distance > least + speed * self._lost / FPS + 3 * expected.sigma)
        everywhere = jumped.sum(axis=1) > _BODY_JUMP * np.maximum((seen & known).sum(axis=1), 1)
        self._restart(everywhere[:, None] & jumped)
        jumped &= ~everywhere[:, None] & ~self._bones.intact(positions, distance)
        self._refused = np.where(jumped, self._refused + 1, 0)
        overruled = self._refused > s.patience * FPS
        self._restart(overruled)
        self._refused[overruled] = 0
        refused = jumped & ~overruled
        # of the bone between a joint that jumped and one that did not, the one that did not is right
        refused |= self._bones.update(np.where(refused[..., None], np.nan, positions))
        if refused.any():
            self._counters["joints_refused"] += int(refused.sum())
            positions[refused] = np.nan

    def _measure_jitter(self, distance: Floats) -> None:
        """Update the jitter from the median of a body's distances (S, 22) between joints and predictions.

        The median, so that a limb in violent motion, or a joint that jumps, does not count. Noise that is correlated
        over frames does not show here; it belongs to the bias.
        """
        jitter = _median_by_row(distance) / _UNIT_DISTANCE
        for slot in np.flatnonzero(np.isfinite(jitter)):
            self._frames[slot] += 1
            self._jitter[slot] += (jitter[slot] - self._jitter[slot]) / min(self._frames[slot], _JITTER_FRAMES)

    def _restart(self, joints: Bools) -> None:
        if joints.any():
            self._filter.forget(joints)

    def _exchange(self, positions: Floats, expected: Floats, known: Bools) -> None:
        """Put exchanged limbs back: those of which both sides are nearer to the other's prediction."""
        for k, pair in enumerate(_EXCHANGED):
            keep, swap = _kept_and_exchanged(positions, expected, pair)
            with np.errstate(invalid="ignore"):  # a limb with a joint unseen compares as False
                exchanged = (keep > _SWAP_APART) & (swap < _SWAP_BETTER * keep) & known[:, pair].all(axis=1)
            self._swapped[:, k] = np.where(exchanged, self._swapped[:, k] + 1, 0)
            overruled = self._swapped[:, k] > self._settings.patience * FPS
            if overruled.any():
                exchanged &= ~overruled
                self._swapped[overruled, k] = 0
                forget = np.zeros(known.shape, dtype=bool)
                forget[np.ix_(overruled, pair)] = True
                self._restart(forget)
                expected[forget] = np.nan
            if exchanged.any():
                self._counters["limbs_exchanged"] += int(exchanged.sum())
                _put_back(positions, exchanged, pair)
                keep, swap = _kept_and_exchanged(positions, expected, _BASES[k])
                _put_back(positions, exchanged & (swap < keep), _BASES[k])


def _kept_and_exchanged(positions: Floats, expected: Floats, pair: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """(S,) metres, mean distances of the joints ``pair`` of both sides to their predictions: as they are, exchanged."""
    return (
        _apart(positions[:, pair], expected[:, pair]).mean(axis=1),
        _apart(positions[:, MIRROR[pair]], expected[:, pair]).mean(axis=1),
    )


def _put_back(positions: Floats, exchanged: Bools, pair: NDArray[np.intp]) -> None:
    """Exchange the joints ``pair`` of both sides of the bodies ``exchanged`` (S,), in place."""
    rows = np.flatnonzero(exchanged)[:, None]
    positions[rows, pair] = positions[rows, MIRROR[pair]]


@njit(cache=True)
def _apart(a, b):
    """(S, J) metres between joints (S, J, 3)."""
    apart = np.empty(a.shape[:2])
    for row in range(len(a)):
        for joint in range(a.shape[1]):
            square = 0.0
            for axis in range(3):
                square += (a[row, joint, axis] - b[row, joint, axis]) ** 2
            apart[row, joint] = math.sqrt(square)
    return apart


@njit(cache=True)
def _median_by_row(distance):
    """(S,) median of the finite values of each row; NaN where there is none."""
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
