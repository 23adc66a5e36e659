"""Which joints of a window are not where they were seen: a small graph network beside HG-VAE.

How unlikely a window is under a generative model tells noise from motion, but not a hand that stands still from one
that rests, and it takes a dance for a fault. The best test between two hypotheses is the ratio of their likelihoods
(Neyman and Pearson), and that is what a classifier learns: this one reads what was seen, where HG-VAE would have put it
and how sure it was, and is taught by clean motion and by motion with what trackers get wrong
(`prior.models.hgvae.train_faults`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.models.layers.graph import JOINT_NODES, SCALE, GraphBlock, GraphLinear

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

    def forward(self, told: Tensor) -> Tensor:
        """(B, 22) logits of windows as `tell` tells of them."""
        return self.write(self.blocks(F.gelu(self.read(told.transpose(0, 1)))))[..., 0].T


def tell(
    x: NDArray[np.floating],
    found: NDArray[np.floating],
    sigma: NDArray[np.floating],
    observed: NDArray[np.floating],
    sensor_sigma: NDArray[np.floating] | float,
    mean: NDArray[np.floating],
) -> NDArray[np.float32]:
    """Windows as `FaultNet` reads them.

    Args:
        x: (B, 66, T) metres of a standard body, tracks seen; not read where there is nothing observed.
        found: (B, 66, T) metres, what HG-VAE makes of them.
        sigma: (B, 66, T) metres, how sure HG-VAE is.
        observed: (B, 66, T) more than 0 where seen.
        sensor_sigma: (B,) metres along an axis, what the sensor may be off by.
        mean: (66,) metres, of the network.

    Returns:
        (B, 66, 4 T + 2): where a track was seen, how far that is off, how sure HG-VAE is, what was seen; how much the
        last frames of the track shake (a tracker that holds its last answer does not); the sensor's error.
    """
    count, tracks, frames = x.shape
    told = np.empty((count, tracks, 4 * frames + 2), dtype=np.float32)
    _tell(x, found, sigma, observed, mean, told)
    told[..., -1] = np.reshape(np.log(np.asarray(sensor_sigma) / SENSOR_SCALE), (-1, 1))
    return told


@njit(cache=True)
def _tell(x, found, sigma, observed, mean, told):
    count, tracks, frames = x.shape
    for b in range(count):
        for track in range(tracks):
            row = told[b, track]
            square, shown = 0.0, 0
            for t in range(frames):
                seen = observed[b, track, t] > 0
                row[t] = (x[b, track, t] - mean[track]) / SCALE if seen else 0.0
                row[frames + t] = math.asinh((x[b, track, t] - found[b, track, t]) / OFF_SCALE) if seen else 0.0
                row[2 * frames + t] = math.log(sigma[b, track, t] / OFF_SCALE)
                row[3 * frames + t] = 1.0 if seen else 0.0
                if (
                    t >= max(frames - RECENT, 2)
                    and seen
                    and observed[b, track, t - 1] > 0
                    and observed[b, track, t - 2] > 0
                ):
                    square += (x[b, track, t] - 2 * x[b, track, t - 1] + x[b, track, t - 2]) ** 2
                    shown += 1
            row[4 * frames] = 0.5 * math.log(square / max(shown, 1) / ROUGH_SCALE**2 + 1e-3)
