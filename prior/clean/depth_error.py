"""Estimate, from bones, of how much more a sensor errs along one direction: its line of sight.

No filter averages out what lasts, so the smoother's deviations leave part of it out: of simulated monocular estimators,
whose errors lie in depth, they are 1.7 to 2.1 times too small. But errors in depth vary the lengths of bones that point
to the camera, and hardly those of bones that lie across, whatever the person does. Half the variance of bones' lengths
is fitted, by least squares, as a quadratic form of their direction. By how much its largest eigenvalue exceeds the
second says how much is left out; where the camera is, need not be known.
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

MEMORY = round(10.0 * FPS)
"""Frames of the running means."""

PRIOR, RIDGE = 8.0, 0.05
"""Frames, and share of all frames, that count as isotropic: bodies that stand show few directions."""

MAX_SIGMA, MAX_RESIDUAL = 0.05, 0.05
"""Metres: joints of a larger standard deviation do not count for lengths, and larger residuals as this."""

LEFT_OUT = 3.0
"""Variance along an axis that is left out, relative to the difference of the eigenvalues: what lasts longer than the
mean of the lengths does not vary them, nor do errors that both ends share."""

_BONES = np.arange(1, 22)
_PARENTS = np.array(PARENTS[1:])
_ENTRIES = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
"""Of the symmetric matrix, in the vector of its six different entries."""
_ISOTROPIC = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_TWICE = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])


class DepthError:
    """Keeps, for each body, mean lengths of bones, and the moments of the fit.

    Args:
        slots: bodies.
    """

    def __init__(self, slots: int) -> None:
        self._frames, self._length = np.zeros((2, slots, len(_BONES)))
        self._normal, self._right = np.zeros((slots, 6, 6)), np.zeros((slots, 6))
        self._total = np.zeros((2, slots))  # of bones, and of halves of their squared residuals

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for moment in (self._frames, self._length, self._normal, self._right):
            moment[slot] = 0.0
        self._total[:, slot] = 0.0

    def update(self, smoothed: Smoothed | None, white: Floats) -> Floats:
        """Take in joints (S, 22) and their deviations; the deviation (S,) along an axis, metres, that these leave out.

        Args:
            smoothed: of a frame; None while there is none.
            white: (S,) share of the noise that is white, of which they leave out nothing.
        """
        if smoothed is None:
            return np.zeros(len(white))
        bone = smoothed.positions[:, _BONES] - smoothed.positions[:, _PARENTS]
        length = np.linalg.norm(bone, axis=-1)
        known = np.isfinite(length) & (np.maximum(smoothed.sigma[:, _BONES], smoothed.sigma[:, _PARENTS]) < MAX_SIGMA)
        self._frames += known
        share = known / np.clip(self._frames, 1.0, MEMORY)
        length = np.where(known, length, self._length)
        self._length += share * (length - self._length)
        square = 0.5 * np.minimum(np.square(length - self._length), MAX_RESIDUAL**2) * known
        x, y, z = np.moveaxis(np.where(known[..., None], bone, 0.0) / np.maximum(length, 1e-6)[..., None], -1, 0)
        direction = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=-1)
        keep = 1.0 - 1.0 / MEMORY
        self._normal = keep * self._normal + np.einsum("sbi,sbj->sij", direction, direction)
        self._right = keep * self._right + np.einsum("sbi,sb->si", direction, square)
        self._total = keep * self._total + np.stack([known.sum(axis=1), square.sum(axis=1)])
        count, squares = self._total
        ridge = RIDGE * count + PRIOR * len(_BONES)
        mean = squares / np.maximum(count, 1.0)
        normal = self._normal + ridge[:, None, None] * np.diag(_TWICE)
        form = np.linalg.solve(normal, (self._right + (ridge * mean)[:, None] * _ISOTROPIC)[..., None])[..., 0]
        eigenvalues = np.linalg.eigvalsh(form[:, _ENTRIES])
        left_out = LEFT_OUT * (1.0 - white) * (eigenvalues[:, 2] - eigenvalues[:, 1])
        return np.sqrt(np.maximum(left_out, 0.0))
