"""Systematic sensor errors: correction of a known sensor's bias, and estimation of an unknown sensor's depth error.

The correct stage subtracts a known sensor's bias from the observed joints.

`DepthError` estimates, from bones, how much larger an unknown sensor's error is along its line of sight. No filter
averages out time-correlated errors, so the smoother's deviations omit part of them: for simulated monocular estimators,
whose errors lie in depth, the deviations are 1.7 to 2.1 times too small. Errors in depth vary the lengths of bones that
point to the camera, but hardly those of bones across the line of sight. Half the variance of bone lengths is therefore
fitted, by least squares, as a quadratic form of the bone's direction. The difference between its largest and second
eigenvalue gives the missing variance. The position of the camera need not be known.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import PARENT, finite_joints
from steadypose.prior.clean.frame import Gated
from steadypose.prior.clean.history import Ring
from steadypose.prior.clean.settings import CorrectSettings
from steadypose.prior.compiled import njit
from steadypose.prior.models.sensor_bias import HISTORY, SMOOTHER_DENSITY, LiveCorrection, features, recall, trunk_frame
from steadypose.prior.timing.kalman import ConstantVelocityFilter, Smoothed
from steadypose.prior.timing.rate import FPS

FADE = 0.9  # decay per frame of the last correction while none can be computed, because the trunk is hidden
MEMORY = round(10.0 * FPS)  # length of the running means of bone lengths, frames

PRIOR, RIDGE = 8.0, 0.05
"""Weight of the isotropic prior: frames, and share of all frames. A standing body's bones have few directions."""

MAX_SIGMA, MAX_RESIDUAL = 0.05, 0.05
"""Largest standard deviation of a joint that counts for lengths, and bound of the lengths' residuals, metres."""

LEFT_OUT = 3.0
"""Ratio of the missing variance along an axis to the difference of the eigenvalues. It exceeds 1 because lengths do not
show errors that last longer than their running mean, or that both ends share."""

_BONES = len(PARENT) - 1
_ENTRIES = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
"""Index of each entry of a symmetric 3 × 3 matrix in the vector of its six distinct entries."""
_ISOTROPIC = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_TWICE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


class Correct:
    """Adds `CorrectionNet`'s correction to each observed joint, without delay."""

    def __init__(self, settings: CorrectSettings, slots: int) -> None:
        self._net = LiveCorrection.load(settings.sensor, slots)
        self._smoother = ConstantVelocityFilter(SMOOTHER_DENSITY)
        self._history = Ring(HISTORY[-1] + 1, (slots, 22, 3))
        self._correction = np.zeros((slots, 22, 3))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        if slot.all():
            self._smoother.reset()  # a new stream: its stamps may be earlier
        self._smoother.forget(np.repeat(slot[:, None], 22, axis=1))
        self._history.clear(slot)
        self._correction[slot] = 0.0

    def update(self, gated: Gated) -> Gated:
        """The newest frame, corrected."""
        newest, observation = gated.positions, gated.observation
        smoothed = self._smoother.update(newest, observation.stamp_s)
        self._history.push(np.where(finite_joints(newest)[..., None], smoothed.positions, np.nan))
        slots = np.flatnonzero(observation.present)
        history = recall(self._history.all[:, slots])
        frames = trunk_frame(history[0])
        known = np.isfinite(frames).all(axis=(1, 2))
        self._correction[slots[~known]] *= FADE
        if known.any():
            x = features(history[:, known], observation.sensor_position)
            self._correction[slots[known]] = self._net(x) @ frames[known].swapaxes(-1, -2)
        return replace(gated, positions=newest + self._correction)


class DepthError:
    """Estimates the depth error of each body, from mean bone lengths and the moments of the fit."""

    def __init__(self, slots: int) -> None:
        self._frames, self._length = np.zeros((2, slots, _BONES))
        self._normal, self._right = np.zeros((slots, 6, 6)), np.zeros((slots, 6))
        self._total = np.zeros((2, slots))  # number of bones, and sum of half their squared residuals

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for moment in (self._frames, self._length, self._normal, self._right):
            moment[slot] = 0.0
        self._total[:, slot] = 0.0

    def update(self, smoothed: Smoothed | None, white: Floats) -> Floats:
        """Add a smoothed frame, if there is one, and return the standard deviation (S,) that its deviations omit,
        metres along an axis. ``white`` (S,) is the share of the noise that is white, which they include in full."""
        if smoothed is None:
            return np.zeros(len(white))
        _take_in(smoothed.positions, smoothed.sigma, self._frames, self._length, self._normal, self._right, self._total)
        count, squares = self._total
        ridge = RIDGE * count + PRIOR * _BONES
        mean = squares / np.maximum(count, 1.0)
        normal = self._normal + ridge[:, None, None] * np.diag(_TWICE)
        form = np.linalg.solve(normal, (self._right + (ridge * mean)[:, None] * _ISOTROPIC)[..., None])[..., 0]
        eigenvalues = np.linalg.eigvalsh(form[:, _ENTRIES])
        left_out = LEFT_OUT * (1.0 - white) * (eigenvalues[:, 2] - eigenvalues[:, 1])
        return np.sqrt(np.maximum(left_out, 0.0))


@njit(cache=True)
def _take_in(positions, sigma, frames, length, normal, right, total):
    """Add joints (S, 22, 3) and their deviations (S, 22) to the moments of `DepthError`, in place."""
    keep, entries = 1.0 - 1.0 / MEMORY, np.empty(6)
    for slot in range(len(positions)):
        for i in range(6):
            right[slot, i] *= keep
            for j in range(6):
                normal[slot, i, j] *= keep
        total[0, slot] *= keep
        total[1, slot] *= keep
        for k in range(_BONES):
            joint, above = k + 1, PARENT[k + 1]
            x = positions[slot, joint, 0] - positions[slot, above, 0]
            y = positions[slot, joint, 1] - positions[slot, above, 1]
            z = positions[slot, joint, 2] - positions[slot, above, 2]
            long = math.sqrt(x * x + y * y + z * z)
            if not (math.isfinite(long) and max(sigma[slot, joint], sigma[slot, above]) < MAX_SIGMA):
                continue
            frames[slot, k] += 1.0
            length[slot, k] += (long - length[slot, k]) / min(frames[slot, k], MEMORY)
            square = 0.5 * min((long - length[slot, k]) ** 2, MAX_RESIDUAL**2)
            x, y, z = x / max(long, 1e-6), y / max(long, 1e-6), z / max(long, 1e-6)
            entries[0], entries[1], entries[2] = x * x, y * y, z * z
            entries[3], entries[4], entries[5] = 2 * x * y, 2 * x * z, 2 * y * z
            for i in range(6):
                right[slot, i] += entries[i] * square
                for j in range(6):
                    normal[slot, i, j] += entries[i] * entries[j]
            total[0, slot] += 1.0
            total[1, slot] += square
