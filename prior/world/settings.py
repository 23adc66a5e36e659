"""Settings of the trajectory node: ``[trajectory]`` of a launch file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from steadypose.prior.settings import build_settings, weights_setting


@dataclass(frozen=True)
class TrajectorySettings:
    """Settings of the trajectory node."""

    weights: str = weights_setting("trajectory")
    """weight set of the root velocity network, or a path to a ``.safetensors`` file"""
    contact_weights: str = weights_setting("contacts")
    """weight set of the contact network, or a path to a ``.safetensors`` file"""
    network: bool = True
    """whether to use the network's root velocity"""
    contacts: bool = True
    """whether resting feet stay in place and anchor the root"""
    acceleration: float = 3.0
    """m/s² over √Hz, density of the root's white-noise acceleration"""
    lost_sigma: float = 0.5
    """metres, horizontal standard deviation of the root above which a body counts as LOST"""
    timeout_s: float = 1.0
    """seconds without a message that contains it after which a body is forgotten"""

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> TrajectorySettings:
        """Build the settings from the section of a launch file.

        Raises:
            ValueError: for an unknown key, a value of the wrong type, or a number that is not above 0.
        """
        return build_settings(cls, settings, "trajectory")

    def __post_init__(self) -> None:
        for name in ("acceleration", "lost_sigma", "timeout_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"[trajectory] {name}: expected a finite number above 0, got {getattr(self, name)}")
