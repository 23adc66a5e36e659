"""The completion network as the live node runs it: the same numbers as `CompletionNet`, without torch."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.completion_features import FIRST_LOG_VAR, HALF_CERTAIN_SIGMA, completion_features
from steadypose.prior.models.hgvae.config import SCALE, CompletionConfig
from steadypose.prior.models.layers.compiled_graph import LOG_VAR_RANGE, Network, Program
from steadypose.prior.models.weights_io import Arrays, part


class LiveCompletion:
    """A trained `CompletionNet`.

    Args:
        config: its sizes.
        weights: its state dict.
        max_batch: windows at once.
    """

    def __init__(self, config: CompletionConfig, weights: Arrays, max_batch: int) -> None:
        p, self._patch = Program(), config.patch
        nodes, inputs = len(weights["read.adjacency"]), len(weights["read.weight"])
        self._nodes = p.matrix(nodes, inputs)
        self._written = p.layer(p.trunk(self._nodes, weights), part(weights, "write"))
        self._net = Network(p, max_batch)

    def complete(
        self, deviations: NDArray[np.floating], observed: NDArray[np.floating], bias_sigma: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """Complete the unobserved entries of windows, in place; see `CompletionNet.complete`.

        Args:
            deviations: (B, 66, T) tracks less the training mean, in units of `SCALE`; changed.
            observed: (B, 66, T) more than 0 where observed.
            bias_sigma: (B,) metres along an axis, the sensor's slow error.

        Returns:
            (B, 66, T) certainty of each entry, see `completion.certainty_of`.
        """
        certainty = (observed > 0).astype(np.float32)
        partly = np.flatnonzero((observed == 0).any(axis=(-2, -1)))
        if not len(partly):
            return certainty
        features = completion_features(deviations[partly], observed[partly], bias_sigma[partly], self._patch)
        rows = slice(0, len(partly))
        self._net.matrix(self._nodes, rows)[:] = features.nodes
        self._net.run(self._net.steps, rows)
        written = self._net.matrix(self._written, rows)
        _fuse(written, features.line_variance(), partly, observed, deviations, certainty)
        return certainty


@njit(cache=True)
def _fuse(written, line_variance, places, observed, deviations, certainty):
    """As `CompletionNet.fuse` and `certainty_of`: completes the windows at ``places``, and writes their certainty."""
    joints, frames = line_variance.shape[1:]
    patch = written.shape[2] // (4 * joints)
    half = np.float32(2 * math.log(HALF_CERTAIN_SIGMA / SCALE))
    for row in range(len(places)):
        place = places[row]
        for joint in range(joints):
            for t in range(frames):
                held = line_variance[row, joint, t]
                if held == 0:
                    continue
                node, k = t // patch, t % patch
                log_var = written[row, node, 3 * joints * patch + k * joints + joint] + np.float32(FIRST_LOG_VAR)
                log_var = min(max(log_var, LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                gain = held / (held + math.exp(log_var)) if held < np.inf else 1.0
                fused = min(max(log_var + math.log(max(gain, 1e-6)), LOG_VAR_RANGE[0]), LOG_VAR_RANGE[1])
                for axis in range(3):
                    track = 3 * joint + axis
                    if observed[place, track, t] == 0:
                        deviations[place, track, t] += gain * written[row, node, k * 3 * joints + track]
                        certainty[place, track, t] = 1.0 / (1.0 + math.exp(fused - half))
