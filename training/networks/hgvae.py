"""HG-VAE: a hierarchical graph-convolutional VAE over windows of joint tracks ("Hierarchical Graph-Convolutional
Variational Autoencoding for Generative Modelling of Human Motion", sections 4 and 5, appendix A).

A node is the track of one coordinate of one joint. Its features are the track's cosine transform. Graph convolutions
with learned adjacency mix nodes, reduce their number on the way up and expand it on the way down. The decoder keeps a
deterministic stream of all nodes, to which every stochastic level adds its latent, from the single top node down to one
latent for each track.

There are two additions to the paper. The encoder also reads the certainty of each entry, and the completion network
(`training.networks.graph`) imputes unobserved entries, so that one pass completes a window. The cosine transform may be
truncated to its lowest coefficients, which makes the live model small.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.compiled_graph import LOG_VAR_RANGE
from steadypose.prior.models.hgvae.config import JOINT_NODES, TRACK_LOG_VAR, HGVAEConfig, Level
from steadypose.training.networks.graph import CompletionNet, GraphBlock, GraphLinear, certainty_of

INITIAL_LATENT_GAIN, INITIAL_POSTERIOR_LOG_VAR = 0.25, -4.0
"""Initial factor on a level's contribution to the stream, and initial bias of the posteriors' log-variance."""


def dct_matrix(frames: int) -> Tensor:
    """(T, T) orthonormal cosine transform, equation 7: ``tracks @ dct_matrix(T).T`` are the coefficients.

    Row ``k`` is the k-th frequency, so a constant track has one coefficient. Its transpose is the inverse,
    equation 8.
    """
    k = torch.arange(frames, dtype=torch.float64)[:, None]
    n = torch.arange(frames, dtype=torch.float64)[None]
    matrix = math.sqrt(2 / frames) * torch.cos(math.pi / (2 * frames) * (2 * n + 1) * k)
    matrix[0] /= math.sqrt(2)
    return matrix.float()


class Gaussian(NamedTuple):
    """A diagonal normal distribution."""

    mean: Tensor
    log_var: Tensor

    def sample(self, spread: Tensor | float = 1.0) -> Tensor:
        """Draw a sample by the reparametrisation trick, with ``spread`` times the standard deviation."""
        return self.mean + spread * torch.randn_like(self.mean) * (0.5 * self.log_var).exp()

    def log_density(self, value: Tensor) -> Tensor:
        """Log-density (nats) of every entry of ``value``."""
        return -0.5 * (self.log_var + math.log(2 * math.pi) + (value - self.mean).square() * (-self.log_var).exp())

    def kl(self, other: Gaussian) -> Tensor:
        """KL(self || other), entry by entry."""
        ratio = (self.log_var - other.log_var).exp()
        shift = (self.mean - other.mean).square() * (-other.log_var).exp()
        return 0.5 * (ratio + shift - 1 - self.log_var + other.log_var)


class HGVAEOutput(NamedTuple):
    tracks: Gaussian  # p(x | z), mean and log-variance (B, N, T), in units of `SCALE`
    kl: Tensor  # (B, L) KL(q || p) of each level, top first; 0 if a level is off
    log_prior: Tensor  # (B, L) log p(m | above) at the posterior's means m, the terms of the score of section 7
    top: Tensor  # (B, latent) the top level's posterior mean


class HGVAE(nn.Module):
    """Encoder and decoder of windows (B, N, T): tracks about the training mean, in units of `SCALE`."""

    def __init__(self, config: HGVAEConfig) -> None:
        super().__init__()
        self.config = config
        nodes, features = JOINT_NODES, config.features
        self.register_buffer("dct", dct_matrix(config.frames)[: config.coefficients].clone())
        self.register_buffer("mean", torch.zeros(nodes))
        self.completion = CompletionNet(config.frames, config.completion) if config.completion else None
        self.read = GraphLinear(nodes, nodes, config.coefficients + config.frames, features)
        self.read_block = GraphBlock(nodes, features)
        self.up = nn.ModuleList()  # bottom level first
        self.encoder = nn.ModuleList()
        below = nodes
        for level in reversed(config.levels):
            same = level.nodes == below
            self.up.append(nn.Identity() if same else GraphLinear(below, level.nodes, features, features))
            self.encoder.append(GraphBlock(level.nodes, features))
            below = level.nodes
        self.start = nn.Parameter(torch.zeros(nodes, features))
        self.down = nn.ModuleList(
            DecoderLevel(nodes, features, level, top=k == 0, extra=config.actions if k == 0 else 0)
            for k, level in enumerate(config.levels)
        )
        self.last_block = GraphBlock(nodes, features)
        self.write = GraphLinear(nodes, nodes, features, 2 * config.coefficients)

    dct: Tensor
    mean: Tensor

    @property
    def decoder_levels(self) -> list[DecoderLevel]:
        """The stochastic levels, the top one first."""
        return [cast("DecoderLevel", level) for level in self.down]

    @torch.no_grad()
    def completed(self, x: Tensor, observed: Tensor, bias_sigma: NDArray[np.floating] | float) -> tuple[Tensor, Tensor]:
        """Complete unobserved entries of tracks (B, N, T), which hold the interpolation of `features.to_tracks`;
        returns windows (B, N, T) and the certainty (B, N, T) of each entry. ``bias_sigma`` (B,) is the sensor's bias,
        metres along an axis."""
        if self.completion is None:
            return x, observed
        completed, log_var = self.completion.complete(x, observed, bias_sigma)
        return completed, certainty_of(observed, log_var)

    def forward(
        self, x: Tensor, certainty: Tensor, *, spread: Tensor | None = None, action: Tensor | None = None
    ) -> HGVAEOutput:
        """Encode and decode windows.

        Args:
            x: (B, N, T) tracks, complete.
            certainty: (B, N, T) certainty of each entry, 0 to 1; 1 where observed (see `completion.certainty_of`).
            spread: (B, 1) share of the posterior's standard deviation with which latents are drawn: 1 to draw them, 0
                or None for the means.
            action: (B, actions) one-hot, for a model with actions.
        """
        read = torch.cat([x @ self.dct.T, certainty], dim=-1).transpose(0, 1)
        graph = self.read_block(F.gelu(self.read(read)))
        encoded: list[Tensor] = []
        for up, block in zip(self.up, self.encoder, strict=True):
            graph = block(up(graph))
            encoded.append(graph)
        stream = self.start[:, None].expand(-1, x.shape[0], -1)
        kl, log_prior, top = [], [], None
        off = len(self.down) - (len(self.down) if self.config.stochastic is None else self.config.stochastic)
        for k, (level, seen) in enumerate(zip(self.decoder_levels, reversed(encoded), strict=True)):
            prior = level.prior(stream)
            if k < off:
                stream = level.add(stream, prior.mean, action)
                kl.append(x.new_zeros(x.shape[0]))
                log_prior.append(x.new_zeros(x.shape[0]))
                continue
            posterior = level.posterior(stream, seen)
            kl.append(posterior.kl(prior).sum(dim=(0, 2)))
            log_prior.append(prior.log_density(posterior.mean).sum(dim=(0, 2)))
            if k == 0:
                top = posterior.mean[0]
            stream = level.add(stream, posterior.mean if spread is None else posterior.sample(spread), action)
        tracks = self._decode(stream)
        if top is None:
            top = x.new_zeros(x.shape[0], self.config.levels[0].latent)
        return HGVAEOutput(tracks, torch.stack(kl, dim=1), torch.stack(log_prior, dim=1), top)

    def generate(
        self, count: int, *, random_levels: int | None = None, top: Tensor | None = None, action: Tensor | None = None
    ) -> Gaussian:
        """Decode tracks (count, N, T) from the prior.

        Args:
            count: number of samples.
            random_levels: number of levels, from the top, whose latents are drawn; those below are their prior's means
                (figure 6). None draws all.
            top: (count, latent) the top latent, if given; counts as drawn.
            action: (count, actions) one-hot, for a model with actions.
        """
        stream = self.start[:, None].expand(-1, count, -1)
        for k, level in enumerate(self.decoder_levels):
            prior = level.prior(stream)
            drawn = prior.sample() if random_levels is None or k < random_levels else prior.mean
            stream = level.add(stream, top[None] if k == 0 and top is not None else drawn, action)
        return self._decode(stream)

    def _decode(self, stream: Tensor) -> Gaussian:
        mean, log_var = self.write(self.last_block(stream)).transpose(0, 1).chunk(2, dim=-1)
        return Gaussian(mean @ self.dct, (log_var @ self.dct + TRACK_LOG_VAR).clamp(*LOG_VAR_RANGE))


class DecoderLevel(nn.Module):
    """One stochastic level of the decoder (figure 2)."""

    def __init__(self, nodes: int, features: int, level: Level, *, top: bool, extra: int) -> None:
        super().__init__()
        self.level, self.top, self.extra = level, top, extra
        same = level.nodes == nodes
        self.contract = nn.Identity() if same else GraphLinear(nodes, level.nodes, features, features)
        self.join = nn.Linear(2 * features, features)
        self.posterior_block = GraphBlock(level.nodes, features)
        self.posterior_head = nn.Linear(features, 2 * level.latent)
        if not top:
            self.prior_block = GraphBlock(level.nodes, features)
            self.prior_head = nn.Linear(features, 2 * level.latent)
        self.expand = GraphLinear(level.nodes, nodes, level.latent + extra, features)
        self.block = GraphBlock(nodes, features)
        with torch.no_grad():  # little noise at first: sampled at every level, noise would hide the signal
            self.expand.weight.mul_(INITIAL_LATENT_GAIN)
            self.posterior_head.bias[level.latent :] += INITIAL_POSTERIOR_LOG_VAR

    def prior(self, stream: Tensor) -> Gaussian:
        """p(z | levels above); N(0, I) at the top."""
        if self.top:
            zero = stream.new_zeros(self.level.nodes, stream.shape[1], self.level.latent)
            return Gaussian(zero, zero)
        return _heads(self.prior_head(self.prior_block(self.contract(stream))))

    def posterior(self, stream: Tensor, seen: Tensor) -> Gaussian:
        """q(z | levels above, x)."""
        joined = self.join(torch.cat([self.contract(stream), seen], dim=-1))
        return _heads(self.posterior_head(self.posterior_block(joined)))

    def add(self, stream: Tensor, z: Tensor, action: Tensor | None) -> Tensor:
        """Return the stream with this level's latent added."""
        if self.extra:
            if action is None:
                raise ValueError(f"expected an action, one-hot (B, {self.extra})")
            z = torch.cat([z, action[None]], dim=-1)
        return self.block(stream + self.expand(z))


def _heads(features: Tensor) -> Gaussian:
    mean, log_var = features.chunk(2, dim=-1)
    return Gaussian(mean, log_var.clamp(*LOG_VAR_RANGE))
