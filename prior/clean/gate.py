"""The gate: jumps, impossible bone lengths, exchanged limbs and stuck joints, before they reach a network."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import CHILDREN, MIRROR, PARENT, limbs
from steadypose.prior.clean.frame import Window
from steadypose.prior.timing.fixed_lag import FixedLagRTS, Smoothed
from steadypose.prior.timing.rate import FPS

RECENT = 15
"""Frames in which a joint that repeats itself must do so mostly."""

SAME = 1e-6
"""Metres: a joint that has moved less from one frame to the next repeats itself."""

LEAST_NOISE = 0.001
"""Metres along an axis, from frame to frame: of a sensor with less, a joint that repeats itself may be at rest."""

_LEAST_NEW = 5
"""frames that were no repetition of the whole body"""


@dataclass(frozen=True)
class GateSettings:
    """Thresholds of the gate.

    Attributes:
        enabled: whether to refuse anything; off, all that is seen passes.
        jump: metres a joint may be from where it was expected, beyond three standard deviations of that.
        bone: fraction by which a bone may differ from this person's.
        patience: seconds after which a joint refused (or limbs exchanged) throughout is believed after all.
        min_confidence: joints below are unobserved.
    """

    enabled: bool = True
    jump: float = 0.18
    bone: float = 1.0
    patience: float = 0.3
    min_confidence: float = 0.1


# Limbs that detectors exchange: whole arms and whole legs, on both sides.
_EXCHANGED = tuple(np.concatenate(limbs(chain)) for chain in (("elbow", "wrist"), ("knee", "ankle", "foot")))
_SWAP_APART = 0.15  # metres between expected and seen, mean of a limb's joints, below which no exchange is suspected
_SWAP_BETTER = 0.4  # an exchange must bring the joints this much nearer to where they were expected
_JUMP_NOISES = 7.0  # times the noise: one sighting in a thousand is further from where it was expected
_LEAST_BONE, _BONE_NOISES = 0.1, 4.0  # metres, and times the noise, by which even a short bone may differ
_NOISE_MEMORY = 15  # frames
_DISTANCE_OF_NOISE = 2.6  # median distance to the expectation of white noise of 1 along each axis, by this filter
_BODY_JUMP = 0.5  # if more of the joints jump at once, the body did (a new track, a gap), not the joints


class Gate:
    """Refuses what cannot be: a refused joint becomes unobserved, exchanged limbs are put back.

    Expectation comes from a constant-velocity Kalman filter fed with what passed. Nothing is refused for longer
    than ``patience``: then the sensor is right and the expectation wrong.
    """

    delay_frames = 0

    def __init__(self, settings: GateSettings, slots: int, counters: Counter[str]) -> None:
        self._settings = settings
        self._counters = counters
        self._filter = FixedLagRTS(0, acceleration_density=8.0, measurement_sigma=0.015)
        self._refused = np.zeros((slots, 22))
        self._swapped = np.zeros((slots, len(_EXCHANGED)))
        self._frames = np.zeros(slots, dtype=np.int64)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        if slot.all():
            self._filter.reset()  # a new stream: its stamps may be earlier
        self._filter.forget(np.repeat(slot[:, None], 22, axis=1))
        self._refused[slot] = 0
        self._swapped[slot] = 0
        self._frames[slot] = 0

    def update(self, window: Window) -> Window:
        """Write the newest frame's positions from its raw ones, NaN where refused."""
        s = self._settings
        stamp = float(window.stamp_s.newest)
        positions = window.raw.newest.copy()
        positions[window.confidence.newest < s.min_confidence] = np.nan
        slots = np.flatnonzero(window.present)
        window.stuck[:] = False
        window.stuck[slots] = stuck(window.raw.all[-RECENT - 1 :, slots].swapaxes(0, 1))
        if s.enabled and window.stuck.any():
            self._counters["joints_stuck"] += int(window.stuck.sum())
            positions[window.stuck] = np.nan
        expected = self._filter.predict(stamp)
        if expected is not None:
            distance = _apart(positions, expected.positions)
            self._measure_noise(window, distance)
            if s.enabled:
                self._judge(window, positions, expected, distance)
        self._filter.update(positions, stamp)
        window.positions.push(positions)
        return window

    def _judge(
        self,
        window: Window,
        positions: NDArray[np.float64],
        expected: Smoothed,
        distance: NDArray[np.float64],
    ) -> None:
        """Put exchanged limbs back, and make NaN what is refused, in place."""
        s = self._settings
        known = np.isfinite(expected.positions[..., 0])
        if (distance > _SWAP_APART).any() or self._swapped.any():
            self._exchange(positions, expected.positions, known)
            distance = _apart(positions, expected.positions)
        seen = np.isfinite(positions[..., 0])
        least = np.maximum(s.jump, _JUMP_NOISES * window.noise)[:, None]
        jumped = seen & known & (distance > least + 3 * expected.sigma)
        everywhere = jumped.sum(axis=1) > _BODY_JUMP * np.maximum((seen & known).sum(axis=1), 1)
        self._believe(everywhere[:, None] & jumped)
        jumped &= ~everywhere[:, None]
        refused = jumped | (self._bad_bones(window, positions) & ~everywhere[:, None])
        self._refused = np.where(refused, self._refused + 1, 0)
        overruled = self._refused > s.patience * FPS
        self._believe(overruled)
        refused &= ~overruled
        self._refused[overruled] = 0
        if refused.any():
            self._counters["joints_refused"] += int(refused.sum())
            positions[refused] = np.nan

    def _measure_noise(self, window: Window, distance: NDArray[np.float64]) -> None:
        """Keep ``window.noise``, from how far (S, 22) the middle one of a body's joints comes from where expected.

        The middle one, so that a limb thrown about, or a joint that jumps, says nothing about the sensor. Noise that
        lasts over frames is not seen here; it belongs to the sensor's bias.
        """
        noise = _middle(distance) / _DISTANCE_OF_NOISE
        for slot in np.flatnonzero(np.isfinite(noise)):
            self._frames[slot] += 1
            window.noise[slot] += (noise[slot] - window.noise[slot]) / min(self._frames[slot], _NOISE_MEMORY)

    def _believe(self, joints: NDArray[np.bool_]) -> None:
        if joints.any():
            self._filter.forget(joints)

    def _exchange(
        self, positions: NDArray[np.float64], expected: NDArray[np.float64], known: NDArray[np.bool_]
    ) -> None:
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
                self._believe(forget)
                expected[forget] = np.nan
            if exchanged.any():
                self._counters["limbs_exchanged"] += int(exchanged.sum())
                rows = np.flatnonzero(exchanged)[:, None]
                positions[rows, pair] = positions[rows, MIRROR[pair]]

    def _bad_bones(self, window: Window, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(S, 22) joints at the end of a bone of impossible length."""
        least = _LEAST_BONE + _BONE_NOISES * window.noise
        return _of_impossible_length(positions, window.offsets, self._settings.bone, least) & window.measured[:, None]


@njit(cache=True)
def stuck(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(B, 22) joints that a tracker has lost and of which it repeats the last answer.

    They do so in most of the frames in which the body is not repeated whole, and other joints shake.

    Args:
        positions: (B, T, 22, 3) metres as the sensor gave them, NaN where it did not; the last frames count.
    """
    count, frames, joints, _ = positions.shape
    found = np.zeros((count, joints), dtype=np.bool_)
    for b in range(count):
        recent = positions[b, max(frames - RECENT - 1, 0) :]
        new, repeated, noise = 0, np.zeros(joints), np.zeros(joints)
        for t in range(1, len(recent)):
            same = np.ones(joints)
            for joint in range(joints):
                for axis in range(3):
                    if not abs(recent[t, joint, axis] - recent[t - 1, joint, axis]) < SAME:
                        same[joint] = 0.0
            if same.mean() <= 0.5:
                new += 1
                repeated += same
        if not (repeated > 0.5 * max(new, _LEAST_NEW)).any():
            continue
        for joint in range(joints):
            square, seen = 0.0, 0
            for t in range(2, len(recent)):
                shaken = recent[t, joint] - 2 * recent[t - 1, joint] + recent[t - 2, joint]
                if np.isfinite(shaken).all():
                    square += (shaken**2).sum()
                    seen += 3
            noise[joint] = math.sqrt(square / 6 / max(seen, 1))
        if np.median(noise) > LEAST_NOISE:
            found[b] = repeated > 0.5 * max(new, _LEAST_NEW)
    return found


_LEAF = np.array([not children for children in CHILDREN])


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
    middle = np.full(len(distance), np.nan)
    for row in range(len(distance)):
        known = distance[row][np.isfinite(distance[row])]
        if len(known):
            middle[row] = np.median(known)
    return middle


@njit(cache=True)
def _of_impossible_length(positions, offsets, share, least):
    """(S, 22) joints at the end of a bone that differs from the person's own by more than ``share`` of it, and more
    than ``least`` (S,)."""
    bad = np.zeros(positions.shape[:2], dtype=np.bool_)
    for row in range(len(positions)):
        for joint in range(1, positions.shape[1]):
            length, own = 0.0, 0.0
            for axis in range(3):
                length += (positions[row, joint, axis] - positions[row, PARENT[joint], axis]) ** 2
                own += offsets[row, joint, axis] ** 2
            off = abs(math.sqrt(length) - math.sqrt(own))
            bad[row, joint] = off > max(share * math.sqrt(own), least[row])
        for joint in range(1, positions.shape[1]):
            # A bad bone does not say which end is wrong: where the next bone is bad too, it is the joint between.
            if _LEAF[joint] and bad[row, PARENT[joint]]:
                bad[row, joint] = False
    return bad
