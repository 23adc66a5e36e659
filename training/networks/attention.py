"""The attention layer of the completer and of HG-VAE's completion network."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class AttentionLayer(nn.Module):
    """Pre-norm multi-head attention between nodes, and a feed-forward network, each with a residual connection.

    Args:
        width: number of features of a node.
        heads: number of attention heads.
        widened: width of the feed-forward network.
        reach: distance up to which scores have learned biases of relative position; None for none.
        approximate: approximation of the GELU, as torch names it.
        dropout: share of the branches' outputs that training drops.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        widened: int,
        *,
        reach: int | None = None,
        approximate: str = "none",
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.heads, self.approximate, self.dropout = heads, approximate, nn.Dropout(dropout)
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attend = nn.Linear(width, 3 * width)
        self.join = nn.Linear(width, width)
        self.bias = None if reach is None else nn.Parameter(torch.zeros(heads, 2 * reach + 1))
        self.widen = nn.Linear(width, widened)
        self.narrow = nn.Linear(widened, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, n, width) to the same."""
        query, key, value = self.attend(self.norm1(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        scores = query @ key.mT / math.sqrt(query.shape[-1])
        if self.bias is not None:
            at, reach = torch.arange(x.shape[1]), self.bias.shape[1] // 2
            scores = scores + self.bias[:, (at[None] - at[:, None]).clamp(-reach, reach) + reach]
        x = x + self.dropout(self.join((scores.softmax(dim=-1) @ value).transpose(1, 2).flatten(2)))
        return x + self.dropout(self.narrow(F.gelu(self.widen(self.norm2(x)), approximate=self.approximate)))
