"""The fault network as the live node runs it: the same numbers as `FaultNet`, without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.faults import FaultNet, tell
from steadypose.prior.models.layers.compiled_graph import Network, Program
from steadypose.prior.models.layers.graph import JOINT_NODES

Floats = NDArray[np.float64]


class LiveFaultNet:
    """A trained `FaultNet`, for one sensor.

    Args:
        model: whose weights are copied.
        sensor_sigma: metres along an axis, what the sensor may be off by.
        most: windows at once.
    """

    def __init__(self, model: FaultNet, sensor_sigma: float, most: int) -> None:
        p = Program()
        self._mean, self._sensor_sigma = model.mean.double().numpy(), sensor_sigma
        self._told = p.matrix(JOINT_NODES, 4 * model.config.frames + 2)
        graph = p.trunk(self._told, model.read, model.blocks)
        self._odds = p.layer(graph, model.write)
        self._net = Network(p, most)

    def __call__(self, x: Floats, found: Floats, sigma: Floats, observed: Floats) -> Floats:
        """(B, 22) logarithm of the odds that a joint is off; the arguments are those of `tell`."""
        rows = slice(0, len(x))
        self._net.matrix(self._told, rows)[:] = tell(x, found, sigma, observed, self._sensor_sigma, self._mean)
        self._net.run(self._net.steps, rows)
        return self._net.matrix(self._odds, rows)[..., 0].astype(np.float64)
