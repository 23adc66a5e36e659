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

The pelvis is a rigid part of the body that carries both hips and the lowest joint of the spine. The line to the chest,
three times as long, is less noisy, but bends with the spine: motion files turn their pelvis by 0.9 degrees (median)
otherwise than the rigid part, and by 3.4 otherwise than hips and chest (validation people).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import from_rotation_vectors, to_rotation_vectors
from steadypose.prior.body.skeleton import HIPS, PARENT, REST_OFFSETS, SHOULDERS, J
from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import Arrays, load_weights

DIMENSIONS, TURNS = 66, 3
UNLIKE = 0.01
"""Standard deviation along an axis by which any joint may differ from what training people do, metres."""

MIN_SIGMA, MAX_SIGMA = 1e-5, 0.5
"""Bounds of a joint's standard deviation, metres; one that is not known has the largest."""

LENGTH_SIGMA = 0.01
"""Standard deviation of a person's bone lengths, assumed, metres."""
_ROUNDS = 2

LEAST_SIGMA = math.radians(0.5)
"""Least standard deviation of a root about an axis, whatever the sensor, radians."""

WITHIN = np.radians((1.5, 4.0, 5.0))
"""Standard deviations about the pelvis' axes of its turn from what a known body's posture shows, radians."""

DEPENDENT = 1.7
"""Factor on the covariance of the average of the two estimates, which share most of their noise (validation people)."""

_CORNERS = (*HIPS, *SHOULDERS)
_REST_SIZE = float(np.linalg.norm(REST_OFFSETS, axis=-1).sum())

_CARRIED = (*HIPS, J["spine1"])
_LEAST = 1e-6
"""Moment added to those of a body whose bones may have no length, square metres."""


class Expected(NamedTuple):
    """Of B bodies.

    Attributes:
        positions: (B, 22, 3) metres.
        root: (B, 3, 3) orientations of the pelvis.
        root_covariance: (B, 3, 3) rad² about the pelvis' axes, as far as the noise of joints causes it.
    """

    positions: Floats
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
        frame, middle, size = trunk_frame(positions), positions[:, list(_CORNERS)].mean(axis=1), body_size(offsets)
        scale = size[:, None, None]
        local = (positions - middle[:, None]) @ frame / scale
        noise = np.repeat(np.square(np.fmax(np.fmin(sigma, MAX_SIGMA), MIN_SIGMA) / size[:, None]), 3, axis=1)
        off, left = local.reshape(len(local), -1) - self._mean, np.empty((len(local), DIMENSIONS, DIMENSIONS))
        _condition(self._covariance, noise, off, left)
        local = (self._mean + off).reshape(local.shape)
        expected, left = on_bones(local * scale, left * scale**2, np.linalg.norm(offsets[:, 1:], axis=-1))
        off = (expected / scale).reshape(len(local), -1) - self._mean
        root = frame @ from_rotation_vectors(self._turn + off @ self._turned_by.T)
        turned = self._turned_by @ left @ self._turned_by.T / scale**2
        return Expected(expected @ frame.swapaxes(-1, -2) + middle[:, None], root, turned)


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


@njit(cache=True)
def _condition(covariance, noise, off, left):
    """A Gaussian of ``covariance`` (66, 66) about 0, given ``off`` (B, 66), observed with variances ``noise`` (B, 66).

    Observation by observation, as their errors are independent. Writes the expectation to ``off``, and the covariance
    to ``left`` (B, 66, 66).
    """
    column, expected = np.empty(DIMENSIONS), np.empty(DIMENSIONS)
    for b in range(len(off)):
        for i in range(DIMENSIONS):
            expected[i] = 0.0
            for j in range(DIMENSIONS):
                left[b, i, j] = covariance[i, j]
        for k in range(DIMENSIONS):
            innovation, variance = off[b, k] - expected[k], left[b, k, k] + noise[b, k]
            for i in range(DIMENSIONS):
                column[i] = left[b, k, i]
            for i in range(DIMENSIONS):
                gain = column[i] / variance
                expected[i] += gain * innovation
                for j in range(DIMENSIONS):
                    left[b, i, j] -= gain * column[j]
        for i in range(DIMENSIONS):
            off[b, i] = expected[i]


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
    given, left = mean.copy(), covariance.copy()
    _on_bones(mean, covariance, lengths, given, left)
    return given, left


