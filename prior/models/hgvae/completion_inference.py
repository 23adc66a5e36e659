"""The completion network as the live node runs it: the same numbers as `CompletionNet`, without torch."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.hgvae.completion import FIRST_LOG_VAR, GROWTH, LAG, STILL, SURE, CompletionNet, tell
from steadypose.prior.models.layers.compiled_graph import Network, Program
from steadypose.prior.models.layers.graph import LOG_VAR_RANGE, SCALE


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
        told, rows = tell(deviations[partly], observed[partly], self._slow, self._patch), len(partly)
        self._net.matrix(self._told, slice(0, rows))[:] = told.nodes
        self._net.run(self._net.steps, slice(0, rows))
        _fuse(self._net.matrix(self._written, slice(0, rows)), *told[1:], partly, observed, deviations, believed)
        return believed


@njit(cache=True)
def _fuse(written, moved, noise, apart, places, observed, deviations, believed):
    """As `CompletionNet.fuse` and `certainty`: what windows at ``places`` become, and how far to believe them."""
    joints, frames = apart.shape[1:]
    patch = written.shape[2] // (4 * joints)
    least, half = np.float32((STILL / SCALE) ** 2), np.float32(2 * math.log(SURE / SCALE))
    held = np.empty((joints, frames), dtype=np.float32)
    for row, place in enumerate(places):
        for joint in range(joints):
            for t in range(frames):
                far = apart[row, joint, t]
                held[joint, t] = held[PARENTS[joint], t] if PARENTS[joint] > 0 else 0.0
                if far > 0:
                    held[joint, t] += (moved[row, joint] + least) * (far / LAG) ** GROWTH + noise[row, joint]
                if far == 0:
                    continue
                node, k = t // patch, t % patch
                log_var = written[row, node, 3 * joints * patch + k * joints + joint] + np.float32(FIRST_LOG_VAR)
                log_var = min(max(log_var, LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                leaning = held[joint, t] / (held[joint, t] + math.exp(log_var)) if far > 0 else 1.0
                fused = min(max(log_var + math.log(max(leaning, 1e-6)), LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                for axis in range(3):
                    track = 3 * joint + axis
                    if observed[place, track, t] == 0:
                        deviations[place, track, t] += leaning * written[row, node, k * 3 * joints + track]
                        believed[place, track, t] = 1.0 / (1.0 + math.exp(fused - half))
