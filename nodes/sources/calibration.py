"""A camera's calibration in its launch file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from steadypose.msgs.types import Pose
from steadypose.nodes.graph.settings import LaunchError


@dataclass(frozen=True)
class CalibrationSettings:
    """``[input.calibration]``: the camera's lens and place, as ``steadypose calibrate`` writes them."""

    size: list[int] = field(default_factory=list)
    """pixels, width and height of the pictures that the lens was calibrated with"""
    focal: list[float] = field(default_factory=list)
    """fx, fy in pixels"""
    centre: list[float] = field(default_factory=list)
    """cx, cy in pixels"""
    distortion: list[float] = field(default_factory=list)
    """k1, k2, p1, p2, k3, as OpenCV has them"""
    position: list[float] = field(default_factory=list)
    """metres, world"""
    orientation: list[float] = field(default_factory=list)
    """xyzw, from the camera's optical frame to the world"""

    def __post_init__(self) -> None:
        lengths = {"size": (2,), "focal": (2,), "centre": (2,), "position": (3,), "orientation": (4,)}
        for name, allowed in (lengths | {"distortion": (4, 5)}).items():
            values = getattr(self, name)
            numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in values)
            if values and not (numbers and len(values) in allowed):
                raise LaunchError(
                    f"[input.calibration] {name}: expected {' or '.join(map(str, allowed))} numbers, got {values}"
                )
        if bool(self.position) != bool(self.orientation):
            raise LaunchError("[input.calibration] expected position and orientation, or neither")
        if self.orientation and abs(math.hypot(*self.orientation) - 1.0) > 0.01:
            raise LaunchError(f"[input.calibration] orientation: expected a unit quaternion, got {self.orientation}")
        if bool(self.size) != bool(self.focal) or bool(self.size) != bool(self.centre):
            raise LaunchError("[input.calibration] expected size, focal and centre of a lens, or none of them")
        if any(value <= 0 for value in (*self.size, *self.focal)):
            raise LaunchError(f"[input.calibration] expected a size and focal above 0, got {self.size}, {self.focal}")

    @property
    def pose(self) -> Pose | None:
        """Of the camera in the world, if it is calibrated."""
        return Pose(np.array(self.position), np.array(self.orientation)) if self.position else None
