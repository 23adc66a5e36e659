"""The fault network: which joints of a window are not where the tracker reports them; a small graph network.

A window's likelihood under a generative model tells noise from motion, but not a frozen hand from one that rests, and
takes a dance for a fault. The most powerful test between two hypotheses is the ratio of their likelihoods (Neyman and
Pearson), which is what a classifier learns: this one reads the observations and HG-VAE's reconstruction with its
deviation, and is trained on clean motion and on motion with trackers' faults (`training.recipes.hgvae_faults`).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.hgvae.config import JOINT_NODES, FaultNetConfig
from steadypose.prior.models.weights import weights_path
from steadypose.training.networks.graph import GraphBlock, GraphLinear


class FaultNet(nn.Module):
    """Log-odds that a joint's error is larger than the sensor's noise explains."""

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
    """The fault network that belongs to HG-VAE's weights of this name."""
    path = weights_path(weights, "hgvae").with_suffix(".faults.safetensors")
    return load_network(FaultNet, FaultNetConfig.from_dict, str(path), "hgvae")
