"""Which joints of a window are not where they were seen: a small graph network beside HG-VAE.

How unlikely a window is under a generative model tells noise from motion, but not a hand that stands still from one
that rests, and it takes a dance for a fault. The best test between two hypotheses is the ratio of their likelihoods
(Neyman and Pearson), and that is what a classifier learns: this one reads what was seen, where HG-VAE would have put it
and how sure it was, and is taught by clean motion and by motion with what trackers get wrong (`prior.train_anomaly`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from prior.graph import JOINT_NODES, SCALE, GraphBlock, GraphLinear

RECENT = 15
"""Frames that are scored: what is wrong now must not be watered down by what was right."""

OFF_SCALE = 0.02
"""Metres: how far a joint is off HG-VAE's opinion is told in these, large values by their logarithm."""

ROUGH_SCALE = 0.003
"""Metres: how rough a track is, is told in these, by its logarithm."""

SENSOR_SCALE = 0.01
"""Metres, of the sensor's error, told by its logarithm."""


@dataclass(frozen=True)
class FaultNetConfig:
    """Sizes.

    Attributes:
        frames: T, of HG-VAE's window.
        features: of each of its 66 nodes.
    """

    frames: int = 50
    features: int = 48

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> FaultNetConfig:
        """From the JSON of a weights file."""
        return cls(**config)


class FaultNet(nn.Module):
    """The logarithm of the odds that a joint is further off than its sensor explains."""

    def __init__(self, config: FaultNetConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(JOINT_NODES))
        self.read = GraphLinear(JOINT_NODES, JOINT_NODES, 4 * config.frames + 2, config.features)
        self.blocks = nn.Sequential(*(GraphBlock(JOINT_NODES, config.features) for _ in range(2)))
        self.write = GraphLinear(JOINT_NODES, JOINT_NODES // 3, config.features, 1)

    mean: Tensor

    def forward(self, x: Tensor, found: Tensor, sigma: Tensor, observed: Tensor, sensor_sigma: Tensor) -> Tensor:
        """(B, 22) logits.

        Args:
            x: (B, 66, T) metres of a standard body, tracks seen; not read where there is nothing observed.
            found: (B, 66, T) metres, what HG-VAE makes of them.
            sigma: (B, 66, T) metres, how sure HG-VAE is.
            observed: (B, 66, T) 1 where seen.
            sensor_sigma: (B,) metres along an axis, what the sensor may be off by.
        """
        seen = torch.where(observed > 0, x, found)
        told = [
            (seen - self.mean[:, None]) / SCALE * observed,
            torch.asinh((seen - found) / OFF_SCALE),
            (sigma / OFF_SCALE).log(),
            observed,
            _roughness(seen, observed),
            (sensor_sigma / SENSOR_SCALE).log()[:, None, None].expand(-1, JOINT_NODES, 1),
        ]
        return self.write(self.blocks(F.gelu(self.read(torch.cat(told, dim=-1).transpose(0, 1)))))[..., 0].T


def _roughness(seen: Tensor, observed: Tensor) -> Tensor:
    """(B, 66, 1) how much tracks (B, 66, T) shake, where observed: a tracker that holds its last answer does not."""
    shown = observed[..., 2:] * observed[..., 1:-1] * observed[..., :-2]
    shaken = (seen.diff(n=2, dim=-1).square() * shown)[..., -RECENT:].sum(dim=-1, keepdim=True)
    mean = shaken / shown[..., -RECENT:].sum(dim=-1, keepdim=True).clamp(min=1.0)
    return 0.5 * (mean / ROUGH_SCALE**2 + 1e-3).log()
