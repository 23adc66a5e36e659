"""Skeleton-aware layers: convolution, pooling and unpooling over the edges of a skeleton (HM-VAE, section 3.1).

Features are (B, E * C, T): all channels of the first edge, then of the second, and so on, over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.layers.edge_graph import pool_matrix, unpool_matrix


class SkeletonConv(nn.Module):
    """Temporal convolution in which an edge sees only its neighbours: a dense convolution under a mask.

    The paper's equation averages over the neighbours; like the official code this sums, the scale being learned.

    Args:
        in_channels: channels an edge coming in.
        out_channels: channels an edge going out.
        neighbours: for each edge the edges that it sees.
        kernel: odd number of time steps.
        stride: step in time.
        padding: "reflect" is centred (HM-VAE); "causal" repeats the first frame and sees no future.
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
        padding: Literal["reflect", "causal"] = "reflect",
        bias: bool = True,
    ) -> None:
        super().__init__()
        edges = len(neighbours)
        self.stride, self.padding = stride, padding
        self.pad = (kernel - 1, 0) if padding == "causal" else ((kernel - 1) // 2, (kernel - 1) // 2)
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
        # Masked weights start at zero and the mask stops their gradient, so they stay zero: once trained, the
        # live path need not multiply.
        weight = self.weight * self.mask if self.training else self.weight
        x = F.pad(x, self.pad, mode="replicate" if self.padding == "causal" else "reflect")
        # One product over unfolded windows: at these lengths half the time of torch's convolution on a CPU.
        windows = x.unfold(2, weight.shape[2], self.stride).transpose(1, 2).flatten(2)
        return F.linear(windows, weight.flatten(1), self.bias).transpose(1, 2)


class _EdgeMix(nn.Module):
    """A fixed linear map between edges, the same for every channel."""

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
    """Each merged edge copied to the edges it came from: (B, len(groups) * C, T) to (B, E * C, T)."""

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        super().__init__(torch.from_numpy(unpool_matrix(groups)))


class EdgeLinear(nn.Module):
    """One linear map from an edge's (C, T) features, flattened, to ``out`` values: shared by all edges."""

    def __init__(self, channels: int, time: int, out: int) -> None:
        super().__init__()
        self.channels, self.time = channels, time
        self.linear = nn.Linear(channels * time, out)
        nn.init.normal_(self.linear.weight, std=1.0 / math.sqrt(channels * time))
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, E * C, T) to (B, E, out)."""
        return self.linear(x.reshape(x.shape[0], -1, self.channels * self.time))
