"""Which joints of a window are not where they were seen: a small graph network beside HG-VAE.

How unlikely a window is under a generative model tells noise from motion, but not a hand that stands still from one
that rests, and it takes a dance for a fault. The best test between two hypotheses is the ratio of their likelihoods
(Neyman and Pearson), and that is what a classifier learns: this one reads what was seen, where HG-VAE would have put it
and how sure it was, and is taught by clean motion and by motion with what trackers get wrong
(`prior.models.hgvae.train_faults`).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.hgvae.config import JOINT_NODES, FaultNetConfig
from steadypose.prior.models.layers.graph import GraphBlock, GraphLinear
from steadypose.prior.models.torch_weights import load_network
from steadypose.prior.models.weights_io import weights_path


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

    def forward(self, features: Tensor) -> Tensor:
        """(B, 22) logits of windows, from their `fault_features`."""
        return self.write(self.blocks(F.gelu(self.read(features.transpose(0, 1)))))[..., 0].T


def load_fault_net(weights: str) -> FaultNet:
    """The one beside HG-VAE's weights of this name."""
    path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
    return load_network(FaultNet, FaultNetConfig.from_dict, str(path), "hgvae")
