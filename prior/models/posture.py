"""Where joints are, given how all of them lie to each other: a Gaussian of the body in its trunk's frame.

Joints of a trunk are all but rigid to each other, and limbs lie by it as people hold them. What is known of a noisy
joint is therefore the whole body's: of x ~ N(mean, S), seen as z = x + e with e ~ N(0, R), the expectation is
z - R (S + R)^-1 (z - mean) and the covariance R - R (S + R)^-1 R (ridge regression whose ridge is the noise; Bishop
2006, section 2.3.3). R is diagonal, each joint's own variance: a perfect joint stays, a hidden one follows the others.
Then come the lengths of the person's bones.

The frame is that of hips and shoulders, as noisy as they are: S holds a turn and a shift of it, in which no posture is
preferred. So a body may lie, or stand on its hands.

How the pelvis is turned in that frame is one more vector of the Gaussian, so that shoulders, spine and thighs show it
too. The root is averaged of this and of the pelvis' own joints: by these where they are exact, by the whole body where
they are noisy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import from_rotation_vectors, to_rotation_vectors
from steadypose.prior.body.pelvis import rigid_covariance, rigid_pelvis
from steadypose.prior.body.skeleton import HIPS, PARENT, REST_OFFSETS, SHOULDERS
from steadypose.prior.models.weights import Arrays, load_weights

DIMENSIONS, TURNS = 66, 3
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

WITHIN = np.radians((1.5, 4.0, 5.0))
"""Radians about the pelvis' axes, by which it is turned otherwise than the posture of a body says that is known."""

DEPENDENT = 1.7
"""Factor on the covariance of the average of the two estimates, which share most of their noise (validation people)."""

_CORNERS = [*HIPS, *SHOULDERS]
_REST_SIZE = float(np.linalg.norm(REST_OFFSETS, axis=-1).sum())


class Expected(NamedTuple):
    """Of B bodies.

    Attributes:
        positions: (B, 22, 3) metres.
        covariance: (B, 66, 66) m² of these, in the axes of ``frame``.
        frame: (B, 3, 3) forward, left and up of the trunk, as columns.
        root: (B, 3, 3) orientations of the pelvis.
        root_covariance: (B, 3, 3) rad² about the pelvis' axes, as far as the noise of joints causes it.
    """

    positions: Floats
    covariance: Floats
    frame: Floats
    root: Floats
    root_covariance: Floats


class LivePosture:
    """The Gaussian of `steadypose train posture`."""

    def __init__(self, weights: Arrays) -> None:
        factor = weights["factor"].astype(np.float64)
        whole, mean = factor @ factor.T, weights["mean"].astype(np.float64)
        self._mean, self._turn = mean[:DIMENSIONS], mean[DIMENSIONS:]
        self._covariance = whole[:DIMENSIONS, :DIMENSIONS] + UNLIKE**2 * np.eye(DIMENSIONS)
        self._turned_by = np.linalg.solve(self._covariance, whole[:DIMENSIONS, DIMENSIONS:]).T

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
        off = (expected / scale).reshape(len(local), -1) - self._mean
        root = frame @ from_rotation_vectors(self._turn + off @ self._turned_by.T)
        turned = self._turned_by @ left @ self._turned_by.T / scale**2
        return Expected(expected @ frame.swapaxes(-1, -2) + middle[:, None], left, frame, root, turned)


def average_root(expected: Expected, positions: Floats, sigma: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) orientations of the root: the posture's and that of the pelvis' own joints, by their covariances.

    Args:
        expected: of these bodies.
        positions: (B, 22, 3) metres, as observed.
        sigma: (B, 22) metres, their standard deviations along an axis.
        offsets: (B, 22, 3) metres, the bones.
    """
    known, rigid = expected.root_covariance + np.diag(WITHIN**2), _rigid_covariance(sigma, offsets)
    off = to_rotation_vectors(expected.root.swapaxes(-1, -2) @ rigid_pelvis(positions, offsets))
    share = known @ np.linalg.inv(known + rigid)
    return expected.root @ from_rotation_vectors((share @ off[..., None])[..., 0])


def _rigid_covariance(sigma: Floats, offsets: Floats) -> Floats:
    return rigid_covariance(np.fmax(np.fmin(sigma, MAX_SIGMA), MIN_SIGMA), offsets)


class RootCovariance:
    """The covariance of a root's orientation, of joints and deviations as published: no message has to carry it.

    Args:
        weights: the posture's weight set, or a path to a ``.safetensors`` file.
    """

    def __init__(self, weights: str = "default") -> None:
        self._posture = LivePosture.load(weights)

    def __call__(self, positions: Floats, sigma: Floats, root: Floats) -> Floats:
        """(B, 3, 3) rad², of rotations about the axes of the positions.

        Args:
            positions: (B, 22, 3) metres.
            sigma: (B, 22) metres, standard deviations along an axis.
            root: (B, 3, 3) orientations of the pelvis.
        """
        bones = positions - positions[:, PARENT]
        bones[:, 0] = 0.0
        known = self._posture(positions, sigma, bones).root_covariance + np.diag(WITHIN**2)
        rigid = _rigid_covariance(sigma, bones @ root)
        covariance = DEPENDENT * known @ np.linalg.inv(known + rigid) @ rigid + LEAST_SIGMA**2 * np.eye(3)
        return root @ covariance @ root.swapaxes(-1, -2)


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
