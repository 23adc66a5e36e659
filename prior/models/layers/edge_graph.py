"""The edges of a skeleton as a graph: their neighbourhoods, and which merge in pooling (HM-VAE, section 3.1).

An edge is the bone that ends in a joint and carries that joint's features; the root has a virtual edge of its own.
Neighbourhoods and pooling pairs are derived from the skeleton's graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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


def pool_matrix(groups: Sequence[Sequence[int]]) -> NDArray[np.float32]:
    """(len(groups), E): the mean over each group of edges."""
    member = unpool_matrix(groups).T
    return np.ascontiguousarray(member / member.sum(axis=1, keepdims=True))


def unpool_matrix(groups: Sequence[Sequence[int]]) -> NDArray[np.float32]:
    """(E, len(groups)): each merged edge copied to the edges it came from."""
    member = np.zeros((1 + max(max(g) for g in groups), len(groups)), dtype=np.float32)
    for k, group in enumerate(groups):
        member[list(group), k] = 1.0
    return member


def mix_edges(mix: NDArray[np.float32], features: NDArray[np.float32]) -> NDArray[np.float32]:
    """All channels of edges (E * C, ...) mixed by (E', E): (E' * C, ...)."""
    return (mix @ features.reshape(mix.shape[1], -1)).reshape(-1, *features.shape[1:])
