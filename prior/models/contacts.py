"""Live inference of the contact network without torch, and its features, which training shares."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT, yaw_matrix
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.models.layers import LiveRecurrent, sigmoid
from steadypose.prior.models.weights import Arrays, load_weights

OF_JOINT = 12
"""Number of features of a joint: position (3) and velocity (3) relative to the root, height, velocity (3), standard
deviation, known flag."""

OF_BODY = 2  # number of features of a body: whether the root is observed, and whether the ground is known
FEATURES = OF_JOINT * len(CONTACT_JOINTS) + OF_BODY  # number of features of a frame
FROM_ROOT, FASTEST = 0.5, 3.0  # unit of positions, metres, and unit and clipping bound of velocities, m/s
HEIGHT, HIGHEST = 0.1, 0.6  # unit and clipping bound of heights, metres

SIGMA, MIN_SIGMA, MAX_SIGMA = 0.01, 1e-3, 1.0
"""Unit and range of standard deviations, which enter by their logarithm, metres."""

_JOINTS = list(CONTACT_JOINTS)


def contact_features(
    positions: NDArray[np.floating],
    before: NDArray[np.floating],
    dt: Floats | float,
    yaw: NDArray[np.floating],
    sigma: NDArray[np.floating],
    root_observed: Floats,
    ground: Floats,
) -> Floats32:
    """Build the features (B, `FEATURES`) of B frames.

    Args:
        positions: (B, 22, 3) metres, world; NaN for unknown joints, such as a hidden root.
        before: (B, 22, 3) metres, positions in the frame before.
        dt: (B,) or a number, seconds between the two frames.
        yaw: (B,) radians, heading of the body.
        sigma: (B, 22) metres, standard deviations.
        root_observed: (B,) 1 if both frames have world positions, 0 if only positions relative to the root.
        ground: (B, 8) metres, world, height of the ground under each of `CONTACT_JOINTS`; NaN where unknown.
    """
    joints, joints_before = positions[:, _JOINTS], before[:, _JOINTS]
    known = finite_joints(joints) & finite_joints(joints_before)
    step = np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(positions),))[:, None, None]
    back = yaw_matrix(yaw)  # p @ back turns p so that the body faces +x
    from_root, from_root_before = joints - positions[:, :1], joints_before - before[:, :1]
    observed = root_observed[:, None, None] > 0
    velocity = np.where(observed, (joints - joints_before) / step, np.nan)
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
    of_body = np.stack([root_observed, np.isfinite(ground).any(axis=1).astype(float)], axis=1)
    return np.concatenate([of_joints.reshape(len(positions), -1), of_body], axis=1).astype(np.float32)


class Contacts(NamedTuple):
    """Contacts of B bodies at `CONTACT_JOINTS`."""

    load: Floats32  # (B, 8) probabilities that the joints bear load
    rest: Floats32  # (B, 8) probabilities that the joints rest on their support
    state: Floats32  # (B, hidden) hidden state for the next frame


class LiveContacts:
    """A trained `ContactNet`.

    Attributes:
        hidden: size of a body's hidden state, which is zero before the first frame.
    """

    def __init__(self, weights: Arrays) -> None:
        self._net = LiveRecurrent(weights, "unit")
        self.hidden = self._net.hidden

    @classmethod
    def load(cls, weights: str) -> LiveContacts:
        """Load the weights of this name; raises like `load_weights`."""
        return cls(load_weights(weights, "contacts")[0])

    def __call__(self, features: Floats32, state: Floats32) -> Contacts:
        """Process one frame: features (B, `FEATURES`) and hidden states (B, `hidden`)."""
        outputs, state = self._net(features, state)
        predicted = sigmoid(outputs)
        return Contacts(predicted[:, : len(CONTACT_JOINTS)], predicted[:, len(CONTACT_JOINTS) :], state)
