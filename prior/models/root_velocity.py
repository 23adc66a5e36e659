"""Live prediction of a body's root velocity from its own motion (HM-VAE, section 3.3), without torch.

A recurrent network replaces the paper's convolutions over the skeleton and 25 frames; it is smaller and faster.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.models.layers import LiveRecurrent
from steadypose.prior.models.weights import Arrays, load_weights
from steadypose.prior.timing.rate import FPS

FRAME_S = 1.0 / FPS  # time between the network's frames, seconds
FEATURES = 22 * 6  # number of features of a frame: each joint's position and velocity relative to the root
FROM_ROOT, SPEED, FASTEST = 0.5, 2.0, 6.0  # unit of positions, metres, and unit and clipping bound of velocities, m/s


@dataclass(frozen=True)
class TrajectoryConfig:
    """The size of the network, and its errors on validation."""

    hidden: int = 128  # size of a body's hidden state
    sigma_scale: tuple[float, float] = (1.0, 1.0)
    """(horizontal, vertical) error-to-sigma ratio of the predicted velocity"""
    correlation_s: tuple[float, float] = (FRAME_S, FRAME_S)
    """(horizontal, vertical) seconds, correlation time of the velocity's error: twice the integral of its normalised
    autocorrelation"""

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> TrajectoryConfig:
        """Build the configuration from the JSON of a weights file."""
        pairs = {name: tuple(config[name]) for name in ("sigma_scale", "correlation_s")}
        return cls(**{**config, **pairs})


class NewestMotion(NamedTuple):
    """The network's output for a frame, in the frame of its input."""

    velocity: Floats32  # (B, 3) m/s, velocity of the root
    log_sigma: Floats32  # (B, 3) logarithm of the velocity's standard deviation along each axis, in m/s
    state: Floats32  # (B, hidden) hidden state for the next frame


def velocity_features(joints: Floats, before: Floats, dt: Floats | float, yaw: Floats) -> Floats32:
    """Build the features (B, `FEATURES`) of B frames, turned by their heading (B,) so that each body faces +x.

    ``joints`` and ``before``, those in the frame ``dt`` seconds before, are (B, 22, 3) metres relative to the root, z
    up.
    """
    turn, step = yaw_matrix(yaw), np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(joints),))[:, None, None]
    velocity = np.clip((joints - before) / step @ turn, -FASTEST, FASTEST) / SPEED
    features = np.concatenate([joints @ turn / FROM_ROOT, velocity], axis=-1)
    return features.reshape(len(joints), FEATURES).astype(np.float32)


class LiveRootVelocity:
    """A trained `TrajectoryNet`."""

    def __init__(self, config: TrajectoryConfig, weights: Arrays) -> None:
        self.config = config
        self._net = LiveRecurrent(weights, "motion")

    @classmethod
    def load(cls, weights: str) -> LiveRootVelocity:
        """Load the weights of this name; raises like `load_weights`."""
        arrays, config = load_weights(weights, "trajectory")
        return cls(TrajectoryConfig.from_dict(config), arrays)

    def start(self, count: int) -> Floats32:
        """(count, hidden) hidden states of bodies before their first frame."""
        return np.zeros((count, self._net.hidden), dtype=np.float32)

    def __call__(self, features: Floats32, state: Floats32) -> NewestMotion:
        """Process one frame: `velocity_features` (B, `FEATURES`) and hidden states (B, hidden)."""
        outputs, state = self._net(features, state)
        return NewestMotion(outputs[:, :3], outputs[:, 3:6], state)
