"""The values that steps of the pipeline take, made by hand."""

import numpy as np

from steadypose.prior.clean.frame import Gated, Observation


def observation(positions: np.ndarray, stamp_s: float = 0.0, confidence: np.ndarray | None = None) -> Observation:
    """Of bodies (S, 22, 3) that are all there."""
    return Observation(
        stamp_s=stamp_s,
        positions=positions,
        confidence=np.ones(positions.shape[:2]) if confidence is None else confidence,
        present=np.ones(len(positions), dtype=bool),
        sensor_position=np.zeros(3),
    )


def gated(positions: np.ndarray, stamp_s: float = 0.0) -> Gated:
    """Bodies (S, 22, 3) that are all there, as they came."""
    frozen = np.zeros(positions.shape[:2], dtype=bool)
    return Gated(observation(positions, stamp_s), positions, np.zeros(len(positions)), frozen)
