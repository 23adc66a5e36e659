"""Root velocity of a body, read from its own motion (HM-VAE, section 3.3), as the live node runs it, without torch.

A recurrent network takes the place of the paper's convolutions over the skeleton, which saw 25 frames: it is smaller,
takes less than half the time, and strays less on validation people, as much on test people (benchmarks/NOTEBOOK.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.models.recurrent import LiveRecurrent
from steadypose.prior.models.weights import Arrays, load_weights
from steadypose.prior.timing.rate import FPS

FRAME_S = 1.0 / FPS
"""Seconds between the frames that the network sees."""

FEATURES = 22 * 6
"""Numbers of a frame: place from the root and velocity against it, of each joint."""

FROM_ROOT, SPEED, FASTEST = 0.5, 2.0, 6.0
"""Metres and m/s by which places and velocities are divided, and m/s at which velocities are clipped."""


@dataclass(frozen=True)
class TrajectoryConfig:
    """The size of the network, and what validation measured of its errors.

    Attributes:
        hidden: numbers that the network remembers of a body.
        sigma_scale: (horizontal, vertical) by which the predicted standard deviation is too small.
        correlation_s: (horizontal, vertical) seconds for which an error of the velocity lasts: twice the integral of
            its normalised autocorrelation.
    """

    hidden: int = 128
    sigma_scale: tuple[float, float] = (1.0, 1.0)
    correlation_s: tuple[float, float] = (FRAME_S, FRAME_S)

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> TrajectoryConfig:
        """From the JSON of a weights file."""
        pairs = {name: tuple(config[name]) for name in ("sigma_scale", "correlation_s")}
        return cls(**{**config, **pairs})


class NewestMotion(NamedTuple):
    """The network's output for a frame, in the frame of its input.

    Attributes:
        velocity: (B, 3) m/s, of the root.
        log_sigma: (B, 3) log of the standard deviation of that along each axis, m/s.
        state: (B, hidden) what to remember for the next frame.
    """

    velocity: Floats32
    log_sigma: Floats32
    state: Floats32


def velocity_features(joints: Floats, before: Floats, dt: Floats | float, yaw: Floats) -> NDArray[np.float32]:
    """(B, `FEATURES`) of B frames, turned so that each body faces +x.

    Args:
        joints: (B, 22, 3) metres from the root, z up.
        before: (B, 22, 3) the same of the frame before.
        dt: (B,) or a number, seconds between them.
        yaw: (B,) radians, where the body looks.
    """
    turn, step = yaw_matrix(yaw), np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(joints),))[:, None, None]
    velocity = np.clip((joints - before) / step @ turn, -FASTEST, FASTEST) / SPEED
    features = np.concatenate([joints @ turn / FROM_ROOT, velocity], axis=-1)
    return features.reshape(len(joints), FEATURES).astype(np.float32)


class LiveRootVelocity:
    """A trained `TrajectoryNet`.

    Args:
        config: its size and errors.
        weights: its state dict.
    """

    def __init__(self, config: TrajectoryConfig, weights: Arrays) -> None:
        self.config = config
        self._net = LiveRecurrent(weights, "motion")

    @classmethod
    def load(cls, weights: str) -> LiveRootVelocity:
        """From the weights of this name; raises as `load_weights`."""
        arrays, config = load_weights(weights, "trajectory")
        return cls(TrajectoryConfig.from_dict(config), arrays)

    def start(self, count: int) -> Floats32:
        """(count, hidden) what is remembered of bodies before their first frame."""
        return np.zeros((count, self._net.hidden), dtype=np.float32)

    def __call__(self, features: NDArray[np.float32], state: Floats32) -> NewestMotion:
        """One frame: `velocity_features` (B, `FEATURES`) and what was remembered, (B, hidden)."""
        outputs, state = self._net(features, state)
        return NewestMotion(outputs[:, :3], outputs[:, 3:6], state)
