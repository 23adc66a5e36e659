"""Layers without a graph as live nodes run them: a product, and an activation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.compiled import njit

Floats = NDArray[np.float32]

FEW_ROWS = 2
"""Products of so few take half the time without a BLAS, which copies the weights first."""

SLOPE = 0.2
"""of the LeakyReLU, for negative values"""


def dense(x: Floats, weight: Floats, bias: Floats) -> Floats:
    """``x @ weight.T + bias``: (N, in) to (N, out)."""
    if len(x) > FEW_ROWS:
        return np.ascontiguousarray((weight @ x.T).T) + bias
    out = np.empty((len(x), len(weight)), dtype=np.float32)
    _few_rows(np.ascontiguousarray(x), weight, out)
    return out + bias


@njit("(f4[:,::1], f4[:,::1], f4[:,::1])", cache=True, fastmath=True)
def _few_rows(x, weight, out):
    """Writes ``x @ weight.T``: (N, in) and (M, in) to (N, M)."""
    for j in range(len(weight)):
        for i in range(len(x)):
            total = np.float32(0)
            for k in range(x.shape[1]):
                total += x[i, k] * weight[j, k]
            out[i, j] = total


def leaky_relu(x: Floats) -> Floats:
    """With the slope `SLOPE`."""
    return np.maximum(x, np.float32(SLOPE) * x)
