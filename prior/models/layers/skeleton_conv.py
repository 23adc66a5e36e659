"""Skeleton-aware layers: convolution, pooling and unpooling over the edges of a skeleton (HM-VAE, section 3.1).

An edge is the bone that ends in a joint and carries that joint's features; the root has a virtual edge of its own.
Neighbourhoods and pooling pairs are derived from the skeleton's graph. Features are (B, E * C, T): all channels of
the first edge, then of the second, and so on, over time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class EdgeGraph:
    """The edges of a skeleton as a tree: ``parents[e]`` is the edge towards the root, -1 for the root's own."""

    parents: tuple[int, ...]

    def neighbours(self, distance: int = 2) -> list[list[int]]:
        """For each edge the edges within ``distance``, itself among them; edges that share a joint are 1 apart."""
        touching = [
            {o for o, q in enumerate(self.parents) if o != e and (q in (e, p) or o == p)}
            for e, p in enumerate(self.parents)
        ]
        result = []
        for edge in range(len(self.parents)):
            near = {edge}
            for _ in range(distance):
                near |= {o for e in near for o in touching[e]}
            result.append(sorted(near))
        return result

    def pool(self) -> tuple[EdgeGraph, list[list[int]]]:
        """Merge pairs of edges joined by a joint of degree two, walking each chain from the root's side.

        A chain of odd length leaves its first edge alone, as the official code does; the virtual root edge is
        never merged.

        Returns:
            The pooled graph, and for each of its edges the edges that it merges.
        """
        children = [[c for c, p in enumerate(self.parents) if p == e] for e in range(len(self.parents))]
        groups: list[list[int]] = [[0]]
        for start, parent in enumerate(self.parents):
            if parent < 0 or (parent != 0 and len(children[parent]) == 1):
                continue
            chain = [start]
            while len(children[chain[-1]]) == 1:
                chain.append(children[chain[-1]][0])
            odd = len(chain) % 2
            groups += [chain[:1]] * odd + [chain[k : k + 2] for k in range(odd, len(chain), 2)]
        groups.sort()
        group_of = {edge: g for g, group in enumerate(groups) for edge in group}
        parents = tuple(-1 if self.parents[g[0]] < 0 else group_of[self.parents[g[0]]] for g in groups)
        return EdgeGraph(parents), groups


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
        super().__init__(_membership(groups) / torch.tensor([len(g) for g in groups])[:, None])


class SkeletonUnpool(_EdgeMix):
    """Each merged edge copied to the edges it came from: (B, len(groups) * C, T) to (B, E * C, T)."""

    def __init__(self, groups: Sequence[Sequence[int]]) -> None:
        super().__init__(_membership(groups).T.contiguous())


def _membership(groups: Sequence[Sequence[int]]) -> Tensor:
    member = torch.zeros(len(groups), 1 + max(max(g) for g in groups))
    for k, group in enumerate(groups):
        member[k, list(group)] = 1.0
    return member


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


@dataclass(frozen=True)
class Level:
    """One building block's place on the skeleton: who sees whom, and which edges merge after it."""

    graph: EdgeGraph
    neighbours: list[list[int]]
    groups: list[list[int]]

    @property
    def edges(self) -> int:
        return len(self.neighbours)


def pooling_levels(parents: Sequence[int], blocks: int = 4, distance: int = 2) -> list[Level]:
    """The levels of an encoder of ``blocks`` blocks; once no chain is left to merge, pooling is the identity."""
    graph = EdgeGraph(tuple(parents))
    levels = []
    for _ in range(blocks):
        pooled, groups = graph.pool()
        levels.append(Level(graph, graph.neighbours(distance), groups))
        graph = pooled
    return levels
