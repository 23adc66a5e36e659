"""Where the joints are that nobody saw, in one pass: the network that completes a window before HG-VAE looks at it.

HG-VAE's own encoder learns this badly: a node is one coordinate of one joint, all nodes share their weights, and the
likelihood of what was seen to the millimetre drowns what was hidden by decimetres. Here a node is a part of the
window's time and its features are the whole body, so that a knee follows from hip, ankle and the other leg. It corrects
the line beside the joint above (`prior.body_tracks`), the less the nearer a sighting is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from prior.graph import JOINT_NODES, LOG_VAR_RANGE, SCALE, GraphBlock, GraphLinear

NEAR = 8.0
"""Frames from a sighting at which half is told of it, and at which the guess beside it is left by 1 - 1/e. What is told
falls as 1 / (1 + d / NEAR): by an exponential, an arm seen a second ago would pass for one never seen."""

CENTIMETRE = 0.01 / SCALE
"""in the network's units: how much joints jump about is told in these, by its logarithm"""

SLOW = 0.01
LEAST_SLOW = 0.002
"""Metres along an axis: errors that last are told in the one by their logarithm, those under the other as none."""

FIRST_LOG_VAR = -3.0
"""What the network's zero stands for, in units of `SCALE`: 4.5 cm."""

_JOINTS = JOINT_NODES // 3
_FRAME = JOINT_NODES + 2 * _JOINTS
"""Numbers that tell of a frame: tracks, and how near a joint's last and next sighting are."""


@dataclass(frozen=True)
class CompletionConfig:
    """Sizes.

    Attributes:
        patch: frames in a node; a window has whole patches.
        features: of each node.
        blocks: graph convolutional blocks between reading and writing.
    """

    patch: int = 5
    features: int = 256
    blocks: int = 4


class Told(NamedTuple):
    """Windows as the network reads them.

    Attributes:
        nodes: (B, T / patch, inputs) float32.
        share: (B, 66, T) how much of its correction an entry takes: 0 where seen, 1 far from any sighting.
    """

    nodes: NDArray[np.float32]
    share: NDArray[np.float32]


class CompletionNet(nn.Module):
    """Corrections of a guess of what was hidden, and how far off they will be; of windows of ``frames``."""

    def __init__(self, frames: int, config: CompletionConfig) -> None:
        super().__init__()
        if frames % config.patch:
            raise ValueError(f"expected frames in whole patches of {config.patch}, got {frames}")
        self.config = config
        nodes, features = frames // config.patch, config.features
        self.read = GraphLinear(nodes, nodes, _FRAME * config.patch + _JOINTS + 2, features)
        self.blocks = nn.Sequential(*(GraphBlock(nodes, features) for _ in range(config.blocks)))
        self.write = GraphLinear(nodes, nodes, features, (JOINT_NODES + _JOINTS) * config.patch)
        with torch.no_grad():
            self.write.weight.mul_(0.1)  # begins near the guess

    def forward(self, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """The correction (B, 66, T) and its log-variance by joint (B, 22, T), in units of `SCALE`.

        ``nodes`` are those of `tell`.
        """
        written = self.write(self.blocks(F.gelu(self.read(nodes.transpose(0, 1))))).transpose(0, 1)
        found, log_var = written.split([JOINT_NODES * self.config.patch, _JOINTS * self.config.patch], dim=-1)
        log_var = (_by_track(log_var, _JOINTS) + FIRST_LOG_VAR).clamp(*LOG_VAR_RANGE)
        return _by_track(found, JOINT_NODES), log_var

    def complete(
        self, deviations: Tensor, observed: Tensor, slow: NDArray[np.floating] | float
    ) -> tuple[Tensor, Tensor]:
        """Windows (B, 66, T) with a better guess of what was not observed, and its log-variance by joint (B, 22, T).

        The arguments are those of `tell`.
        """
        told = tell(deviations.numpy(), observed.numpy(), slow, self.config.patch)
        found, log_var = self(torch.from_numpy(told.nodes))
        return deviations + torch.from_numpy(told.share) * found, log_var


def _by_track(nodes: Tensor, tracks: int) -> Tensor:
    """(B, T / patch, patch * tracks) to (B, tracks, T)"""
    return nodes.unflatten(-1, (-1, tracks)).flatten(1, 2).transpose(1, 2)


def tell(
    deviations: NDArray[np.floating], observed: NDArray[np.floating], slow: NDArray[np.floating] | float, patch: int
) -> Told:
    """Windows as `CompletionNet` reads them.

    Args:
        deviations: (B, 66, T) tracks about the training mean in units of `SCALE`, what was not seen guessed.
        observed: (B, 66, T) more than 0 where seen.
        slow: (B,) metres along an axis, the errors of the sensor that last.
        patch: frames in a node.
    """
    count, _, frames = deviations.shape
    told = np.empty((count, frames // patch, _FRAME * patch + _JOINTS + 2), dtype=np.float32)
    share = np.empty((count, JOINT_NODES, frames), dtype=np.float32)
    _tell(deviations.astype(np.float32), observed.astype(np.float32), patch, told, share)
    told[..., -1] = np.broadcast_to(np.log(np.maximum(slow, LEAST_SLOW) / SLOW), count)[:, None]
    return Told(told, share)


@njit(cache=True)
def _tell(deviations, observed, patch, told, share):
    count, tracks, frames = deviations.shape
    joints = tracks // 3
    frame = tracks + 2 * joints
    for b in range(count):
        for track in range(tracks):
            since = frames
            for t in range(frames):
                since = 0 if observed[b, track, t] > 0 else min(since + 1, frames)
                share[b, track, t] = since
                told[b, t // patch, (t % patch) * frame + track] = deviations[b, track, t]
                if track % 3 == 0:
                    near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                    told[b, t // patch, (t % patch) * frame + tracks + track // 3] = near
            since = frames
            for t in range(frames - 1, -1, -1):
                since = 0 if observed[b, track, t] > 0 else min(since + 1, frames)
                apart = min(since, share[b, track, t])
                share[b, track, t] = 1.0 - math.exp(-apart / NEAR) if apart < frames else 1.0
                if track % 3 == 0:
                    near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                    told[b, t // patch, (t % patch) * frame + tracks + joints + track // 3] = near
        _tell_noise(deviations[b], observed[b], told[b, :, patch * frame :])


@njit(cache=True)
def _tell_noise(deviations, observed, told):
    """How much each joint jumps about, by the second difference of its track, and how much all do, to every node."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    squares, counts = np.zeros(joints), np.zeros(joints)
    for joint in range(joints):
        seen = observed[3 * joint]
        for t in range(1, frames - 1):
            if seen[t - 1] > 0 and seen[t] > 0 and seen[t + 1] > 0:
                counts[joint] += 1
                for axis in range(3):
                    track = deviations[3 * joint + axis]
                    squares[joint] += (track[t - 1] - 2 * track[t] + track[t + 1]) ** 2
    together = squares.sum() / max(counts.sum(), 1.0)
    for joint in range(joints + 1):
        alone = joint < joints and counts[joint] > 3
        square = squares[joint] / counts[joint] if alone else together
        told[:, joint] = 0.25 * math.log(square / CENTIMETRE**2 + 1e-3)
