"""The network that tells how the root moves from how the body moves (HM-VAE, section 3.3), and what touches the floor.

Four skeleton convolutions with pooling over the skeleton and none over time, then a linear layer, as in the paper.
Changed where the task asks for it: the convolutions see no future, so that no delay is added; the input is turned to
the body's heading, which the official code leaves to the network to learn; velocities are in m/s; and beside them the
network tells their standard deviation and the probability of each contact (HuMoR's eight).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.layers.skeleton_conv import Level, SkeletonConv, SkeletonPool, pooling_levels

FRAME_S = 1.0 / 30.0
"""Seconds between the frames that the network sees."""

SLOPE = 0.2
"""Of the activations, for negative values."""


@dataclass(frozen=True)
class TrajectoryConfig:
    """The size of the network, and what validation measured of its errors.

    Attributes:
        kernel: frames that each of the four convolutions sees.
        sigma_scale: (horizontal, vertical) by which the predicted standard deviation is too small.
        correlation_s: (horizontal, vertical) seconds for which an error of the velocity lasts: twice the integral of
            its normalised autocorrelation.
    """

    kernel: int = 7
    sigma_scale: tuple[float, float] = (1.0, 1.0)
    correlation_s: tuple[float, float] = (FRAME_S, FRAME_S)

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> TrajectoryConfig:
        """From the JSON of a weights file."""
        pairs = {name: tuple(config[name]) for name in ("sigma_scale", "correlation_s")}
        return cls(**{**config, **pairs})

    @property
    def context(self) -> int:
        """Frames that the newest output depends on."""
        return 4 * (self.kernel - 1) + 1


class RootMotion(NamedTuple):
    """What the network says of each frame, in the frame of its input."""

    velocity: Tensor
    """(B, T, 3) m/s, of the root"""
    log_sigma: Tensor
    """(B, T, 3) log of the standard deviation of that along each axis, m/s"""
    contact_logits: Tensor
    """(B, T, 8) of `CONTACT_JOINTS`"""


class _Block(nn.Module):
    """Convolution, pooling over the skeleton, activation."""

    def __init__(self, in_channels: int, out_channels: int, level: Level, kernel: int) -> None:
        super().__init__()
        self.conv = SkeletonConv(in_channels, out_channels, level.neighbours, kernel, padding="causal")
        self.pool = SkeletonPool(level.groups)

    def forward(self, features: Tensor) -> Tensor:
        return F.leaky_relu(self.pool(self.conv(features)), SLOPE)

    @torch.no_grad()
    def folded(self) -> nn.Linear:
        """Convolution and pooling, both linear, as one layer over ``kernel`` frames side by side, oldest first."""
        assert self.conv.bias is not None
        outputs, inputs, kernel = self.conv.weight.shape
        weight = self.pool(self.conv.weight.reshape(1, outputs, inputs * kernel)).reshape(-1, inputs, kernel)
        layer = nn.Linear(kernel * inputs, len(weight))
        weight = weight.transpose(1, 2).reshape(len(weight), -1)
        layer.load_state_dict({"weight": weight, "bias": self.pool(self.conv.bias[None, :, None])[0, :, 0]})
        return layer


class TrajectoryNet(nn.Module):
    """Root velocity and contacts from joint positions, causal in time."""

    CHANNELS = (6, 6, 12, 24, 48)

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        self.config = config
        levels = pooling_levels(PARENTS)
        c = self.CHANNELS
        self.blocks = nn.ModuleList(_Block(c[k], c[k + 1], level, config.kernel) for k, level in enumerate(levels))
        self.head = nn.Linear(c[-1] * len(levels[-1].groups), 3 + 3 + len(CONTACT_JOINTS))

    def forward(self, joints: Tensor) -> RootMotion:
        """Every frame of joints (B, T, 22, 3): metres from the root, turned so that the body faces about +x.

        Before its first frame a window is taken to have stood still; the standard deviations know that.
        """
        features = _features(joints)
        for block in self.blocks:
            features = block(features)
        return _read(self.head(features.transpose(1, 2)))


class NewestFrame(nn.Module):
    """A trained `TrajectoryNet` at the last frame only: the same numbers to rounding, at a tenth of the cost.

    Frames that the last one does not depend on are left out; pooling, which is linear, is folded into the convolution
    before it, and the convolution is a product of matrices: for so few frames, a library's convolutions are slower.
    """

    def __init__(self, net: TrajectoryNet) -> None:
        super().__init__()
        self.context, self.kernel = net.config.context, net.config.kernel
        self.head = net.head
        self.layers = nn.ModuleList(block.folded() for block in net.blocks if isinstance(block, _Block))

    def forward(self, joints: Tensor) -> RootMotion:
        """The last frame (B, 1, ...) of joints (B, `context`, 22, 3), as `TrajectoryNet` takes them."""
        features = _features(joints).transpose(1, 2)
        for layer in self.layers:
            side_by_side = features.unfold(1, self.kernel, 1).transpose(2, 3).flatten(2)
            features = F.leaky_relu(layer(side_by_side), SLOPE)
        return _read(self.head(features))


def _read(outputs: Tensor) -> RootMotion:
    return RootMotion(*outputs.split([3, 3, len(CONTACT_JOINTS)], dim=-1))


def _features(joints: Tensor) -> Tensor:
    """(B, 22 * 6, T) of joints (B, T, 22, 3): position in metres, and velocity in m/s against the frame before.

    The paper feeds positions alone. A step of a few centimetres is then a small difference of large numbers, and
    training spends itself on learning to differentiate.
    """
    before = torch.cat([joints[:, :1], joints[:, :-1]], dim=1)
    velocity = (joints - before) / FRAME_S
    return torch.cat([joints, velocity], dim=-1).flatten(2).transpose(1, 2)
