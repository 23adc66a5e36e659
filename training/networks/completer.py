"""The completer: a transformer that corrects slerp and lerp between what is known of a motion.

One encoder over the frames of a window, hidden and known alike, as the transformers for in-betweening have it (Duan et
al. 2022; Qin et al. 2022, "Motion In-betweening via Two-stage Transformers"), whose answer is added to an interpolation
(Oreshkin et al. 2023, "Motion In-betweening via Deep Delta-Interpolator"). Theirs know whole frames or nothing; here
any joint may be known in any frame, and the network gates cubics, which theirs do without.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.completer.config import BENDS, FEATURES, OUTPUTS, CompleterConfig


class Completer(nn.Module):
    """Correction of the line, before it is anchored (`features.anchored`), and gates of the bend."""

    def __init__(self, config: CompleterConfig) -> None:
        super().__init__()
        self.config = config
        self.read = nn.Linear(FEATURES, config.width)
        self.layers = nn.ModuleList(_Layer(config) for _ in range(config.layers))
        self.norm = nn.LayerNorm(config.width)
        self.write = nn.Linear(config.width, OUTPUTS)
        # (22, 4) quaternions, xyzw, local, of the mean pose
        self.register_buffer("usual", torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(22, 1))
        self.usual: Tensor
        with torch.no_grad():
            self.write.weight.mul_(0.05)  # begins near the line
            self.write.bias.zero_()
            self.write.bias[BENDS:] = 1.0

    def forward(self, features: Tensor) -> Tensor:
        """(B, T, OUTPUTS) of features (B, T, FEATURES)."""
        frames, reach = features.shape[1], self.config.reach
        at = torch.arange(frames)
        apart = (at[None] - at[:, None]).clamp(-reach, reach) + reach
        x = self.read(features)
        for layer in self.layers:
            x = layer(x, apart)
        return self.write(self.norm(x))


class _Layer(nn.Module):
    """Pre-norm attention with biases of relative position, and a feed-forward network."""

    def __init__(self, config: CompleterConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm1, self.norm2 = nn.LayerNorm(config.width), nn.LayerNorm(config.width)
        self.attend = nn.Linear(config.width, 3 * config.width)
        self.join = nn.Linear(config.width, config.width)
        self.bias = nn.Parameter(torch.zeros(config.heads, 2 * config.reach + 1))
        self.widen = nn.Linear(config.width, 4 * config.width)
        self.narrow = nn.Linear(4 * config.width, config.width)

    def forward(self, x: Tensor, apart: Tensor) -> Tensor:
        query, key, value = self.attend(self.norm1(x)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        scores = query @ key.mT / math.sqrt(query.shape[-1]) + self.bias[:, apart]
        x = x + self.join((scores.softmax(dim=-1) @ value).transpose(1, 2).flatten(2))
        return x + self.narrow(F.gelu(self.widen(self.norm2(x)), approximate="tanh"))
