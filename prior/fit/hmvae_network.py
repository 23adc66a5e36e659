"""HM-VAE: a hierarchical motion VAE over windows of local rotations (Li et al., "Task-Generic Hierarchical Human
Motion Prior using VAEs", 3DV 2021), sections 3.1 and 3.2, and its layers over the edges of a skeleton.

Four building blocks (skeleton convolution, pooling, LeakyReLU) encode a window. The features after the first block give
the local latent z_l, those after the last block the global latent z_g, one for every edge at that level. The decoder
mirrors the encoder and receives z_l before its last block. Layers, kernels and strides follow the official code for
windows of 8 (and 64) frames; the pooling is derived from our 22-joint graph. Features are (B, E * C, T): all channels
of the first edge, then of the second, and so on, over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, to_6d
from steadypose.prior.models.hmvae import CHANNELS, DEVIATION, NO_ROTATION, ROTATION_FEATURES, HMVAEConfig
from steadypose.prior.models.layers import SLOPE, pool_matrix, pooling_levels, unpool_matrix


class SkeletonConv(nn.Module):
    """Temporal convolution over an edge's neighbours: a dense convolution with a mask.

    The paper's equation averages over the neighbours. Like the official code, this sums, as the scale is learned.

    Args:
        in_channels: input channels per edge.
        out_channels: output channels per edge.
        neighbours: for each edge, the edges that it reads.
        kernel: odd number of time steps.
        stride: step in time.
        bias: whether to add one.
    """

    mask: Tensor

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        neighbours: Sequence[Sequence[int]],
        kernel: int,
        stride: int = 1,
        bias: bool = True,
    ) -> None:
        super().__init__()
        edges = len(neighbours)
        self.stride, self.pad = stride, (kernel - 1) // 2
        sees = torch.zeros(edges, edges)
        for edge, near in enumerate(neighbours):
            sees[edge, list(near)] = 1.0
        mask = sees.repeat_interleave(out_channels, 0).repeat_interleave(in_channels, 1)[..., None]
        self.register_buffer("mask", mask, persistent=False)
        fan_in = mask.sum(dim=1, keepdim=True) * kernel
        weight = torch.randn(edges * out_channels, edges * in_channels, kernel) * torch.sqrt(2.0 / fan_in)
        self.weight = nn.Parameter(weight * mask)
        self.bias = nn.Parameter(torch.zeros(edges * out_channels)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        """(B, E * in, T) to (B, E * out, ceil(T / stride))."""
        # Masked weights start at zero and the mask stops their gradient, so they stay zero. In evaluation, the product
        # is not needed.
        weight = self.weight * self.mask if self.training else self.weight
        x = F.pad(x, (self.pad, self.pad), mode="reflect")
        # One product over unfolded windows takes half the time of torch's convolution on a CPU at these lengths.
        windows = x.unfold(2, weight.shape[2], self.stride).transpose(1, 2).flatten(2)
        return F.linear(windows, weight.flatten(1), self.bias).transpose(1, 2)


class _EdgeMix(nn.Module):
    """A fixed linear map between edges, equal for all channels."""

    mix: Tensor

    def __init__(self, mix: Tensor) -> None:
        super().__init__()
        self.register_buffer("mix", mix, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        batch, features, time = x.shape
        channels = features // self.mix.shape[1]
        mixed = self.mix @ x.reshape(batch, self.mix.shape[1], channels * time)
        return mixed.reshape(batch, self.mix.shape[0] * channels, time)


class SkeletonPool(_EdgeMix):
    """Mean over each group of edges: (B, E * C, T) to (B, len(groups) * C, T)."""

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        super().__init__(torch.from_numpy(pool_matrix(groups)))


class SkeletonUnpool(_EdgeMix):
    """Copy of each merged edge to its original edges: (B, len(groups) * C, T) to (B, E * C, T)."""

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        super().__init__(torch.from_numpy(unpool_matrix(groups)))


class EdgeLinear(nn.Module):
    """A linear map from an edge's flattened (C, T) features to ``out`` values, shared by all edges."""

    def __init__(self, channels: int, time: int, out: int) -> None:
        super().__init__()
        self.channels, self.time = channels, time
        self.linear = nn.Linear(channels * time, out)
        nn.init.normal_(self.linear.weight, std=1.0 / math.sqrt(channels * time))
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, E * C, T) to (B, E, out)."""
        return self.linear(x.reshape(x.shape[0], -1, self.channels * self.time))


class Posterior(NamedTuple):
    """q(z_l, z_g | x), equation 4: means and log-variances, each (B, edges at its level, latent)."""

    local_mean: Tensor
    local_log_var: Tensor
    global_mean: Tensor
    global_log_var: Tensor

    def sample(self) -> tuple[Tensor, Tensor]:
        """z_l and z_g by the reparametrisation trick."""
        local = self.local_mean + torch.randn_like(self.local_mean) * (0.5 * self.local_log_var).exp()
        deep = self.global_mean + torch.randn_like(self.global_mean) * (0.5 * self.global_log_var).exp()
        return local, deep

    def kl(self) -> tuple[Tensor, Tensor]:
        """KL to N(0, I) of z_l and of z_g, summed over latent dimensions, mean over batch and edges.

        The reduction belongs to the weight 0.003 of the official code: change both or neither.
        """
        return _kl(self.local_mean, self.local_log_var), _kl(self.global_mean, self.global_log_var)


def _kl(mean: Tensor, log_var: Tensor) -> Tensor:
    return (0.5 * (mean.square() + log_var.exp() - 1.0 - log_var).sum(dim=-1)).mean()


class HMVAE(nn.Module):
    """A VAE of windows (B, T, 22, 6) of local 6D rotations (the root's is its orientation), T = ``window``."""

    def __init__(self, config: HMVAEConfig) -> None:
        super().__init__()
        self.config, self.window = config, config.window
        self.levels = pooling_levels(PARENTS)
        steps = self.steps = config.steps
        c = CHANNELS
        seen = (config.features, *c[1:])
        self.encoder = nn.ModuleList(
            nn.ModuleList(
                [
                    SkeletonConv(seen[k], c[k + 1], level.neighbours, config.kernel, config.strides[k]),
                    SkeletonPool(level.groups),
                ]
            )
            for k, level in enumerate(self.levels)
        )
        self.to_local = EdgeLinear(c[1], steps[1], 2 * config.local_latent)
        self.to_global = EdgeLinear(c[4], steps[4], 2 * config.global_latent)
        self.from_local = nn.Linear(config.local_latent, c[1] * steps[1])
        self.from_global = nn.Linear(config.global_latent, c[4] * steps[4])
        self.decoder = nn.ModuleList(
            nn.ModuleList(
                [
                    SkeletonUnpool(level.groups),
                    SkeletonConv(
                        c[k + 1] * (2 if k == 0 else 1), c[k], level.neighbours, config.kernel, bias=k in (0, 3)
                    ),
                ]
            )
            for k, level in reversed(list(enumerate(self.levels)))
        )

    def reconstruct(self, x: Tensor) -> Tensor:
        """Decode the posterior's mean: what refinement does with each window (equations 10 and 11)."""
        posterior = self.encode(x)
        return self.placed(self.decode(posterior.local_mean, posterior.global_mean), x)

    def placed(self, decoded: Tensor, x: Tensor) -> Tensor:
        """Convert `decode`'s output to windows (B, T, 22, 6): with ``about_mean``, deviations from the mean of x."""
        if not self.config.about_mean:
            return decoded
        return _columns(decoded * DEVIATION + decoded.new_tensor(NO_ROTATION), _mean_pose(x).mT)

    def _seen(self, x: Tensor) -> Tensor:
        """(B, T, 22, features) the encoder's input from windows x."""
        if not self.config.about_mean:
            return x
        mean = _mean_pose(x)
        deviation = (_columns(x, mean) - x.new_tensor(NO_ROTATION)) / DEVIATION
        return torch.cat([deviation, to_6d(mean).expand_as(x)], dim=-1)

    def encode(self, x: Tensor) -> Posterior:
        """The posterior of windows x (B, T, 22, 6), equations 2 and 4."""
        features = self._seen(x).flatten(2).transpose(1, 2)
        local = features
        for k, block in enumerate(self.encoder):
            conv, pool = block  # type: ignore[misc]  (a ModuleList of two)
            features = F.leaky_relu(pool(conv(features)), SLOPE)
            if k == 0:
                local = features
        return Posterior(*self.to_local(local).chunk(2, dim=-1), *self.to_global(features).chunk(2, dim=-1))

    def decode(self, local: Tensor, deep: Tensor) -> Tensor:
        """Decode z_l (B, E1, d) and z_g (B, E4, d) to (B, T, 22, 6), the input of `placed`."""
        features = self.from_global(deep).reshape(deep.shape[0], -1, self.steps[4])
        local_features = self.from_local(local).reshape(local.shape[0], -1, self.steps[1])
        for k, block in zip(reversed(range(4)), self.decoder, strict=True):
            unpool, conv = block  # type: ignore[misc]
            if k == 0:
                features = _join_edges(features, local_features, CHANNELS[1])
            if self.config.strides[k] > 1:
                features = F.interpolate(features, scale_factor=self.config.strides[k], mode="linear")
            features = conv(unpool(features))
            if k > 0:
                features = F.leaky_relu(features, SLOPE)
        return features.transpose(1, 2).reshape(features.shape[0], self.config.window, -1, ROTATION_FEATURES)


def _mean_pose(x: Tensor) -> Tensor:
    """(B, 1, 22, 3, 3) local rotations: the mean pose of windows x (B, T, 22, 6).

    It is the mean of the bones' orientations in space. A straight leg does not show the thigh's twist, whose error the
    knee's rotation compensates in each frame. The mean of the knee's local rotations would not compensate it.
    """
    rotations = from_6d(x)
    _, orientations = forward_kinematics(rotations, rotations.new_zeros(1, 3).expand(len(PARENTS), 3))
    mean = from_6d(to_6d(orientations).mean(dim=1, keepdim=True))
    return torch.cat([mean[:, :, :1], mean[:, :, list(PARENTS[1:])].mT @ mean[:, :, 1:]], dim=2)


def _columns(x: Tensor, frame: Tensor) -> Tensor:
    """The two columns in x (..., 6), which are vectors, in these frames (..., 3, 3)."""
    return (x.unflatten(-1, (2, 3)) @ frame).flatten(-2)


def _join_edges(a: Tensor, b: Tensor, channels: int) -> Tensor:
    """Concatenate the channels of each edge of two (B, E * channels, T) features."""
    batch, features, time = a.shape
    joined = torch.cat(
        [
            a.reshape(batch, features // channels, channels, time),
            b.reshape(batch, features // channels, channels, time),
        ],
        dim=2,
    )
    return joined.reshape(batch, 2 * features, time)
