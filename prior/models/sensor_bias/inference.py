"""The network of a sensor's error as the live node runs it: the same numbers as `CorrectionNet`, without torch."""

from __future__ import annotations

import numpy as np

from steadypose.prior.models.layers.compiled_graph import Network, Program
from steadypose.prior.models.sensor_bias.features import FEATURES, Floats
from steadypose.prior.models.weights_io import Arrays, load_weights, part


class LiveCorrection:
    """A trained `CorrectionNet`.

    Args:
        weights: its state dict, which is copied.
        max_batch: frames at once.
    """

    def __init__(self, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean, self._scale = (weights[name].astype(np.float64) for name in ("mean", "scale"))
        self._features = matrix = p.matrix(1, FEATURES)
        for k in (0, 3, 6):  # between them, an activation and a dropout
            layer = part(weights, f"layers.{k}")
            matrix = p.linear(matrix, layer["weight"].T, layer["bias"], active=k > 0)
        self._answer, self._net = matrix, Network(p, max_batch)

    @classmethod
    def load(cls, sensor: str, max_batch: int) -> LiveCorrection:
        """From the weights of this sensor.

        Raises:
            FileNotFoundError: there are none; says which there are.
        """
        return cls(load_weights(sensor, "correction")[0], max_batch)

    def __call__(self, features: Floats) -> Floats:
        """(B, 22, 3) metres in the trunk's frame, what must be added to each joint, from `features` (B, FEATURES).

        NaN features are missing joints: they read as the training mean.
        """
        rows = slice(0, len(features))
        self._net.matrix(self._features, rows)[:, 0] = np.nan_to_num((features - self._mean) / self._scale)
        self._net.run(self._net.steps, rows)
        return self._net.matrix(self._answer, rows).reshape(-1, 22, 3).astype(np.float64)
