"""Where joints are, given how all of them lie to each other: a Gaussian of the body in its trunk's frame.

Joints of a trunk are all but rigid to each other, and limbs lie by it as people hold them. What is known of a noisy
joint is therefore the whole body's: of x ~ N(mean, S), seen as z = x + e with e ~ N(0, R), the expectation is
z - R (S + R)^-1 (z - mean) and the covariance R - R (S + R)^-1 R (ridge regression whose ridge is the noise; Bishop
2006, section 2.3.3). R is diagonal, each joint's own variance: a perfect joint stays, a hidden one follows the others.
Then come the lengths of the person's bones.

The frame is that of hips and shoulders, as noisy as they are: S holds a turn and a shift of it, in which no posture is
preferred. So a body may lie, or stand on its hands.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, PARENT, REST_OFFSETS, SHOULDERS, J
from steadypose.prior.models.weights import Arrays, load_weights

DIMENSIONS = 66
UNLIKE = 0.01
"""Metres along an axis, by which any joint may differ from what training people do."""

MIN_SIGMA, MAX_SIGMA = 1e-5, 0.5
"""Metres: bounds of a joint's standard deviation; one that is not known has the largest."""

LENGTH_SIGMA = 0.01
"""Metres: assumed error of a person's bone lengths."""
_ROUNDS = 2
_ENDS = np.arange(1, len(PARENT))

LEAST_SIGMA = math.radians(0.5)
"""Radians about an axis: lower bound of a root's deviation, whatever the sensor."""

_SPINE = J["spine3"]
_LEAST_UP = 0.05
"""Metres that the spine rises above the hips: of a body folded up, it says little of how that is turned about them."""

_CORNERS = [*HIPS, *SHOULDERS]
_REST_SIZE = float(np.linalg.norm(REST_OFFSETS, axis=-1).sum())


class Expected(NamedTuple):
    """Of B bodies.

    Attributes:
        positions: (B, 22, 3) metres.
        covariance: (B, 66, 66) m² of these, in the axes of ``frame``.
        frame: (B, 3, 3) forward, left and up of the trunk, as columns.
    """

    positions: Floats
    covariance: Floats
    frame: Floats


class LivePosture:
    """The Gaussian of `steadypose train posture`."""

    def __init__(self, weights: Arrays) -> None:
        factor = weights["factor"].astype(np.float64)
        self._mean = weights["mean"].astype(np.float64)
        self._covariance = factor @ factor.T + UNLIKE**2 * np.eye(DIMENSIONS)

    @classmethod
    def load(cls, weights: str) -> LivePosture:
        """From the weights of this name; raises as `load_weights`."""
        return cls(load_weights(weights, "posture")[0])

    def __call__(self, positions: Floats, sigma: Floats, offsets: Floats) -> Expected:
        """What to expect of joints (B, 22, 3) metres, each with an error of ``sigma`` (B, 22) metres along an axis, of
        people with bones ``offsets`` (B, 22, 3)."""
        frame, middle, size = trunk_frame(positions), positions[:, _CORNERS].mean(axis=1), body_size(offsets)
        scale = size[:, None, None]
        local = (positions - middle[:, None]) @ frame / scale
        noise = np.repeat(np.square(np.fmax(np.fmin(sigma, MAX_SIGMA), MIN_SIGMA) / size[:, None]), 3, axis=1)
        seen = self._covariance + noise[:, :, None] * np.eye(DIMENSIONS)
        off = local.reshape(len(local), -1) - self._mean
        gain = np.linalg.inv(seen)
        moved = (noise * (gain @ off[..., None])[..., 0]).reshape(local.shape)
        left = noise[:, :, None] * (np.eye(DIMENSIONS) - gain * noise[:, None, :])
        expected, left = on_bones((local - moved) * scale, left * scale**2, np.linalg.norm(offsets[:, 1:], axis=-1))
        return Expected(expected @ frame.swapaxes(-1, -2) + middle[:, None], left, frame)


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


def on_bones(mean: Floats, covariance: Floats, lengths: Floats) -> tuple[Floats, Floats]:
    """Joints given the lengths of bones, by an extended Kalman filter's update, iterated (Bell and Cathey 1993).

    A length says nothing across its bone, but a joint's error across one bone lies along another.

    Args:
        mean: (B, 22, 3) metres.
        covariance: (B, 66, 66) m².
        lengths: (B, 21) metres, of each joint's bone but the root's, known to `LENGTH_SIGMA`.

    Returns:
        Mean and covariance, given these.
    """
    prior, left = mean.reshape(len(mean), DIMENSIONS), covariance
    slope = np.zeros((len(mean), len(_ENDS), *mean.shape[1:]))
    for _ in range(_ROUNDS):
        bone = mean[:, 1:] - mean[:, PARENT[1:]]
        length = np.maximum(np.linalg.norm(bone, axis=-1), 1e-6)
        slope[:, _ENDS - 1, _ENDS] = bone / length[..., None]
        slope[:, _ENDS - 1, PARENT[1:]] = -bone / length[..., None]
        flat = slope.reshape(len(mean), -1, DIMENSIONS)
        across = flat @ covariance
        innovation = across @ flat.swapaxes(-1, -2) + LENGTH_SIGMA**2 * np.eye(len(_ENDS))
        gain = np.linalg.solve(innovation, across).swapaxes(-1, -2)
        off = lengths - length + (flat @ (mean.reshape(prior.shape) - prior)[..., None])[..., 0]
        mean = (prior + (gain @ off[..., None])[..., 0]).reshape(mean.shape)
        left = covariance - gain @ across
    return mean, left


def trunk_frame(positions: Floats) -> Floats:
    """Axes forward, left, up as columns (B, 3, 3), of hips and shoulders of joints (B, 22, 3)."""
    left_hip, right_hip, left_shoulder, right_shoulder = positions[:, _CORNERS].swapaxes(0, 1)
    up = _unit(left_shoulder + right_shoulder - left_hip - right_hip)
    left = left_shoulder - right_shoulder + left_hip - right_hip
    left = _unit(left - (left * up).sum(axis=-1, keepdims=True) * up)
    return np.stack([np.cross(left, up), left, up], axis=-1)


def body_size(offsets: Floats) -> Floats:
    """(B,) the sum of bones (B, 22, 3), relative to the rest skeleton's."""
    return np.linalg.norm(offsets, axis=-1).sum(axis=-1) / _REST_SIZE


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
