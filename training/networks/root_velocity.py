"""The network that tells how the root moves from how the body moves (HM-VAE, section 3.3), and what touches the floor.

Four skeleton convolutions with pooling over the skeleton and none over time, then a linear layer, as in the paper.
Changed where the task asks for it: the convolutions see no future, so that no delay is added; the input is turned to
the body's heading, which the official code leaves to the network to learn; velocities are in m/s; and beside them the
network tells their standard deviation and the probability of each contact (HuMoR's eight).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.fit.skeleton_conv import SkeletonConv, SkeletonPool
from steadypose.prior.models.layers.dense import SLOPE
from steadypose.prior.models.layers.edge_graph import Level, pooling_levels
from steadypose.prior.models.root_velocity import CHANNELS, FRAME_S, TrajectoryConfig


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


class TrajectoryNet(nn.Module):
    """Root velocity and contacts from joint positions, causal in time."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        self.config = config
        levels = pooling_levels(PARENTS)
        c = CHANNELS
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
