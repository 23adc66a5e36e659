"""The contact network as the live node runs it, without torch, and its features, which training shares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.models.recurrent import LiveRecurrent, sigmoid
from steadypose.prior.models.weights import Arrays, load_weights

OF_JOINT = 12
"""Features of a joint: from the root (3), velocity against the root (3), height, velocity (3), deviation, known."""

OF_BODY = 2
"""Whether the root is seen and whether the ground is known."""

FEATURES = OF_JOINT * len(CONTACT_JOINTS) + OF_BODY
"""Numbers of a frame."""

FROM_ROOT, FASTEST = 0.5, 3.0
"""Metres and m/s by which places and velocities are divided, and m/s at which velocities are clipped."""

HEIGHT, HIGHEST = 0.1, 0.6
"""Metres by which heights are divided, and at which they are clipped."""

SIGMA, MIN_SIGMA, MAX_SIGMA = 0.01, 1e-3, 1.0
"""Metres: the deviation whose logarithm is 0, and those at which it is clipped."""

_JOINTS = list(CONTACT_JOINTS)


def contact_features(
    positions: NDArray[np.floating],
    before: NDArray[np.floating],
    dt: Floats | float,
    yaw: NDArray[np.floating],
    sigma: NDArray[np.floating],
    root_seen: Floats,
    ground: Floats,
) -> NDArray[np.float32]:
    """(B, `FEATURES`) of B frames.

    Args:
        positions: (B, 22, 3) metres, world; NaN of joints that are not known: of a hidden root, say.
        before: (B, 22, 3) the same of the frame before.
        dt: (B,) or a number, seconds between them.
        yaw: (B,) radians, where the body looks.
        sigma: (B, 22) metres, standard deviations.
        root_seen: (B,) 1 where both frames are where they are seen in the world, 0 where only against the root.
        ground: (B, 8) metres, world, the height of the ground under each of `CONTACT_JOINTS`; NaN where not known.
    """
    joints, joints_before = positions[:, _JOINTS], before[:, _JOINTS]
    known = finite_joints(joints) & finite_joints(joints_before)
    step = np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(positions),))[:, None, None]
    cos, sin = np.cos(yaw), np.sin(yaw)
    back = np.zeros((len(positions), 3, 3))  # p @ back turns p so that the body faces +x
    back[:, 0, 0] = back[:, 1, 1] = cos
    back[:, 0, 1], back[:, 1, 0], back[:, 2, 2] = -sin, sin, 1.0
    from_root, from_root_before = joints - positions[:, :1], joints_before - before[:, :1]
    seen = root_seen[:, None, None] > 0
    velocity = np.where(seen, (joints - joints_before) / step, np.nan)
    height = joints[..., 2] - ground - REST_HEIGHT
    parts = [
        from_root @ back / FROM_ROOT,
        np.clip((from_root - from_root_before) / step @ back, -FASTEST, FASTEST),
        np.clip(height, -HIGHEST, HIGHEST)[..., None] / HEIGHT,
        np.clip(velocity @ back, -FASTEST, FASTEST),
        np.log(np.clip(sigma[:, _JOINTS], MIN_SIGMA, MAX_SIGMA) / SIGMA)[..., None],
        np.ones((*known.shape, 1)),
    ]
    of_joints = np.nan_to_num(np.concatenate(parts, axis=-1), nan=0.0) * known[..., None]
    of_body = np.stack([root_seen, np.isfinite(ground).any(axis=1).astype(float)], axis=1)
    return np.concatenate([of_joints.reshape(len(positions), -1), of_body], axis=1).astype(np.float32)


class Contacts(NamedTuple):
    """Of B bodies and `CONTACT_JOINTS`.

    Attributes:
        load: (B, 8) probabilities that they bear load.
        rest: (B, 8) that they stand still on what bears them.
        state: (B, hidden) what to remember for the next frame.
    """

    load: Floats32
    rest: Floats32
    state: Floats32


class LiveContacts:
    """A trained `ContactNet`.

    Attributes:
        hidden: numbers that it remembers of a body; zeros before the first frame.
    """

    def __init__(self, weights: Arrays) -> None:
        self._net = LiveRecurrent(weights, "unit")
        self.hidden = self._net.hidden

    @classmethod
    def load(cls, weights: str) -> LiveContacts:
        """From the weights of this name; raises as `load_weights`."""
        return cls(load_weights(weights, "contacts")[0])

    def __call__(self, features: NDArray[np.float32], state: NDArray[np.float32]) -> Contacts:
        """One frame: features (B, `FEATURES`) and what was remembered, (B, `hidden`)."""
        outputs, state = self._net(features, state)
        predicted = sigmoid(outputs)
        return Contacts(predicted[:, : len(CONTACT_JOINTS)], predicted[:, len(CONTACT_JOINTS) :], state)
