"""Layers that live networks share: dense products, activations, a recurrent unit, and pooling over a skeleton's edges.

An edge is the bone that ends in a joint, and it carries that joint's features. The root has a virtual edge.
Neighbourhoods and pooling pairs are derived from the skeleton's graph (HM-VAE, section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Floats32
from steadypose.prior.models.matmul import multiply_packed, packed
from steadypose.prior.models.weights import Arrays

SLOPE = 0.2  # slope of the LeakyReLU for negative values

BLOCKS, NEAR = 4, 2
"""Number of HM-VAE's blocks, and distance within which edges are mixed by a convolution over the skeleton, edges."""


class Dense:
    """A linear layer of ``weight`` (out, in) and ``bias`` (out) or (1), from (N, in) to (N, out)."""

    def __init__(self, weight: Floats32, bias: Floats32) -> None:
        self._weight = packed(weight.T)
        self._bias = np.full((1, len(weight)), bias, dtype=np.float32)

    def __call__(self, x: Floats32) -> Floats32:
        out = np.empty((len(x), self._bias.shape[1]), dtype=np.float32)
        multiply_packed(np.ascontiguousarray(x, dtype=np.float32), self._weight, self._bias, out)
        return out


def leaky_relu(x: Floats32) -> Floats32:
    """LeakyReLU with the slope `SLOPE`."""
    return np.maximum(x, np.float32(SLOPE) * x)


class LiveRecurrent:
    """A trained network of torch's ``GRU``, named ``unit`` in the state dict, and ``Linear``, named ``head``.

    ``hidden`` is the size of a body's hidden state, which is zero before the first frame.
    """

    def __init__(self, weights: Arrays, unit: str) -> None:
        self._input = Dense(weights[f"{unit}.weight_ih_l0"], weights[f"{unit}.bias_ih_l0"])
        self._kept = Dense(weights[f"{unit}.weight_hh_l0"], weights[f"{unit}.bias_hh_l0"])
        self._head = Dense(weights["head.weight"], weights["head.bias"])
        self.hidden = weights["head.weight"].shape[1]

    def __call__(self, features: Floats32, state: Floats32) -> tuple[Floats32, Floats32]:
        """Return the head's outputs (B, O) for one frame's features (B, F), and the next hidden state (B, `hidden`)."""
        reset_in, update_in, new_in = np.split(self._input(features), 3, axis=-1)
        reset_kept, update_kept, new_kept = np.split(self._kept(state), 3, axis=-1)
        new = np.tanh(new_in + sigmoid(reset_in + reset_kept) * new_kept)
        state = new + sigmoid(update_in + update_kept) * (state - new)
        return self._head(state), state


def sigmoid(x: Floats32) -> Floats32:
    """The logistic function."""
    return (1.0 / (1.0 + np.exp(-x))).astype(np.float32)


@dataclass(frozen=True)
class Level:
    """One building block: the neighbours of each edge, and the edges that merge after the block."""

    neighbours: list[list[int]]
    groups: list[list[int]]


def pooling_levels(parents: Sequence[int]) -> list[Level]:
    """Return the levels of an encoder of four blocks. When no chain is left to merge, pooling is the identity.

    Args:
        parents: the edge towards the root from each edge; -1 for the root's own edge.
    """
    levels = []
    for _ in range(BLOCKS):
        levels.append(Level(_neighbours(parents), _groups(parents)))
        group_of = {edge: g for g, group in enumerate(levels[-1].groups) for edge in group}
        towards_root = [parents[group[0]] for group in levels[-1].groups]
        parents = [-1 if parent < 0 else group_of[parent] for parent in towards_root]
    return levels


def _neighbours(parents: Sequence[int]) -> list[list[int]]:
    """Return each edge's edges within `NEAR`, including itself; edges that share a joint are 1 apart."""
    touching = [{o for o, q in enumerate(parents) if o != e and (q in (e, p) or o == p)} for e, p in enumerate(parents)]
    result = []
    for edge in range(len(parents)):
        near = {edge}
        for _ in range(NEAR):
            near |= {o for e in near for o in touching[e]}
        result.append(sorted(near))
    return result


def _groups(parents: Sequence[int]) -> list[list[int]]:
    """Return pairs of edges joined by a joint of degree two, walking each chain from the root's side, and all others.

    In a chain of odd length, the first edge stays alone, as in the official code; so does the virtual root edge.
    """
    children = [[c for c, p in enumerate(parents) if p == e] for e in range(len(parents))]
    groups: list[list[int]] = [[0]]
    for start, parent in enumerate(parents):
        if parent < 0 or (parent != 0 and len(children[parent]) == 1):
            continue
        chain = [start]
        while len(children[chain[-1]]) == 1:
            chain.append(children[chain[-1]][0])
        odd = len(chain) % 2
        groups += [chain[:1]] * odd + [chain[k : k + 2] for k in range(odd, len(chain), 2)]
    return sorted(groups)


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
