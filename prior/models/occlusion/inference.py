"""Live inference of `OcclusionNet` without torch, row by row, so that no output depends on other rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.occlusion.candidates import CANDIDATES
from steadypose.prior.models.weights import Arrays, load_weights

MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 7.0
"""Range of the natural logarithm of the network's standard deviation, which is in millimetres."""

SIGMA_SCALE = 1.1
"""Factor on the network's standard deviation, which is calibrated for training people. On validation people, the
error-to-sigma ratio is 1.0 to 1.3 over occlusions of 0.2 s to 4 s."""


class Occluded(NamedTuple):
    """N occluded joints of several bodies."""

    body: NDArray[np.intp]
    """(N,) row of the body"""
    joint: NDArray[np.intp]
    """(N,) index of the joint"""
    candidates: Floats
    """(N, 4, 3) metres, in the order of `CANDIDATES`"""
    features: NDArray[np.float32]
    """(N, `FEATURES`) float32"""


class Weighed(NamedTuple):
    """Estimates of N occluded joints."""

    positions: Floats
    """(N, 3) metres, in the frame of the candidates"""
    sigma: Floats
    """(N,) metres, standard deviation along an axis"""


class LiveOcclusion:
    """A trained `OcclusionNet`."""

    def __init__(self, weights: Arrays) -> None:
        per_deviation = (1.0 / weights["deviation"]).astype(np.float32)
        read = weights["read.weight"] * per_deviation
        self._layers = (
            np.ascontiguousarray(read.T),
            weights["joint"] + (weights["read.bias"] - read @ weights["mean"]),
            np.ascontiguousarray(weights["think.weight"].T), weights["think.bias"],
            np.ascontiguousarray(weights["write.weight"].T), weights["write.bias"],
        )  # fmt: skip

    @classmethod
    def load(cls, weights: str) -> LiveOcclusion:
        """Load the weights of this name; raises like `load_weights`."""
        return cls(load_weights(weights, "occlusion")[0])

    def __call__(self, rows: Occluded) -> Weighed:
        """Return the weighted mean of each joint's candidates, and its standard deviation."""
        weighed = Weighed(np.empty((len(rows.joint), 3)), np.empty(len(rows.joint)))
        _weigh(rows.features, rows.joint, rows.candidates, *self._layers, weighed.positions, weighed.sigma)
        return weighed


@njit(cache=True)
def _weigh(features, joint, candidates, read, of_joint, think, think_bias, write, write_bias, positions, sigma):
    hidden, zero = read.shape[1], np.float32(0)
    first, second, out = np.empty(hidden, np.float32), np.empty(hidden, np.float32), np.empty(CANDIDATES + 1)
    for row in range(len(features)):
        for h in range(hidden):
            first[h], second[h] = of_joint[joint[row], h], think_bias[h]
        for k in range(len(read)):
            for h in range(hidden):
                first[h] += features[row, k] * read[k, h]
        for k in range(hidden):
            first[k] = max(first[k], zero)
            for h in range(hidden):
                second[h] += first[k] * think[k, h]
        for c in range(CANDIDATES + 1):
            out[c] = write_bias[c]
        for k in range(hidden):
            added = max(second[k], zero) + first[k]
            for c in range(CANDIDATES + 1):
                out[c] += added * write[k, c]
        most, total = out[:CANDIDATES].max(), 0.0
        for c in range(CANDIDATES):
            out[c] = np.exp(out[c] - most)
            total += out[c]
        for axis in range(3):
            positions[row, axis] = 0.0
            for c in range(CANDIDATES):
                positions[row, axis] += out[c] / total * candidates[row, c, axis]
        sigma[row] = SIGMA_SCALE * 1e-3 * np.exp(min(max(out[CANDIDATES], MIN_LOG_SIGMA), MAX_LOG_SIGMA))
