"""Layers that live networks share: dense products, activations, and pooling over the edges of a skeleton.

An edge is the bone that ends in a joint, and it carries that joint's features. The root has a virtual edge.
Neighbourhoods and pooling pairs are derived from the skeleton's graph (HM-VAE, section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Floats32
from steadypose.prior.compiled import njit

FEW_ROWS = 2
"""Largest number of rows for which products without BLAS take half the time; BLAS copies the weights first."""

SLOPE = 0.2
"""Slope of the LeakyReLU for negative values."""


def dense(x: Floats32, weight: Floats32, bias: Floats32) -> Floats32:
    """``x @ weight.T + bias``: (N, in) to (N, out)."""
    if len(x) > FEW_ROWS:
        return np.ascontiguousarray((weight @ x.T).T) + bias
    out = np.empty((len(x), len(weight)), dtype=np.float32)
    _few_rows(np.ascontiguousarray(x), weight, out)
    return out + bias


@njit("(f4[:,::1], f4[:,::1], f4[:,::1])", cache=True, fastmath=True)
def _few_rows(x, weight, out):
    """Write ``x @ weight.T``: (N, in) and (M, in) to (N, M)."""
    for j in range(len(weight)):
        for i in range(len(x)):
            total = np.float32(0)
            for k in range(x.shape[1]):
                total += x[i, k] * weight[j, k]
            out[i, j] = total


def leaky_relu(x: Floats32) -> Floats32:
    """LeakyReLU with the slope `SLOPE`."""
    return np.maximum(x, np.float32(SLOPE) * x)


@dataclass(frozen=True)
class EdgeGraph:
    """The edges of a skeleton as a tree. ``parents[e]`` is the edge towards the root, -1 for the root's own edge."""

    parents: tuple[int, ...]

    def neighbours(self, distance: int = 2) -> list[list[int]]:
        """Return each edge's edges within ``distance``, including itself; edges that share a joint are 1 apart."""
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

        In a chain of odd length, the first edge is not merged, as in the official code. The virtual root edge is never
        merged.

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


@dataclass(frozen=True)
class Level:
    """The graph of one building block: the neighbours of each edge, and the edges that merge after the block."""

    graph: EdgeGraph
    neighbours: list[list[int]]
    groups: list[list[int]]

    @property
    def edges(self) -> int:
        return len(self.neighbours)


def pooling_levels(parents: Sequence[int], blocks: int = 4, distance: int = 2) -> list[Level]:
    """Return the levels of an encoder of ``blocks`` blocks. When no chain is left to merge, pooling is the identity."""
    graph = EdgeGraph(tuple(parents))
    levels = []
    for _ in range(blocks):
        pooled, groups = graph.pool()
        levels.append(Level(graph, graph.neighbours(distance), groups))
        graph = pooled
    return levels


def pool_matrix(groups: Sequence[Sequence[int]]) -> Floats32:
    """(len(groups), E) matrix of the mean over each group of edges."""
    member = unpool_matrix(groups).T
    return np.ascontiguousarray(member / member.sum(axis=1, keepdims=True))


def unpool_matrix(groups: Sequence[Sequence[int]]) -> Floats32:
    """(E, len(groups)) matrix that copies each merged edge to its original edges."""
    member = np.zeros((1 + max(max(g) for g in groups), len(groups)), dtype=np.float32)
    for k, group in enumerate(groups):
        member[list(group), k] = 1.0
    return member


def mix_edges(mix: Floats32, features: Floats32) -> Floats32:
    """Mix all channels of edges (E * C, ...) by a matrix (E', E), to (E' * C, ...)."""
    return (mix @ features.reshape(mix.shape[1], -1)).reshape(-1, *features.shape[1:])
