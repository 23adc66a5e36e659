"""Sizes of the completer, as stored with its weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

JOINTS = 22

BENDS = JOINTS * 6 + 3
"""Numbers of a frame's bend: of each rotation's first two columns, and of the root's position."""

FEATURES = JOINTS * (6 + 3 + 3 + 3) + 9 + BENDS
"""Numbers of a frame: of each joint its rotation (6D), position, velocity, whether it is known, and how near that is
before and after; of the root its position, velocity and the same three; and the bend."""

OUTPUTS = JOINTS * 6 + 3 + JOINTS + 1
"""Corrections of each joint's 6D rotation and of the root's position, metres; and logits of the gates of each joint's
and the root's bend."""


@dataclass(frozen=True)
class CompleterConfig:
    """The sizes of the completer.

    Attributes:
        width: of the transformer's tokens, one a frame.
        heads: of each layer's attention.
        layers: how many.
        reach: frames at which relative positions are clipped.
        never_sigma: (22,) metres along an axis, error of each joint where it is never known, of validation people.
        half_frames: frames from the nearest in which a joint is known at which its error is half of that.
    """

    width: int = 128
    heads: int = 8
    layers: int = 5
    reach: int = 64
    never_sigma: tuple[float, ...] = (0.1,) * JOINTS
    half_frames: float = 10.0

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> CompleterConfig:
        """From the JSON of a weights file."""
        return cls(**{**config, "never_sigma": tuple(config["never_sigma"])})
