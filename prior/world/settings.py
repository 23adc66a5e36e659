"""Settings of the trajectory node: ``[trajectory]`` of a launch file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from steadypose.prior.settings import build_settings


@dataclass(frozen=True)
class TrajectorySettings:
    """What a launch file may set.

    Attributes:
        weights: the weight set of the root's velocity, or a path to a ``.safetensors`` file.
        contact_weights: the same of the contacts.
        network: whether the network's root velocity is used.
        contacts: whether feet that rest stand, and hold the root.
        acceleration: m/s² over √Hz, how quickly a root may change its velocity.
        lost_sigma: metres, the horizontal standard deviation beyond which a body counts as LOST.
        timeout_s: seconds after which a body that no message mentions is forgotten.
    """

    weights: str = "default"
    contact_weights: str = "default"
    network: bool = True
    contacts: bool = True
    acceleration: float = 3.0
    lost_sigma: float = 0.5
    timeout_s: float = 1.0

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> TrajectorySettings:
        """From the table of a launch file.

        Raises:
            ValueError: a key that does not exist, a value of the wrong type, or a number that is not above 0.
        """
        return build_settings(cls, settings, "trajectory")

    def __post_init__(self) -> None:
        for name in ("acceleration", "lost_sigma", "timeout_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"[trajectory] {name}: expected a finite number above 0, got {getattr(self, name)}")
