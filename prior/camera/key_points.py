"""Key points of one person in one camera's image, with the camera's depth measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats

NEAREST, FARTHEST = 0.05, 100.0  # range of distances of a point from the camera, metres


@dataclass(frozen=True)
class KeyPointRecording:
    """One person's key points at the times of a 30 Hz grid, in canonical joints."""

    stamps_ns: NDArray[np.int64]  # (T,) stamps of the grid, nanoseconds
    pixels: Floats  # (T, 22, 2); NaN where not detected
    confidence: Floats  # (T, 22) in 0..1
    focal: Floats  # (2,) focal lengths, pixels
    centre: Floats  # (2,) principal point, pixels
    rotation: Floats  # (3, 3) rotation from the camera's frame to a z-up frame
    camera_height: float | None  # metres above the floor; None if unknown
    points: Floats | None
    """(T, N, 3) metres, points of the body's surface in the camera's frame; None if there are none"""


def in_sight(points: Floats) -> Floats:
    """Set impossible points (T, N, 3) metres of a depth camera to NaN.

    These are points too far away, and points at the camera, where many cameras put pixels without depth.
    """
    away = np.linalg.norm(np.where(np.isfinite(points), points, np.inf), axis=-1, keepdims=True)
    return np.where((away > NEAREST) & (away < FARTHEST), points, np.nan)
