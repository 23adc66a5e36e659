"""The sizes of the completer, as its weights tell them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

JOINTS = 22

BENDS = JOINTS * 6 + 3
"""Numbers by which cubics differ from the line, of rotations' first columns and of the root."""

FEATURES = JOINTS * (6 + 3 + 3 + 3) + 9 + BENDS
"""Numbers of a frame: of each joint its rotation, place, velocity, and whether and how near it is known; of the root
its place, velocity, and the same three; and the bends."""

OUTPUTS = JOINTS * 6 + 3 + JOINTS + 1
"""What is added to the line, to each joint's 6D rotation and to the root's place, metres; and, as logits, how much of
each joint's and the root's bend is taken."""


@dataclass(frozen=True)
class CompleterConfig:
    """The sizes of the completer.

    Attributes:
        width: numbers of a frame, in the transformer.
        heads: of each layer's attention.
        layers: how many.
        reach: frames apart beyond which attention tells distances no more.
        never_sigma: (22,) metres along an axis, how far off each joint is that is never known: of validation.
        half_frames: frames from something known at which an answer is half as far off.
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
