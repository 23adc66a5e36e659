"""Layers of graphs with learned adjacency and of attention, and the completion and fault networks of HG-VAE."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.compiled_graph import LOG_VAR_RANGE
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig, FaultNetConfig
from steadypose.prior.models.hgvae.live_completion import (
    FIRST_LOG_VAR,
    FRAME_INPUTS,
    HALF_CERTAIN_SIGMA,
    JOINTS,
    WINDOW_INPUTS,
    completion_features,
)
from steadypose.prior.models.weights import weights_path

DROPOUT = 0.05  # share of the outputs of the completion network's layers that training drops


class GraphLinear(nn.Module):
    """``S A W + b``: graphs (n_in, B, f_in) to (n_out, B, f_out), equation 4 without its activation.

    Nodes are the first dimension inside the model, so that each product is one of two matrices for any batch size.
    ``nodes_in == nodes_out`` means the same nodes; S then starts near the identity.
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
        if len(self.bias) < len(graph):  # the order with fewer operations
            return self._mix(graph) @ self.weight + self.bias[:, None]
        return self._mix(graph @ self.weight) + self.bias[:, None]

    def _mix(self, graph: Tensor) -> Tensor:
        return (self.adjacency @ graph.flatten(1)).unflatten(1, graph.shape[1:])


class GraphBlock(nn.Module):
    """Two graph convolutional layers with a residual connection (equation 5).

    The learned weight, initially 0, multiplies the layers' branch, as in Bachlechner et al. (2020) and the official
    code. The paper's formula applies it to the residual.
    """

    def __init__(self, nodes: int, features: int) -> None:
        super().__init__()
        self.first = GraphLinear(nodes, nodes, features, features)
        self.second = GraphLinear(nodes, nodes, features, features)
        self.alpha = nn.Parameter(torch.zeros(()))

    def forward(self, graph: Tensor) -> Tensor:
        """(n, B, f) to (n, B, f)."""
        return graph + self.alpha * F.gelu(self.second(F.gelu(self.first(graph))))


class CompletionNet(nn.Module):
    """Imputes unobserved joints in one pass, before HG-VAE encodes a window.

    It predicts corrections of the interpolated joints of windows of ``frames``, with their variance.

    HG-VAE's own encoder learns this badly: its node is one coordinate of one joint, and joints observed to the
    millimetre outweigh hidden ones with errors of decimetres. Here, a node is a patch of the window in time and its
    features are the whole body, so a knee follows from hip, ankle and the other leg.

    The interpolation of a resting limb relative to its parent (`prior.models.hgvae.features`) is accurate to the
    millimetre, and the network is not. The network's correction is therefore fused with it by inverse variances. The
    variance of the interpolation increases with the time from an observation, and with the joint's mobility.
    """

    def __init__(self, frames: int, config: CompletionConfig) -> None:
        super().__init__()
        if frames % config.patch:
            raise ValueError(f"expected frames in whole patches of {config.patch}, got {frames}")
        self.config = config
        width = config.width
        self.read = nn.Linear(FRAME_INPUTS * config.patch + WINDOW_INPUTS, width)
        self.place = nn.Parameter(torch.zeros(frames // config.patch, width))
        self.layers = nn.Sequential(
            *(AttentionLayer(width, config.heads, 2 * width, dropout=DROPOUT) for _ in range(config.layers))
        )
        self.norm = nn.LayerNorm(width)
        self.write = nn.Linear(width, (JOINT_NODES + JOINTS) * config.patch)
        with torch.no_grad():  # start near the interpolation
            self.write.weight.mul_(0.1)
            self.write.bias.zero_()

    def forward(self, nodes: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return correction (B, 66, T) and log-variance of the corrected joint (B, 22, T), in units of `SCALE`.

        Args:
            nodes: (B, T / patch, inputs), see `Features`.
            line_variance: (B, 22, T) variance of the interpolation, `Features.line_variance`.
        """
        return self.fuse(self.write(self.norm(self.layers(self.read(nodes) + self.place))), line_variance)

    def fuse(self, written: Tensor, line_variance: Tensor) -> tuple[Tensor, Tensor]:
        """Compute `forward` from the last layer's output ``written`` (B, T / patch, 88 patch).

        Network and interpolation are fused as the product of normal distributions.
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
        """Complete unobserved entries; returns windows (B, 66, T), and log-variance by joint (B, 22, T).

        Arguments are as in `completion_features`.
        """
        features = completion_features(deviations.numpy(), observed.numpy(), bias_sigma, self.config.patch)
        correction, log_var = self(torch.from_numpy(features.nodes), torch.from_numpy(features.line_variance()))
        return torch.where(observed > 0, deviations, deviations + correction), log_var


def certainty_of(observed: Tensor, log_var: Tensor) -> Tensor:
    """(B, 66, T) certainty of a completed window's entries, for HG-VAE's encoder: 1 where ``observed`` (B, 66, T) is
    more than 0, and s² / (s² + variance) where completed.

    s is `HALF_CERTAIN_SIGMA`; ``log_var`` (B, 22, T) is of completed joints, in units of `SCALE`.
    """
    completed = torch.sigmoid(2 * math.log(HALF_CERTAIN_SIGMA / SCALE) - log_var)
    return torch.where(observed > 0, 1.0, completed.repeat_interleave(3, dim=1))


def _by_track(nodes: Tensor, tracks: int) -> Tensor:
    """(B, T / patch, patch * tracks) to (B, tracks, T)"""
    return nodes.unflatten(-1, (-1, tracks)).flatten(1, 2).transpose(1, 2)


class FaultNet(nn.Module):
    """Predicts the log odds that a joint's error is larger than the sensor's noise explains.

    A window's likelihood under a generative model does not distinguish a frozen hand from a resting one, and is low for
    a dance too. The most powerful test is the likelihood ratio (Neyman and Pearson), which a classifier learns. This
    one reads the observations and HG-VAE's reconstruction with its deviation (`training.recipes.hgvae_faults`).
    """

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


class AttentionLayer(nn.Module):
    """Pre-norm multi-head attention between nodes, and a feed-forward network, each with a residual connection.

    Nodes have ``width`` features, the feed-forward network ``widened``. Up to a distance of ``reach``, scores have
    learned biases of relative position. ``dropout`` is the share of the branches' outputs that training drops.
    """

    def __init__(
        self, width: int, heads: int, widened: int, *, reach: int | None = None, approximate: str = "none",
        dropout: float = 0.0,
    ) -> None:  # fmt: skip
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
