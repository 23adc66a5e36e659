"""The size of the network of root velocity and contacts, and what validation measured of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from steadypose.prior.timing.rate import FPS

FRAME_S = 1.0 / FPS
"""Seconds between the frames that the network sees."""

JOINT_FEATURES = 6
"""A joint's features: position and velocity."""

CHANNELS = (JOINT_FEATURES, 6, 12, 24, 48)
"""of an edge, before the first convolution and after each"""


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
