"""The fault network as the live node runs it: the same numbers as `FaultNet`, without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.config import JOINT_NODES, FaultNetConfig
from steadypose.prior.models.hgvae.fault_features import fault_features
from steadypose.prior.models.layers.compiled_graph import Network, Program
from steadypose.prior.models.weights_io import Arrays, load_weights, part, weights_path

Floats = NDArray[np.float64]


class LiveFaultNet:
    """A trained `FaultNet`.

    Args:
        config: its sizes.
        weights: its state dict.
        max_batch: windows at once.
    """

    def __init__(self, config: FaultNetConfig, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean = weights["mean"].astype(np.float64)
        self._features = p.matrix(JOINT_NODES, 4 * config.frames + 2)
        self._odds = p.layer(p.trunk(self._features, weights), part(weights, "write"))
        self._net = Network(p, max_batch)

    @classmethod
    def load(cls, weights: str, max_batch: int) -> LiveFaultNet:
        """The one beside HG-VAE's weights of this name.

        Raises:
            FileNotFoundError: there is none; says which there are.
        """
        path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
        arrays, config = load_weights(str(path), "hgvae")
        return cls(FaultNetConfig.from_dict(config), arrays, max_batch)

    def __call__(
        self, x: Floats, reconstructed: Floats, sigma: Floats, observed: Floats, sensor_sigma: Floats
    ) -> Floats:
        """(B, 22) log-odds that a joint is faulty; the arguments are those of `fault_features`."""
        rows = slice(0, len(x))
        self._net.matrix(self._features, rows)[:] = fault_features(
            x, reconstructed, sigma, observed, sensor_sigma, self._mean
        )
        self._net.run(self._net.steps, rows)
        return self._net.matrix(self._odds, rows)[..., 0].astype(np.float64)
