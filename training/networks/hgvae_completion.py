"""The completion network: fills in unobserved joints in one pass, before HG-VAE encodes a window.

HG-VAE's own encoder learns this badly: a node is one coordinate of one joint, all nodes share their weights, and the
likelihood of joints observed to the millimetre outweighs that of hidden ones, off by decimetres. Here a node is a patch
of the window's time and its features are the whole body, so that a knee follows from hip, ankle and the other leg.

A limb that rests mostly goes on resting: then the interpolation relative to its parent (`prior.models.hgvae.features`)
is right to the millimetre, and no network is. So the network's correction is fused with that interpolation, each
weighted by its inverse variance; the interpolation's variance grows with the time from an observation and with how much
this joint of this person has moved while it was observed.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig
from steadypose.prior.models.hgvae.live_completion import (
    FIRST_LOG_VAR,
    FRAME_INPUTS,
    HALF_CERTAIN_SIGMA,
    JOINTS,
    WINDOW_INPUTS,
    completion_features,
)
from steadypose.prior.models.layers.compiled_graph import LOG_VAR_RANGE
from steadypose.training.networks.graph import GraphBlock, GraphLinear


class CompletionNet(nn.Module):
    """Corrections of the interpolated joints of windows of ``frames``, with their variance."""

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
            self.write.weight.mul_(0.1)  # begins near the interpolation

    def forward(self, nodes: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """Correction (B, 66, T) and log-variance of the corrected joint (B, 22, T), in units of `SCALE`.

        Args:
            nodes: (B, T / patch, inputs), as of `Features`.
            line_variance: (B, 22, T) of the interpolation, `Features.line_variance`.
        """
        written = self.write(self.blocks(F.gelu(self.read(nodes.transpose(0, 1))))).transpose(0, 1)
        return self.fuse(written, line_variance)

    def fuse(self, written: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """`forward` from the last layer's output ``written`` (B, T / patch, 88 patch).

        Network and interpolation are fused as normal distributions, by their product.
        """
        correction, log_var = written.split([JOINT_NODES * self.config.patch, JOINTS * self.config.patch], dim=-1)
        log_var = (_by_track(log_var, JOINTS) + FIRST_LOG_VAR).clamp(*LOG_VAR_RANGE)
        # 1 where the interpolation's variance is infinite; 0 where it is 0, at which the quotient's gradient is NaN
        gain = 1.0 / (1.0 + log_var.exp() / line_variance.clamp(min=1e-12))
        gain = torch.where(line_variance > 0, gain, 0.0)
        fused = log_var + gain.clamp(min=1e-6).log()
        return _by_track(correction, JOINT_NODES) * gain.repeat_interleave(3, dim=1), fused.clamp(*LOG_VAR_RANGE)

    def complete(
        self, deviations: Tensor, observed: Tensor, bias_sigma: NDArray[np.floating] | float
    ) -> tuple[Tensor, Tensor]:
        """Windows (B, 66, T) with unobserved entries completed, and their log-variance by joint (B, 22, T).

        The arguments are those of `completion_features`.
        """
        features = completion_features(deviations.numpy(), observed.numpy(), bias_sigma, self.config.patch)
        correction, log_var = self(torch.from_numpy(features.nodes), torch.from_numpy(features.line_variance()))
        return torch.where(observed > 0, deviations, deviations + correction), log_var


def certainty_of(observed: Tensor, log_var: Tensor) -> Tensor:
    """(B, 66, T) certainty of a completed window's entries, for HG-VAE's encoder.

    s² / (s² + variance) where completed, with s = `HALF_CERTAIN_SIGMA`; 1 where observed.

    Args:
        observed: (B, 66, T) more than 0 where observed.
        log_var: (B, 22, T) of completed joints, in units of `SCALE`.
    """
    completed = torch.sigmoid(2 * math.log(HALF_CERTAIN_SIGMA / SCALE) - log_var)
    return torch.where(observed > 0, 1.0, completed.repeat_interleave(3, dim=1))


def _by_track(nodes: Tensor, tracks: int) -> Tensor:
    """(B, T / patch, patch * tracks) to (B, tracks, T)"""
    return nodes.unflatten(-1, (-1, tracks)).flatten(1, 2).transpose(1, 2)
