"""The completion network as the live node runs it: the same numbers as `CompletionNet`, without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prior.completion_net import CompletionNet, tell
from prior.graph import JOINT_NODES
from prior.graph_program import Network, Program


class LiveCompletion:
    """A trained `CompletionNet`, for one sensor.

    Args:
        model: whose weights are copied.
        slow: metres along an axis, the errors of the sensor that last.
        most: windows at once.
    """

    def __init__(self, model: CompletionNet, slow: float, most: int) -> None:
        p, self._patch, self._slow = Program(), model.config.patch, slow
        inputs = model.read.weight.shape[0]
        self._told = p.matrix(len(model.read.adjacency), inputs)
        graph = p.trunk(self._told, model.read, model.blocks)
        kept, write = JOINT_NODES * self._patch, model.write
        self._written = p.linear(graph, write.weight[:, :kept], write.bias[:, :kept], write.adjacency)
        self._net = Network(p, most)

    def complete(self, deviations: NDArray[np.floating], observed: NDArray[np.floating]) -> None:
        """Put a better guess of what was not observed into windows (B, 66, T), in place; see `CompletionNet`."""
        partly = np.flatnonzero((observed == 0).any(axis=(-2, -1)))
        if not len(partly):
            return
        told, rows = tell(deviations[partly], observed[partly], self._slow, self._patch), slice(0, len(partly))
        self._net.matrix(self._told, rows)[:] = told.nodes
        self._net.run(self._net.steps, rows)
        found = self._net.matrix(self._written, rows).reshape(len(partly), -1, JOINT_NODES).swapaxes(1, 2)
        deviations[partly] += told.share * found
