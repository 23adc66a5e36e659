"""How sure a root's orientation is, of joints and their deviations as published: no message has to carry it."""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, PARENT, J
from steadypose.prior.models.posture.inference import LivePosture

LEAST_SIGMA = math.radians(0.5)
"""Radians about an axis: no root is said to be better known, whatever the sensor."""

_SPINE = J["spine3"]
_LEAST_UP = 0.05
"""Metres that the spine rises above the hips: of a body folded up, it says little of how that is turned about them."""


class RootCovariance:
    """The covariance of a root's orientation, as the orient stage finds it.

    Args:
        weights: the posture's weight set, or a path to a ``.safetensors`` file.
    """

    def __init__(self, weights: str = "default") -> None:
        self._posture = LivePosture.load(weights)

    def __call__(self, positions: Floats, sigma: Floats, root: Floats) -> Floats:
        """(B, 3, 3) rad², of rotations about the axes of the positions.

        To first order: the left axis lies along the hips, l, and the up axis in the plane of the spine, u, from the
        pelvis. In the root's own axes an error of l turns it by (dl_z, ., -dl_x) / |l|, and one of u by
        (du_x + turn_z u_y) / u_z about the left axis.

        Args:
            positions: (B, 22, 3) metres.
            sigma: (B, 22) metres, standard deviations along an axis.
            root: (B, 3, 3) orientations of the pelvis.
        """
        bones = positions - positions[:, PARENT]
        bones[:, 0] = 0.0
        expected = self._posture(positions, sigma, bones)
        left = expected.positions[:, HIPS[0]] - expected.positions[:, HIPS[1]]
        spine = expected.positions[:, _SPINE] - expected.positions[:, 0]
        up = np.einsum("bij,bi->bj", root, spine)
        up_z = np.maximum(up[:, 2], _LEAST_UP)
        by_left, by_spine = np.zeros((2, len(root), 3, 3))
        by_left[:, 0, 2] = 1.0 / np.maximum(np.linalg.norm(left, axis=-1), 1e-3)
        by_left[:, 2, 0] = -by_left[:, 0, 2]
        by_left[:, 1, 0] = by_left[:, 2, 0] * up[:, 1] / up_z
        by_spine[:, 1, 0] = 1.0 / up_z
        turn = root.swapaxes(-1, -2) @ expected.frame
        jacobian = np.zeros((len(root), 3, 22, 3))
        jacobian[:, :, HIPS[0]], jacobian[:, :, _SPINE] = by_left @ turn, by_spine @ turn
        jacobian[:, :, HIPS[1]], jacobian[:, :, 0] = -jacobian[:, :, HIPS[0]], -jacobian[:, :, _SPINE]
        jacobian = root @ jacobian.reshape(len(root), 3, 66)
        return jacobian @ expected.covariance @ jacobian.swapaxes(-1, -2) + LEAST_SIGMA**2 * np.eye(3)
