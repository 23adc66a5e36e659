"""Where the joints are that nobody saw, in one pass: the network that completes a window before HG-VAE looks at it.

HG-VAE's own encoder learns this badly: a node is one coordinate of one joint, all nodes share their weights, and the
likelihood of what was seen to the millimetre drowns what was hidden by decimetres. Here a node is a part of the
window's time and its features are the whole body, so that a knee follows from hip, ankle and the other leg.

People mostly hold still what they held still: then the line beside the joint above (`prior.models.hgvae.features`) is
right to the millimetre, and no network is. So what the network corrects is fused with that line, each by its variance;
the line's grows with the time from a sighting and with how much this joint of this person has moved while it was seen.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.hgvae.completion_features import (
    FIRST_LOG_VAR,
    FRAME_INPUTS,
    HALF_BELIEVED,
    JOINTS,
    WINDOW_INPUTS,
    completion_features,
)
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig
from steadypose.prior.models.layers.compiled_graph import LOG_VAR_RANGE
from steadypose.prior.models.layers.graph import GraphBlock, GraphLinear


class CompletionNet(nn.Module):
    """A better guess of what was hidden, and how far off it will be; of windows of ``frames``."""

    def __init__(self, frames: int, config: CompletionConfig) -> None:
        super().__init__()
        if frames % config.patch:
            raise ValueError(f"expected frames in whole patches of {config.patch}, got {frames}")
        self.config = config
        nodes, features = frames // config.patch, config.features
        self.read = GraphLinear(nodes, nodes, FRAME_INPUTS * config.patch + WINDOW_INPUTS, features)
        self.blocks = nn.Sequential(*(GraphBlock(nodes, features) for _ in range(config.blocks)))
        self.write = GraphLinear(nodes, nodes, features, (JOINT_NODES + JOINTS) * config.patch)
        with torch.no_grad():
            self.write.weight.mul_(0.1)  # begins near the guess

    def forward(self, nodes: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """The correction (B, 66, T) and the log-variance by joint (B, 22, T) of what it comes to, in units of `SCALE`.

        The arguments are those of `Features`.
        """
        written = self.write(self.blocks(F.gelu(self.read(nodes.transpose(0, 1))))).transpose(0, 1)
        return self.fuse(written, line_variance)

    def fuse(self, written: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """What `forward` gives, from what the network writes (B, T / patch, 88 patch), and from the line.

        They are fused as normal distributions are, by their product.
        """
        found, log_var = written.split([JOINT_NODES * self.config.patch, JOINTS * self.config.patch], dim=-1)
        log_var = (_by_track(log_var, JOINTS) + FIRST_LOG_VAR).clamp(*LOG_VAR_RANGE)
        # of a line of infinite variance, 1; of one of none, 0, where the quotient's gradient is not a number
        gain = 1.0 / (1.0 + log_var.exp() / line_variance.clamp(min=1e-12))
        gain = torch.where(line_variance > 0, gain, 0.0)
        fused = log_var + gain.clamp(min=1e-6).log()
        return _by_track(found, JOINT_NODES) * gain.repeat_interleave(3, dim=1), fused.clamp(*LOG_VAR_RANGE)

    def complete(
        self, deviations: Tensor, observed: Tensor, bias_sigma: NDArray[np.floating] | float
    ) -> tuple[Tensor, Tensor]:
        """Windows (B, 66, T) with a better guess of what was not observed, and its log-variance by joint (B, 22, T).

        The arguments are those of `completion_features`.
        """
        features = completion_features(deviations.numpy(), observed.numpy(), bias_sigma, self.config.patch)
        correction, log_var = self(torch.from_numpy(features.nodes), torch.from_numpy(features.line_variance()))
        return torch.where(observed > 0, deviations, deviations + correction), log_var


def belief(observed: Tensor, log_var: Tensor) -> Tensor:
    """(B, 66, T) how far to believe a completed window: 1 where seen; a guess as good as `HALF_BELIEVED` by half.

    Args:
        observed: (B, 66, T) more than 0 where seen.
        log_var: (B, 22, T) of what was completed, in units of `SCALE`.
    """
    guessed = torch.sigmoid(2 * math.log(HALF_BELIEVED / SCALE) - log_var)
    return torch.where(observed > 0, 1.0, guessed.repeat_interleave(3, dim=1))


def _by_track(nodes: Tensor, tracks: int) -> Tensor:
    """(B, T / patch, patch * tracks) to (B, tracks, T)"""
    return nodes.unflatten(-1, (-1, tracks)).flatten(1, 2).transpose(1, 2)
