"""Sizes of an HM-VAE, as stored with its weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

ROTATION_FEATURES = 6
"""A joint's features: the first two columns of its local rotation."""

CHANNELS = (ROTATION_FEATURES, 12, 24, 48, 96)
"""of an edge, before the first block of the encoder and after each"""


DEVIATION = 0.1
"""Of a joint's features from those of its mean over a window, typically: the network has deviations in this unit."""

NO_ROTATION = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""A joint's features where it does not deviate from its mean."""


@dataclass(frozen=True)
class HMVAEConfig:
    """Sizes of an HM-VAE.

    Attributes:
        window: frames T.
        kernel: time steps a convolution sees (official: 3 for T = 8, 15 for T = 64).
        strides: of the four encoder blocks (official: 1, 2, 2, 1 for T = 8; 2, 2, 2, 2 for T = 64).
        local_latent: dimensions of z_l an edge (official: 6; 12).
        global_latent: dimensions of z_g an edge (official: 6; 24).
        about_mean: whether each joint's rotations are encoded and decoded in the frame of their mean over the window,
            which is observed, rather than, as the paper's, as they are: what is left to tell is how the window moves,
            where the paper's error is mostly constant over it. The encoder sees the mean pose too.
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
    def features(self) -> int:
        """Features of a joint that the encoder sees: its rotation, or its deviation from the mean and the mean."""
        return ROTATION_FEATURES * (2 if self.about_mean else 1)

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
