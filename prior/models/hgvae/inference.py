"""HG-VAE as the live node runs it, without torch: `HGVAE` at the means of its latents, forward for the windows of all
bodies, and the gradient of one window's score with respect to its latents.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, TRACK_LOG_VAR, HGVAEConfig
from steadypose.prior.models.hgvae.features import hang_unseen
from steadypose.prior.models.hgvae.live_completion import LiveCompletion
from steadypose.prior.models.layers.compiled_graph import LOG_VAR_RANGE, Floats, Network, Program
from steadypose.prior.models.weights import Arrays, load_weights, part


class Reconstruction(NamedTuple):
    """p(x | z) of windows.

    Attributes:
        mean: (..., 66, T) metres of a body of standard size, tracks.
        sigma: (..., 66, T) metres, standard deviation.
    """

    mean: NDArray[np.float64]
    sigma: NDArray[np.float64]


class LiveHGVAE:
    """A trained `HGVAE` at the means of its latents, to which offsets may be added.

    Args:
        config: its sizes; without actions.
        weights: its state dict, which is copied.
        sensor_sigma: metres along an axis, standard deviation of an observation in the score's likelihood.
        max_batch: windows at once.

    Attributes:
        frames: T, of a window.
        latents: n, total dimension of a window's latents.
        scratch_row: the row that holds the window last decoded by `decode`.
    """

    def __init__(self, config: HGVAEConfig, weights: Arrays, sensor_sigma: float, max_batch: int) -> None:
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
        encoder_steps, encoder_matrices = len(p.steps), len(p.shapes)
        nothing, one = np.zeros((1, features), dtype=np.float32), np.zeros((JOINT_NODES, 1), dtype=np.float32)
        stream = p.linear(p.matrix(1, 1), nothing, weights["start"], one)
        self._moves, self._terms = [], []
        for k, (level, encoded) in enumerate(zip(levels, reversed(seen), strict=True)):
            nodes, latent = config.levels[k]
            above = p.layer(stream, part(level, "contract"))
            joined = p.linear(above, level["join.weight"].T[:features], nothing, plus=encoded)
            p.block(joined, part(level, "posterior_block"), onto=joined)
            mean = p.linear(joined, level["posterior_head.weight"].T[:, :latent], level["posterior_head.bias"][:latent])
            if k == 0:
                prior = p.matrix(nodes, 2 * latent)
            else:
                before = p.block(above, part(level, "prior_block"), onto=p.matrix(nodes, features))
                prior = p.linear(before, level["prior_head.weight"].T, level["prior_head.bias"])
            self._moves.append(p.matrix(nodes, latent))
            z = p.sum(mean, self._moves[-1])
            self._terms.append(p.density(z, prior))
            p.layer(z, part(level, "expand"), plus=stream, onto=stream)
            p.block(stream, part(level, "block"), onto=stream)
        p.block(stream, part(weights, "last_block"), onto=stream)
        # the inverse cosine transform of tracks and log-variances, within the last layer
        write = part(weights, "write")
        weight = np.concatenate([half @ dct for half in np.split(write["weight"], 2, axis=1)], axis=1)
        bias = np.concatenate([half @ dct for half in np.split(write["bias"], 2, axis=1)], axis=1)
        bias[:, self.frames :] += np.float32(TRACK_LOG_VAR)
        self._written = p.linear(stream, weight, bias, write["adjacency"])  # tracks, and their log-variances
        self._net = Network(p, max_batch + 1)
        self.scratch_row, self._encoded = max_batch, self._net.places[encoder_matrices][0]
        self._encoder, self._decoder = self._net.steps[:encoder_steps], self._net.steps[encoder_steps:]
        self._sensor_variance = np.float32((sensor_sigma / SCALE) ** 2)
        self._confidence = np.zeros((max_batch + 1, JOINT_NODES, config.frames), dtype=np.float32)
        self._term_places = [self._net.places[number][0] for number in self._terms]
        self.latents = sum(end - begin for begin, end, _ in (self._net.places[number] for number in self._moves))

    @classmethod
    def load(cls, weights: str, sensor_sigma: float, max_batch: int) -> LiveHGVAE:
        """From the weights of this name.

        Raises:
            FileNotFoundError: there are none; says which there are.
        """
        arrays, config = load_weights(weights, "hgvae")
        return cls(HGVAEConfig.from_dict(config), arrays, sensor_sigma, max_batch)

    def reconstruct(
        self, x: NDArray[np.float64], confidence: NDArray[np.float64], bias_sigma: NDArray[np.float64]
    ) -> Reconstruction:
        """Encode and decode windows. Their activations stay, by row, for `decode`, `score` and `gradient`.

        Args:
            x: (B, 66, T) metres of a body of standard size, `Tracks.x`; NaN for a joint never seen.
            confidence: (B, 66, T) of each observation, 0 to 1, its weight in the score's likelihood; 0 where there is
                none.
            bias_sigma: (B,) metres along an axis, the sensor's slow error.
        """
        rows = slice(0, len(x))
        deviations = (x - self._mean) / SCALE
        hang_unseen(deviations)
        certainty = confidence > 0
        if self._completion:
            certainty = self._completion.complete(deviations, confidence, bias_sigma)
        seen = self._net.matrix(self._x, rows)
        seen[..., : self.frames], seen[..., self.frames :] = deviations, certainty
        self._confidence[rows] = confidence
        for number in self._moves:
            self._net.matrix(number, rows)[:] = 0.0
        self._net.run(self._encoder, rows)
        return self._decode(rows)

    def decode(self, row: int, moved: NDArray[np.float64]) -> Reconstruction:
        """Decode the window of a row with offsets ``moved`` (n,) added to its latents' means, into `scratch_row`."""
        rows, begin = slice(self.scratch_row, self.scratch_row + 1), 0
        self._net.values[rows, : self._encoded] = self._net.values[row, : self._encoded]
        self._confidence[rows] = self._confidence[row]
        for number in self._moves:
            matrix = self._net.matrix(number, rows)
            matrix[:] = moved[begin : begin + matrix.size].reshape(matrix.shape)
            begin += matrix.size
        return Reconstruction(*(part[0] for part in self._decode(rows)))

    def score(self, row: int) -> float:
        """Nats, of a window as last decoded: the score of section 7, the sum over all levels of log p(z | above), plus
        log p(x | z) of its observations, weighted by confidence."""
        off, log_var = self._off_and_log_var(row)
        variance = np.exp(np.clip(log_var, *LOG_VAR_RANGE)) + self._sensor_variance
        likelihood = -0.5 * self._confidence[row] * (np.log(2 * np.pi * variance) + off * off / variance)
        return float(likelihood.sum(dtype=np.float64)) + sum(float(self._net.values[row, k]) for k in self._term_places)

    def gradient(self, row: int) -> NDArray[np.float64]:
        """(n,) gradient of a window's score, as last decoded, with respect to the latents' offsets."""
        self._net.gradients[:] = 0.0
        self._net.gradients[self._term_places] = 1.0
        off, log_var = self._off_and_log_var(row)
        own = np.exp(np.clip(log_var, *LOG_VAR_RANGE))
        variance = own + self._sensor_variance
        off /= variance
        inside = (log_var > LOG_VAR_RANGE[0]) & (log_var < LOG_VAR_RANGE[1])
        by_written = self._net.gradient(self._written)
        by_written[:, : self.frames] = self._confidence[row] * off
        by_written[:, self.frames :] = 0.5 * self._confidence[row] * inside * own * (off * off - 1 / variance)
        self._net.run_back(self._decoder, row)
        return np.concatenate([self._net.gradient(number).ravel() for number in self._moves]).astype(np.float64)

    def _off_and_log_var(self, row: int) -> tuple[Floats, Floats]:
        """Residual of a window's tracks against the reconstruction, in units of `SCALE`, and its log-variance, not
        clamped, both (66, T)."""
        rows = slice(row, row + 1)
        written = self._net.matrix(self._written, rows)[0]
        off = self._net.matrix(self._x, rows)[0, :, : self.frames] - written[:, : self.frames]
        return off, written[:, self.frames :]

    def _decode(self, rows: slice) -> Reconstruction:
        self._net.run(self._decoder, rows)
        written = self._net.matrix(self._written, rows)
        half_log_var = 0.5 * np.clip(written[..., self.frames :], *LOG_VAR_RANGE)
        return Reconstruction(
            mean=written[..., : self.frames] * np.float64(SCALE) + self._mean,
            sigma=np.exp(half_log_var) * np.float64(SCALE),
        )
