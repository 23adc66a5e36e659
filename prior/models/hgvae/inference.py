"""Live inference of HG-VAE without torch: `HGVAE` at the means of its latents, for the windows of all bodies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.compiled_graph import LOG_VAR_RANGE, Network, Program
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, TRACK_LOG_VAR, HGVAEConfig
from steadypose.prior.models.hgvae.features import hang_unseen
from steadypose.prior.models.hgvae.live_completion import LiveCompletion
from steadypose.prior.models.weights import Arrays, load_weights, part


class Reconstruction(NamedTuple):
    """The distribution p(x | z) of windows."""

    mean: NDArray[np.float64]  # (..., 66, T) metres of a body of standard size, tracks
    sigma: NDArray[np.float64]  # (..., 66, T) metres, standard deviations


class LiveHGVAE:
    """A trained `HGVAE`, without actions, at the means of its latents, for windows of ``frames`` (T) and at most
    ``max_batch`` windows per call."""

    def __init__(self, config: HGVAEConfig, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._completion = None
        if config.completion:
            self._completion = LiveCompletion(config.completion, part(weights, "completion"), max_batch)
        self.frames, self._mean = config.frames, weights["mean"].astype(np.float64)[:, None]
        self._x = p.matrix(JOINT_NODES, 2 * config.frames)  # the tracks, and beside them what was observed
        kept, dct, read = config.coefficients, weights["dct"], part(weights, "read")
        weight = np.concatenate([dct.T @ read["weight"][:kept], read["weight"][kept:]])
        graph = p.gelu(p.linear(self._x, weight, read["bias"], read["adjacency"]))
        p.block(graph, part(weights, "read_block"), onto=graph)
        # the encoder's half of each level's `join`; the decoder adds the stream's half
        features, seen = config.features, []
        levels = [part(weights, f"down.{k}") for k in range(len(config.levels))]
        for k, level in enumerate(reversed(levels)):
            graph = p.layer(graph, part(weights, f"up.{k}"))
            p.block(graph, part(weights, f"encoder.{k}"), onto=graph)
            seen.append(p.linear(graph, level["join.weight"].T[features:], level["join.bias"]))
        nothing, one = np.zeros((1, features), dtype=np.float32), np.zeros((JOINT_NODES, 1), dtype=np.float32)
        stream = p.linear(p.matrix(1, 1), nothing, weights["start"], one)
        for (_, latent), level, encoded in zip(config.levels, levels, reversed(seen), strict=True):
            above = p.layer(stream, part(level, "contract"))
            joined = p.linear(above, level["join.weight"].T[:features], nothing, plus=encoded)
            p.block(joined, part(level, "posterior_block"), onto=joined)
            z = p.linear(joined, level["posterior_head.weight"].T[:, :latent], level["posterior_head.bias"][:latent])
            p.layer(z, part(level, "expand"), plus=stream, onto=stream)
            p.block(stream, part(level, "block"), onto=stream)
        p.block(stream, part(weights, "last_block"), onto=stream)
        # the inverse cosine transform of tracks and log-variances, within the last layer
        write = part(weights, "write")
        weight = np.concatenate([half @ dct for half in np.split(write["weight"], 2, axis=1)], axis=1)
        bias = np.concatenate([half @ dct for half in np.split(write["bias"], 2, axis=1)], axis=1)
        bias[:, self.frames :] += np.float32(TRACK_LOG_VAR)
        self._written = p.linear(stream, weight, bias, write["adjacency"])  # tracks, and their log-variances
        self._net = Network(p, max_batch)

    @classmethod
    def load(cls, weights: str, max_batch: int) -> LiveHGVAE:
        """Load the weights of this name; raises like `load_weights`."""
        arrays, config = load_weights(weights, "hgvae")
        return cls(HGVAEConfig.from_dict(config), arrays, max_batch)

    def reconstruct(
        self, x: NDArray[np.float64], observed: NDArray[np.float64], bias_sigma: NDArray[np.float64]
    ) -> Reconstruction:
        """Encode and decode windows `Tracks.x` (B, 66, T) metres of a body of standard size, NaN for a joint never
        observed; ``bias_sigma`` (B,) is the sensor's bias, metres along an axis."""
        rows = slice(0, len(x))
        deviations = (x - self._mean) / SCALE
        hang_unseen(deviations)
        certainty = observed > 0
        if self._completion:
            certainty = self._completion.complete(deviations, observed, bias_sigma)
        seen = self._net.matrix(self._x, rows)
        seen[..., : self.frames], seen[..., self.frames :] = deviations, certainty
        self._net.run(rows)
        written = self._net.matrix(self._written, rows)
        half_log_var = 0.5 * np.clip(written[..., self.frames :], *LOG_VAR_RANGE)
        return Reconstruction(
            mean=written[..., : self.frames] * np.float64(SCALE) + self._mean,
            sigma=np.exp(half_log_var) * np.float64(SCALE),
        )