@njit(cache=True)
def _on_bones(prior, covariance, lengths, mean, left):
    """As `on_bones`; ``mean`` and ``left`` come as ``prior`` and ``covariance``, and leave as results.

    With the Cholesky factor L of the innovations' covariance, `across` and `off` are kept as L^-1 of themselves: their
    product is then the gain times the innovation, and the square of `across` what lengths take off the covariance.
    """
    bones = lengths.shape[1]
    slope, off, across = np.empty((bones, 3)), np.empty(bones), np.empty((bones, DIMENSIONS))
    factor = np.empty((bones, bones))
    for b in range(len(prior)):
        for _ in range(_ROUNDS):
            for k in range(bones):
                joint, above = k + 1, PARENT[k + 1]
                square = 0.0
                for axis in range(3):
                    slope[k, axis] = mean[b, joint, axis] - mean[b, above, axis]
                    square += slope[k, axis] ** 2
                length = max(math.sqrt(square), 1e-6)
                off[k] = lengths[b, k] - length
                for c in range(DIMENSIONS):
                    across[k, c] = 0.0
                for axis in range(3):
                    along = slope[k, axis] = slope[k, axis] / length
                    moved = mean[b, joint, axis] - prior[b, joint, axis]
                    off[k] += along * (moved - mean[b, above, axis] + prior[b, above, axis])
                    for c in range(DIMENSIONS):
                        across[k, c] += along * (
                            covariance[b, 3 * joint + axis, c] - covariance[b, 3 * above + axis, c]
                        )
            for k in range(bones):
                for j in range(k + 1):
                    entry = LENGTH_SIGMA**2 if j == k else 0.0
                    for axis in range(3):
                        entry += slope[j, axis] * (across[k, 3 * j + 3 + axis] - across[k, 3 * PARENT[j + 1] + axis])
                    factor[k, j] = entry
            for k in range(bones):
                for j in range(k + 1):
                    entry = factor[k, j]
                    for i in range(j):
                        entry -= factor[k, i] * factor[j, i]
                    factor[k, j] = entry / factor[j, j] if j < k else math.sqrt(entry)
                for j in range(k):
                    off[k] -= factor[k, j] * off[j]
                    for c in range(DIMENSIONS):
                        across[k, c] -= factor[k, j] * across[j, c]
                off[k] /= factor[k, k]
                for c in range(DIMENSIONS):
                    across[k, c] /= factor[k, k]
            for joint in range(mean.shape[1]):
                for axis in range(3):
                    mean[b, joint, axis] = prior[b, joint, axis]
                    for k in range(bones):
                        mean[b, joint, axis] += across[k, 3 * joint + axis] * off[k]
        for k in range(bones):
            for row in range(DIMENSIONS):
                for c in range(DIMENSIONS):
                    left[b, row, c] -= across[k, row] * across[k, c]


def trunk_frame(positions: Floats) -> Floats:
    """Axes forward, left, up as columns (B, 3, 3), of hips and shoulders of joints (B, 22, 3)."""
    frame = np.empty((len(positions), 3, 3))
    _trunk_frame(np.ascontiguousarray(positions), frame)
    return frame


@njit(cache=True)
def _trunk_frame(positions, frame):
    up, left = np.empty(3), np.empty(3)
    left_hip, right_hip, left_shoulder, right_shoulder = _CORNERS
    for row in range(len(positions)):
        p = positions[row]
        for axis in range(3):
            up[axis] = p[left_shoulder, axis] + p[right_shoulder, axis] - p[left_hip, axis] - p[right_hip, axis]
            left[axis] = p[left_shoulder, axis] - p[right_shoulder, axis] + p[left_hip, axis] - p[right_hip, axis]
        _to_unit(up)
        along = left[0] * up[0] + left[1] * up[1] + left[2] * up[2]
        for axis in range(3):
            left[axis] -= along * up[axis]
        _to_unit(left)
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            frame[row, axis, 0] = left[a] * up[b] - left[b] * up[a]
            frame[row, axis, 1], frame[row, axis, 2] = left[axis], up[axis]


@njit(cache=True)
def _to_unit(vector):
    length = max(math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2), 1e-9)
    for axis in range(3):
        vector[axis] /= length


def body_size(offsets: Floats) -> Floats:
    """(B,) the sum of bones (B, 22, 3), relative to the rest skeleton's."""
    return np.linalg.norm(offsets, axis=-1).sum(axis=-1) / _REST_SIZE


def rigid_pelvis(positions: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) the rotation of the pelvis' bones (B, 22, 3) that lies nearest to its joints (B, 22, 3) (Kabsch)."""
    seen = positions[:, list(_CARRIED)] - positions[:, :1]
    u, _, vt = np.linalg.svd(seen.swapaxes(-1, -2) @ offsets[:, list(_CARRIED)])
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def rigid_covariance(sigma: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) rad², in the pelvis' own axes, of `rigid_pelvis` of joints with deviations ``sigma`` (B, 22) metres.

    To first order the rotation vector is M^-1 sum(b x e), of bones b and errors e, where M = sum(|b|² I - b b^T).
    """
    moved, moments = np.empty((2, len(offsets), 3, 3))
    _moments(sigma, offsets, moved, moments)
    inverse = np.linalg.inv(moments)
    return inverse @ moved @ inverse


@njit(cache=True)
def _moments(sigma, offsets, moved, moments):
    """Write the sums over bones b of |b|² I - b b^T, by the errors of joints and as they are."""
    whole = np.empty(3)  # the pelvis' own error is in all bones
    for row in range(len(offsets)):
        for i in range(3):
            whole[i] = 0.0
            for joint in _CARRIED:
                whole[i] += offsets[row, joint, i]
            for j in range(3):
                moved[row, i, j], moments[row, i, j] = 0.0, _LEAST if i == j else 0.0
        _add_moment(whole, sigma[row, 0] ** 2, moved[row])
        for joint in _CARRIED:
            _add_moment(offsets[row, joint], sigma[row, joint] ** 2, moved[row])
            _add_moment(offsets[row, joint], 1.0, moments[row])


@njit(cache=True)
def _add_moment(bone, weight, moments):
    square = bone[0] ** 2 + bone[1] ** 2 + bone[2] ** 2
    for i in range(3):
        for j in range(3):
            moments[i, j] -= weight * bone[i] * bone[j]
        moments[i, i] += weight * square
