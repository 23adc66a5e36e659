"""A bank of fixed-lag smoothers, weighed by how well each predicted: where a joint was between two sightings.

Multiple-model estimation in its static form (Bar-Shalom, Li and Kirubarajan 2001, section 11.6), with a memory that
fades. The measurement noise is not told: of each smoother it is what its innovations say (concentrated likelihood), so
that only the ratio of process to noise tells the smoothers apart, and a joint's deviation follows its own noise.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.timing.fixed_lag import FixedLagRTS, Smoothed

Floats = NDArray[np.float64]

MEMORY = 9
"""Sightings over which a prediction's likelihood fades: 5 to 15 differ by 3 % at most (validation)."""

LEAST_SCALE = 1e-4
"""Added, per sighting remembered, to the squared innovations: a hundredth of the measurement's deviation."""


class MultipleModelSmoother:
    """Smooths the joints of several bodies; each frame is answered ``delay`` frames later.

    Args:
        delay: frames.
        slots: bodies.
        joints: of a body.
        densities: (M,) m²/s³, process densities of the smoothers, for a measurement of ``sigma``.
        sigma: metres along an axis, at full confidence. Only its ratio to the densities matters.
    """

    def __init__(self, delay: int, slots: int, joints: int, densities: Floats, sigma: float) -> None:
        self._bank, self._sigma = FixedLagRTS(delay, densities, sigma), sigma
        shape = (slots, joints, len(densities))
        self._misfit, self._spread, self._count = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])

    def update(self, positions: Floats, stamp_s: float, confidence: Floats) -> Smoothed | None:
        """Take a frame; give the estimate of the frame ``delay`` before it, or None while there is none.

        Args:
            positions: (S, J, 3) metres, NaN where unseen.
            stamp_s: seconds of capture, increasing.
            confidence: (S, J) 0 to 1.
        """
        sigma = self._sigma / np.clip(confidence, 0.1, 1.0)
        expected = self._bank.predict(stamp_s)
        if expected is not None:
            _remember(positions, sigma, expected.positions, expected.sigma, self._misfit, self._spread, self._count)
        each = self._misfit.shape
        smoothed = self._bank.update(
            np.broadcast_to(positions[:, :, None], (*each, 3)), stamp_s, np.broadcast_to(sigma[..., None], each)
        )
        return None if smoothed is None else self._mixed(smoothed)

    def flush(self) -> list[Smoothed]:
        """Give the estimates still held, oldest first, and start afresh."""
        held = [self._mixed(smoothed) for smoothed in self._bank.flush()]
        self.forget(np.ones(len(self._count), dtype=bool))
        return held

    def forget(self, slot: NDArray[np.bool_]) -> None:
        """Start these slots (S,) afresh; estimates still held of them are lost."""
        self._bank.forget(np.broadcast_to(slot[:, None, None], self._misfit.shape))
        for state in (self._misfit, self._spread, self._count):
            state[slot] = 0.0

    def _mixed(self, each: Smoothed) -> Smoothed:
        positions, sigma = np.empty((*self._count.shape, 3)), np.empty(self._count.shape)
        _mix(each.positions, each.sigma, self._misfit, self._spread, self._count, positions, sigma)
        return Smoothed(each.stamp_s, positions, sigma)


@njit(cache=True, error_model="numpy")
def _remember(positions, sigma, expected, expected_sigma, misfit, spread, count):
    """Take the innovations of a frame in: positions (S, J, 3), expected (S, J, M, 3)."""
    keep = 1.0 - 1.0 / MEMORY
    for s in range(len(positions)):
        for j in range(positions.shape[1]):
            if not np.isfinite(positions[s, j].sum() + expected[s, j, 0, 0]):
                continue
            count[s, j] = keep * count[s, j] + 1.0
            for m in range(expected.shape[2]):
                variance = expected_sigma[s, j, m] ** 2 + sigma[s, j] ** 2
                square = 0.0
                for axis in range(3):
                    square += (positions[s, j, axis] - expected[s, j, m, axis]) ** 2
                misfit[s, j, m] = keep * misfit[s, j, m] + square / (3.0 * variance) + LEAST_SCALE
                spread[s, j, m] = keep * spread[s, j, m] + np.log(variance)


@njit(cache=True, error_model="numpy")
def _mix(each, each_sigma, misfit, spread, count, positions, sigma):
    """Write the mean of the smoothers' answers (S, J, M, 3), and its standard deviation along an axis."""
    models = each.shape[2]
    scale, weight = np.ones(models), np.empty(models)
    for s in range(len(each)):
        for j in range(each.shape[1]):
            most = -np.inf
            for m in range(models):
                scale[m] = misfit[s, j, m] / count[s, j] if count[s, j] > 0.0 else 1.0
                weight[m] = -1.5 * (count[s, j] * np.log(scale[m]) + spread[s, j, m])
                most = max(most, weight[m])
            total = 0.0
            for m in range(models):
                weight[m] = np.exp(weight[m] - most)
                total += weight[m]
            variance = 0.0
            for axis in range(3):
                mean = 0.0
                for m in range(models):
                    mean += weight[m] / total * each[s, j, m, axis]
                positions[s, j, axis] = mean
                for m in range(models):
                    variance += weight[m] / total * (each[s, j, m, axis] - mean) ** 2 / 3.0
            for m in range(models):
                variance += weight[m] / total * scale[m] * each_sigma[s, j, m] ** 2
            sigma[s, j] = np.sqrt(variance) if np.isfinite(variance) else np.inf
