"""Graphs whose nodes mix by learned adjacency: the layers of HG-VAE and of the networks beside it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class GraphLinear(nn.Module):
    """``S A W + b``: graphs (n_in, B, f_in) to (n_out, B, f_out), equation 4 without its activation.

    Nodes come first inside the model, so that either product is one of two matrices, however large the batch.
    ``nodes_in == nodes_out`` stands for the same nodes: then S starts near the identity.
    """

    def __init__(self, nodes_in: int, nodes_out: int, features_in: int, features_out: int) -> None:
        super().__init__()
        if nodes_in == nodes_out:
            adjacency = torch.eye(nodes_in) + torch.randn(nodes_in, nodes_in) * 0.3 / math.sqrt(nodes_in)
        else:
            adjacency = torch.randn(nodes_out, nodes_in) / math.sqrt(nodes_in)
        self.adjacency = nn.Parameter(adjacency)
        self.weight = nn.Parameter(torch.randn(features_in, features_out) / math.sqrt(features_in))
        self.bias = nn.Parameter(torch.zeros(nodes_out, features_out))

    def forward(self, graph: Tensor) -> Tensor:
        """(n_in, B, f_in) to (n_out, B, f_out)."""
        if len(self.bias) < len(graph):  # the cheaper order
            return self._mix(graph) @ self.weight + self.bias[:, None]
        return self._mix(graph @ self.weight) + self.bias[:, None]

    def _mix(self, graph: Tensor) -> Tensor:
        return (self.adjacency @ graph.flatten(1)).unflatten(1, graph.shape[1:])


class GraphBlock(nn.Module):
    """Two graph convolutional layers beside a residual connection (equation 5).

    The learned weight, initially 0, multiplies the layers' branch, as in Bachlechner et al. (2020) and the official
    code; the paper's formula puts it on the residual.
    """

    def __init__(self, nodes: int, features: int) -> None:
        super().__init__()
        self.first = GraphLinear(nodes, nodes, features, features)
        self.second = GraphLinear(nodes, nodes, features, features)
        self.alpha = nn.Parameter(torch.zeros(()))

    def forward(self, graph: Tensor) -> Tensor:
        """(n, B, f) to (n, B, f)."""
        return graph + self.alpha * F.gelu(self.second(F.gelu(self.first(graph))))
