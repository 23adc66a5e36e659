"""Key points of one person in one camera's image, with what it measures in depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats

NEAREST, FARTHEST = 0.05, 100.0
"""Range of distances of a point from the camera, in metres."""


@dataclass(frozen=True)
class KeyPointRecording:
    """One person's key points at the times of a 30 Hz grid, in canonical joints.

    Attributes:
        stamps_ns: (T,) of the grid.
        pixels: (T, 22, 2); NaN where not found.
        confidence: (T, 22).
        focal: (2,) pixels.
        centre: (2,) pixels.
        rotation: (3, 3) from the camera's frame to one that is z up.
        camera_height: metres; None where not known.
        points: (T, N, 3) metres, in the camera's frame; None where there are none.
    """

    stamps_ns: NDArray[np.int64]
    pixels: Floats
    confidence: Floats
    focal: Floats
    centre: Floats
    rotation: Floats
    camera_height: float | None
    points: Floats | None


def in_sight(points: Floats) -> Floats:
    """Points (T, N, 3) metres from a depth camera, NaN where none can see them: at its place, where many put what they
    have no depth of, or too far away."""
    away = np.linalg.norm(np.where(np.isfinite(points), points, np.inf), axis=-1, keepdims=True)
    return np.where((away > NEAREST) & (away < FARTHEST), points, np.nan)
