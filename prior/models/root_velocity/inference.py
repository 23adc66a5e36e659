"""Root velocity and contacts of the newest frame, as the live node asks for them: `TrajectoryNet`, without torch.

Frames that the last one does not depend on are left out; pooling, which is linear, is folded into the convolution
before it, and the convolution is a product of matrices: for so few frames, a library's convolutions are slower.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.layers.dense import Floats, dense, leaky_relu
from steadypose.prior.models.layers.edge_graph import mix_edges, pool_matrix, pooling_levels
from steadypose.prior.models.root_velocity.config import FRAME_S, TrajectoryConfig
from steadypose.prior.models.weights_io import Arrays, load_weights, part


class NewestMotion(NamedTuple):
    """What the network says of the newest frame, in the frame of its input.

    Attributes:
        velocity: (B, 3) m/s, of the root.
        log_sigma: (B, 3) log of the standard deviation of that along each axis, m/s.
        contact_logits: (B, 8) of `CONTACT_JOINTS`.
    """

    velocity: Floats
    log_sigma: Floats
    contact_logits: Floats


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
        self._head = weights["head.weight"], weights["head.bias"]

    @classmethod
    def load(cls, weights: str) -> LiveRootVelocity:
        """From the weights of this name.

        Raises:
            FileNotFoundError: there are none; says which there are.
        """
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
        return NewestMotion(outputs[:, :3], outputs[:, 3:6], outputs[:, 6:])
