"""Root velocity, predicted from a body's own motion (HM-VAE, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity
from steadypose.prior.world.observe import BodyObservation

CAMERA_ERROR, CAMERA_MEMORY_S = 2.0, 0.3
"""Ratio of the velocity's error on poses from a camera to validation's on motion capture, and the least time constant
of it, seconds: on simulated streams 0.2 m/s where 0.1 was stated, half of it still there after 0.5 s, and not the same
in all streams."""

SCALE_FACTOR_ERROR = 0.35
"""Standard deviation of the predicted speed's scale factor, which the network does not state: a runner, of whom
training has none, is predicted a third too slow."""


class RootVelocity(NamedTuple):
    """A body's root velocity as predicted, in the world.

    Attributes:
        velocity: (3,) m/s.
        sigma: (3,) m/s, standard deviation, as validation measured it.
    """

    velocity: Floats
    sigma: Floats


class MotionWindow:
    """The last frames of a body, at the network's rate; ``context`` of them."""

    def __init__(self, context: int) -> None:
        self._context, self._newest_ns = context, 0
        self._frames: Floats | None = None

    def update(self, observed: BodyObservation) -> Floats:
        """(context, 22, 3) metres from the root, turned so that the body now faces +x.

        Motion is interpolated linearly between messages, and begins anew after a gap. A joint without a position stays
        where it last was from the root.
        """
        turn = yaw_matrix(observed.yaw)
        last = REST_POSITIONS @ turn.T if self._frames is None else self._frames[-1]
        local = observed.positions - observed.positions[0]
        local = np.where(np.isfinite(local), local, last)
        steps = round((observed.stamp_ns - self._newest_ns) * 1e-9 / FRAME_S)
        if self._frames is None or observed.after_gap:
            self._frames = np.repeat(local[None], self._context, axis=0)
        else:
            between = np.linspace(0.0, 1.0, steps + 1)[1:, None, None]
            self._frames = np.concatenate([self._frames, last + between * (local - last)])[-self._context :]
            self._frames[-1] = local
        if steps:
            self._newest_ns = observed.stamp_ns
        return self._frames @ turn


class VelocityNetwork:
    """Predicts the root velocity of all bodies of a message at once.

    Args:
        weights: the weight set, or a path to a ``.safetensors`` file.

    Attributes:
        context: frames of motion that it looks at.
        memory_s: (3,) seconds, time constants of the velocity's errors.
    """

    def __init__(self, weights: str) -> None:
        self._net = LiveRootVelocity.load(weights)
        config, horizontal_first = self._net.config, [0, 0, 1]
        self._scale = CAMERA_ERROR * np.array(config.sigma_scale)[horizontal_first]
        self.context = config.context
        self.memory_s = np.maximum(np.array(config.correlation_s)[horizontal_first] / 2.0, CAMERA_MEMORY_S)

    def update(self, windows: Sequence[MotionWindow], observed: Sequence[BodyObservation]) -> list[RootVelocity]:
        """Of each body, by its window, which takes in its observation."""
        if not observed:
            return []
        motion = np.stack([window.update(each) for window, each in zip(windows, observed, strict=True)])
        velocity, log_sigma = self._net(motion)
        variance = np.exp(2.0 * log_sigma)
        variance[:, :2] = variance[:, :2].mean(axis=1, keepdims=True)  # the filter's noise must not know the heading
        speed = np.linalg.norm(velocity[:, :2], axis=1, keepdims=True)
        sigma = np.hypot(np.sqrt(variance) * self._scale, SCALE_FACTOR_ERROR * speed)
        return [RootVelocity(yaw_matrix(o.yaw) @ v, s) for o, v, s in zip(observed, velocity, sigma, strict=True)]
