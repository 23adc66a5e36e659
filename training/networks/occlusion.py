"""The network that weighs the candidates for an occluded joint's position, and states a standard deviation.

Stacked generalisation (Wolpert 1992): the weights of several models are learned from their errors where they have to
answer. A convex combination of the candidates is never farther off than the worst of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from steadypose.prior.models.occlusion.candidates import CANDIDATES, FEATURES
from steadypose.prior.models.occlusion.form import MAX_LOG_SIGMA, MIN_LOG_SIGMA

JOINTS = 22

FIRST_LOG_SIGMA = 4.0
"""Initial logarithm of the standard deviation in millimetres."""


@dataclass(frozen=True)
class OcclusionConfig:
    """Sizes.

    Attributes:
        hidden: of each layer.
    """

    hidden: int = 96

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> OcclusionConfig:
        """From the JSON of a weights file."""
        return cls(**config)


class OcclusionNet(nn.Module):
    """Two hidden layers; the bias of the first is the joint's."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, config: OcclusionConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.joint = nn.Parameter(torch.zeros(JOINTS, config.hidden))
        self.read = nn.Linear(FEATURES, config.hidden)
        self.think = nn.Linear(config.hidden, config.hidden)
        self.write = nn.Linear(config.hidden, CANDIDATES + 1)
        nn.init.constant_(self.write.bias[CANDIDATES:], FIRST_LOG_SIGMA)

    def forward(self, features: Tensor, joint: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (N, 4) of the candidates, and the logarithm (N,) of the standard deviation along an axis in
        millimetres, of features (N, `FEATURES`) of joints (N,)."""
        read = torch.relu(self.read((features - self.mean) / self.deviation) + self.joint[joint])
        written = self.write(torch.relu(self.think(read)) + read)
        return written[:, :CANDIDATES].softmax(dim=-1), written[:, CANDIDATES].clamp(MIN_LOG_SIGMA, MAX_LOG_SIGMA)
