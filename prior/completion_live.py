"""The completion network as the live node runs it: the same numbers as `CompletionNet`, its layers without torch."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from prior.completion_net import CompletionNet, certainty, tell
from prior.graph_program import Network, Program


class LiveCompletion:
    """A trained `CompletionNet`, for one sensor.

    Args:
        model: whose weights are copied.
        slow: metres along an axis, the errors of the sensor that last.
        most: windows at once.
    """

    def __init__(self, model: CompletionNet, slow: float, most: int) -> None:
        p, self._model, self._slow = Program(), model, slow
        inputs = model.read.weight.shape[0]
        self._told = p.matrix(len(model.read.adjacency), inputs)
        self._written = p.layer(p.trunk(self._told, model.read, model.blocks), model.write)
        self._net = Network(p, most)

    def complete(self, deviations: NDArray[np.floating], observed: NDArray[np.floating]) -> NDArray[np.float32]:
        """Put a better guess of what was not observed into windows (B, 66, T), in place; see `CompletionNet`.

        Returns:
            (B, 66, T) their `certainty`.
        """
        believed = (observed > 0).astype(np.float32)
        partly = np.flatnonzero((observed == 0).any(axis=(-2, -1)))
        if not len(partly):
            return believed
        told, rows = tell(deviations[partly], observed[partly], self._slow, self._model.config.patch), len(partly)
        self._net.matrix(self._told, slice(0, rows))[:] = told.nodes
        self._net.run(self._net.steps, slice(0, rows))
        with torch.inference_mode():
            written = torch.from_numpy(self._net.matrix(self._written, slice(0, rows)))
            correction, log_var = self._model.fuse(written, *(torch.from_numpy(part) for part in told[1:]))
            deviations[partly] += np.where(believed[partly] > 0, 0.0, correction.numpy())
            believed[partly] = certainty(torch.from_numpy(believed[partly]), log_var).numpy()
        return believed
