"""Sizes of an HM-VAE, as stored with its weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

ROTATION_FEATURES = 6
"""A joint's features: the first two columns of its local rotation."""

CHANNELS = (ROTATION_FEATURES, 12, 24, 48, 96)
"""of an edge, before the first block of the encoder and after each"""


@dataclass(frozen=True)
class HMVAEConfig:
    """Sizes of an HM-VAE.

    Attributes:
        window: frames T.
        kernel: time steps a convolution sees (official: 3 for T = 8, 15 for T = 64).
        strides: of the four encoder blocks (official: 1, 2, 2, 1 for T = 8; 2, 2, 2, 2 for T = 64).
        local_latent: dimensions of z_l an edge (official: 6; 12).
        global_latent: dimensions of z_g an edge (official: 6; 24).
        about_mean: whether the decoder gives the deviation of a window from its mean pose, which is observed, rather
            than, as the paper's, the pose itself, whose error is mostly constant over the window.
    """

    window: int = 8
    kernel: int = 3
    strides: tuple[int, int, int, int] = (1, 2, 2, 1)
    local_latent: int = 6
    global_latent: int = 6
    about_mean: bool = False

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HMVAEConfig:
        """From the JSON of a weights file."""
        return cls(**{**config, "strides": tuple(config["strides"])})

    @property
    def steps(self) -> list[int]:
        """Frames before the first block of the encoder and after each.

        Raises:
            ValueError: the window cannot be strided so.
        """
        steps = [self.window]
        for stride in self.strides:
            if steps[-1] % stride:
                raise ValueError(f"a window of {self.window} frames cannot be strided by {self.strides}")
            steps.append(steps[-1] // stride)
        return steps
