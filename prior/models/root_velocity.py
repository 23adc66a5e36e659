"""Root velocity of the newest frame as the live node asks for it: `TrajectoryNet`, without torch.

Frames that the last one does not depend on are left out; pooling, which is linear, is folded into the convolution
before it, and the convolution is a product of matrices: for so few frames, a library's convolutions are slower.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats32
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.layers import dense, leaky_relu, mix_edges, pool_matrix, pooling_levels
from steadypose.prior.models.weights import Arrays, load_weights, part
from steadypose.prior.timing.rate import FPS

FRAME_S = 1.0 / FPS
"""Seconds between the frames that the network sees."""

JOINT_FEATURES = 6
"""A joint's features: position and velocity."""

OUTPUTS = 6
"""Velocity and logarithm of its standard deviation; the network's other outputs, contacts, only train it."""

CHANNELS = (JOINT_FEATURES, 6, 12, 24, 48)
"""of an edge, before the first convolution and after each"""


@dataclass(frozen=True)
class TrajectoryConfig:
    """The size of the network, and what validation measured of its errors.

    Attributes:
        kernel: frames that each of the four convolutions sees.
        sigma_scale: (horizontal, vertical) by which the predicted standard deviation is too small.
        correlation_s: (horizontal, vertical) seconds for which an error of the velocity lasts: twice the integral of
            its normalised autocorrelation.
    """

    kernel: int = 7
    sigma_scale: tuple[float, float] = (1.0, 1.0)
    correlation_s: tuple[float, float] = (FRAME_S, FRAME_S)

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> TrajectoryConfig:
        """From the JSON of a weights file."""
        pairs = {name: tuple(config[name]) for name in ("sigma_scale", "correlation_s")}
        return cls(**{**config, **pairs})

    @property
    def context(self) -> int:
        """Frames that the newest output depends on."""
        return 4 * (self.kernel - 1) + 1


class NewestMotion(NamedTuple):
    """The network's output for the newest frame, in the frame of its input.

    Attributes:
        velocity: (B, 3) m/s, of the root.
        log_sigma: (B, 3) log of the standard deviation of that along each axis, m/s.
    """

    velocity: Floats32
    log_sigma: Floats32


class LiveRootVelocity:
    """A trained `TrajectoryNet` at the last frame only.

    Args:
        config: its size.
        weights: its state dict, which is folded.
    """

    def __init__(self, config: TrajectoryConfig, weights: Arrays) -> None:
        self.config = config
        self._layers = []
        for k, level in enumerate(pooling_levels(PARENTS)):
            conv, pool = part(weights, f"blocks.{k}.conv"), pool_matrix(level.groups)
            weight = mix_edges(pool, conv["weight"]).swapaxes(1, 2)  # (out, kernel, in): frames side by side
            self._layers.append((weight.reshape(len(weight), -1), mix_edges(pool, conv["bias"])))
        self._head = weights["head.weight"][:OUTPUTS], weights["head.bias"][:OUTPUTS]

    @classmethod
    def load(cls, weights: str) -> LiveRootVelocity:
        """From the weights of this name; raises as `load_weights`."""
        arrays, config = load_weights(weights, "trajectory")
        return cls(TrajectoryConfig.from_dict(config), arrays)

    def __call__(self, joints: NDArray[np.floating]) -> NewestMotion:
        """Of the last frame of joints (B, `context`, 22, 3), metres from the root, as `TrajectoryNet` takes them.

        The frame before the first is taken to have been the same.
        """
        joints = joints.astype(np.float32)
        velocity = np.diff(joints, axis=1, prepend=joints[:, :1]) / np.float32(FRAME_S)
        features = np.concatenate([joints, velocity], axis=-1).reshape(*joints.shape[:2], -1)
        for weight, bias in self._layers:
            taps = weight.shape[1] // features.shape[2]
            frames = features.shape[1] - taps + 1
            windows = np.stack([features[:, k : k + frames] for k in range(taps)], axis=2)
            features = leaky_relu(dense(windows.reshape(-1, weight.shape[1]), weight, bias))
            features = features.reshape(len(joints), frames, -1)
        weight, bias = self._head
        outputs = dense(features[:, 0], weight, bias)
        return NewestMotion(outputs[:, :3], outputs[:, 3:])
