"""The gate: jumps, impossible bone lengths, exchanged limbs and frozen joints, before they reach a network."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numba import njit

from steadypose.prior.body.skeleton import MIRROR, limbs
from steadypose.prior.clean.bone_outliers import BoneOutliers
from steadypose.prior.clean.frame import Bools, Floats, Gated, Observation
from steadypose.prior.compiled import median
from steadypose.prior.timing.fixed_lag import FixedLagRTS, Smoothed
from steadypose.prior.timing.frozen_joints import RECENT, frozen_joints
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.ring import Ring


@dataclass(frozen=True)
class GateSettings:
    """Thresholds of the gate.

    Attributes:
        enabled: whether to refuse anything; off, all that is seen passes.
        jump: metres a joint may be from where it was expected, beyond three standard deviations of that.
        patience: seconds after which a joint refused (or limbs exchanged) throughout is accepted after all.
        min_confidence: joints below are unobserved.
    """

    enabled: bool = True
    jump: float = 0.18
    patience: float = 0.3
    min_confidence: float = 0.1


# Limbs that detectors exchange: whole arms and whole legs, on both sides.
_EXCHANGED = tuple(np.concatenate(limbs(chain)) for chain in (("elbow", "wrist"), ("knee", "ankle", "foot")))
_SWAP_APART = 0.15  # metres between expected and seen, mean of a limb's joints, below which no exchange is suspected
_SWAP_BETTER = 0.4  # an exchange must bring the joints this much nearer to where they were expected
_JUMP_NOISES = 7.0  # times the noise: one sighting in a thousand is further from where it was expected
_NOISE_MEMORY = 15  # frames
_DISTANCE_OF_NOISE = 2.6  # median distance to the expectation of white noise of 1 along each axis, by this filter
_OWN_MEMORY, _OWN_TIMES = 9, 3.0  # frames in which a joint shows how far from expected it comes, and times that
_SETS_OFF = 4.0  # m/s that a joint at rest may reach while it is not seen
_BODY_JUMP = 0.5  # if more of the joints jump at once, the body did (a new track, a gap), not the joints


class Gate:
    """Refuses what cannot be: a refused joint becomes unobserved, exchanged limbs are put back.

    Expectation comes from a constant-velocity Kalman filter fed with what passed. No jump is refused for longer than
    ``patience``: then the sensor is right and the expectation wrong. Bones are judged by `BoneOutliers`.
    """

    def __init__(self, settings: GateSettings, slots: int, counters: Counter[str]) -> None:
        self._settings = settings
        self._counters = counters
        self._filter = FixedLagRTS(0, acceleration_density=8.0, measurement_sigma=0.015)
        self._bones = BoneOutliers(slots)
        self._observed = Ring(RECENT + 1, (slots, 22, 3))
        self._jitter = np.zeros(slots)
        self._own = np.zeros((slots, 22))
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
        self._own[slot] = 0.0
        self._frames[slot] = 0
        self._lost[slot] = 0
        self._refused[slot] = 0
        self._swapped[slot] = 0

    def update(self, observation: Observation) -> Gated:
        """The newest frame without what is refused."""
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
                self._judge(positions, expected, distance)
        self._lost = np.where(np.isfinite(observation.positions[..., 0]), 0, self._lost + 1)
        self._filter.update(positions, observation.stamp_s)
        return Gated(observation, positions, self._jitter.copy(), frozen)

    def _judge(self, positions: Floats, expected: Smoothed, distance: Floats) -> None:
        """Put exchanged limbs back, and make NaN what is refused, in place."""
        s = self._settings
        known = np.isfinite(expected.positions[..., 0])
        if (distance > _SWAP_APART).any() or self._swapped.any():
            self._exchange(positions, expected.positions, known)
            distance = _apart(positions, expected.positions)
        seen = np.isfinite(positions[..., 0])
        # a limb thrown about comes far from where it was expected all the time, a joint that jumps once
        least = np.maximum(np.maximum(s.jump, _JUMP_NOISES * self._jitter)[:, None], _OWN_TIMES * self._own)
        self._own += np.where(seen & known, distance - self._own, 0.0) / _OWN_MEMORY
        # one that comes back may have turned round, or set off, while it was away
        speed = np.maximum(2 * np.linalg.norm(self._filter.velocity, axis=-1), _SETS_OFF)
        jumped = seen & known & (distance > least + speed * self._lost / FPS + 3 * expected.sigma)
        everywhere = jumped.sum(axis=1) > _BODY_JUMP * np.maximum((seen & known).sum(axis=1), 1)
        self._expect_anew(everywhere[:, None] & jumped)
        jumped &= ~everywhere[:, None]
        self._refused = np.where(jumped, self._refused + 1, 0)
        overruled = self._refused > s.patience * FPS
        self._expect_anew(overruled)
        self._refused[overruled] = 0
        refused = jumped & ~overruled | self._bones.update(positions)
        if refused.any():
            self._counters["joints_refused"] += int(refused.sum())
            positions[refused] = np.nan

    def _measure_jitter(self, distance: Floats) -> None:
        """Go on measuring the jitter, from how far (S, 22) the middle one of a body's joints comes from where expected.

        The middle one, so that a limb thrown about, or a joint that jumps, says nothing about the sensor. Noise that
        lasts over frames is not seen here; it belongs to the sensor's bias.
        """
        jitter = _middle(distance) / _DISTANCE_OF_NOISE
        for slot in np.flatnonzero(np.isfinite(jitter)):
            self._frames[slot] += 1
            self._jitter[slot] += (jitter[slot] - self._jitter[slot]) / min(self._frames[slot], _NOISE_MEMORY)

    def _expect_anew(self, joints: Bools) -> None:
        if joints.any():
            self._filter.forget(joints)

    def _exchange(self, positions: Floats, expected: Floats, known: Bools) -> None:
        """Put exchanged limbs back: both sides are nearer to where the other was expected."""
        for k, pair in enumerate(_EXCHANGED):
            keep = _apart(positions[:, pair], expected[:, pair]).mean(axis=1)
            swap = _apart(positions[:, MIRROR[pair]], expected[:, pair]).mean(axis=1)
            with np.errstate(invalid="ignore"):  # a limb with a joint unseen compares as False
                exchanged = (keep > _SWAP_APART) & (swap < _SWAP_BETTER * keep) & known[:, pair].all(axis=1)
            self._swapped[:, k] = np.where(exchanged, self._swapped[:, k] + 1, 0)
            overruled = self._swapped[:, k] > self._settings.patience * FPS
            if overruled.any():
                exchanged &= ~overruled
                self._swapped[overruled, k] = 0
                forget = np.zeros(known.shape, dtype=bool)
                forget[np.ix_(overruled, pair)] = True
                self._expect_anew(forget)
                expected[forget] = np.nan
            if exchanged.any():
                self._counters["limbs_exchanged"] += int(exchanged.sum())
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
def _middle(distance):
    """(S,) the median of what is finite of each row, NaN where nothing is."""
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
