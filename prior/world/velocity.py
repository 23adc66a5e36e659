"""Root velocity, predicted from a body's own motion (HM-VAE, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, velocity_features
from steadypose.prior.world.observe import BodyObservation

CAMERA_ERROR, CAMERA_MEMORY_S = 1.2, 0.3
"""Ratio of the velocity's error on poses from a camera to validation's on motion capture, and the least time constant
of it, seconds: chosen by how far hidden roots of validation people stray; on simulated streams half of an error was
still there after 0.5 s."""

SCALE_FACTOR_ERROR = 0.2
"""Standard deviation of the predicted speed's scale factor, which the network does not state."""


class RootVelocity(NamedTuple):
    """A body's root velocity as predicted, in the world.

    Attributes:
        velocity: (3,) m/s.
        sigma: (3,) m/s, standard deviation, as validation measured it.
    """

    velocity: Floats
    sigma: Floats


class MotionMemory:
    """What is kept of a body from frame to frame: its joints, and the network's state (hidden,)."""

    def __init__(self, hidden: int) -> None:
        self._hidden = hidden
        self.local: Floats | None = None
        self.state = np.zeros(hidden, dtype=np.float32)

    def update(self, observed: BodyObservation) -> tuple[Floats, Floats, float]:
        """Joints (22, 3) metres from the root, world axes, those of the frame before, and seconds between them.

        Motion begins anew after a gap. A joint without a position stays where it last was from the root.
        """
        before = self.local
        last = REST_POSITIONS @ yaw_matrix(observed.yaw).T if before is None else before
        local = observed.positions - observed.positions[0]
        self.local = local = np.where(np.isfinite(local), local, last)
        if before is None or observed.after_gap:
            self.state = np.zeros(self._hidden, dtype=np.float32)
            return local, local, FRAME_S
        return local, last, max(observed.dt, FRAME_S)


class VelocityNetwork:
    """Predicts the root velocity of all bodies of a message at once.

    Args:
        weights: the weight set, or a path to a ``.safetensors`` file.

    Attributes:
        memory_s: (3,) seconds, time constants of the velocity's errors.
    """

    def __init__(self, weights: str) -> None:
        self._net = LiveRootVelocity.load(weights)
        config, horizontal_first = self._net.config, [0, 0, 1]
        self._scale = CAMERA_ERROR * np.array(config.sigma_scale)[horizontal_first]
        self.memory_s = np.maximum(np.array(config.correlation_s)[horizontal_first] / 2.0, CAMERA_MEMORY_S)

    def memory(self) -> MotionMemory:
        """That of a new body."""
        return MotionMemory(self._net.config.hidden)

    def update(self, memories: Sequence[MotionMemory], observed: Sequence[BodyObservation]) -> list[RootVelocity]:
        """Of each body, by its memory, which takes in its observation."""
        if not observed:
            return []
        parts = zip(*(memory.update(each) for memory, each in zip(memories, observed, strict=True)), strict=True)
        local, before, dt = (np.array(part) for part in parts)
        yaw = np.array([each.yaw for each in observed])
        state = np.array([memory.state for memory in memories])
        velocity, log_sigma, states = self._net(velocity_features(local, before, dt, yaw), state)
        for memory, after in zip(memories, states, strict=True):
            memory.state = after
        variance = np.exp(2.0 * log_sigma)
        variance[:, :2] = variance[:, :2].mean(axis=1, keepdims=True)  # the filter's noise must not know the heading
        speed = np.linalg.norm(velocity[:, :2], axis=1, keepdims=True)
        sigma = np.hypot(np.sqrt(variance) * self._scale, SCALE_FACTOR_ERROR * speed)
        return [RootVelocity(yaw_matrix(o.yaw) @ v, s) for o, v, s in zip(observed, velocity, sigma, strict=True)]
