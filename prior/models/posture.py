"""Posture prior: the positions of joints given each other, as a Gaussian of the whole body in the trunk's frame.

The joints of the trunk are almost rigid relative to each other, and limbs have typical postures. The position of a
noisy joint is therefore estimated from the whole body. For x ~ N(mean, S), observed as z = x + e with e ~ N(0, R), the
expectation is z - R (S + R)^-1 (z - mean) and the covariance is R - R (S + R)^-1 R. This is ridge regression with the
noise as the ridge (Bishop 2006, section 2.3.3). R is diagonal and holds each joint's variance, so a noise-free joint
does not move, and a hidden joint follows the others. The result is then conditioned on the person's bone lengths.

The frame is spanned by the noisy hips and shoulders. S therefore includes a rotation and a translation of the frame.
The Gaussian does not depend on the body's orientation in the world, so a body may lie, or stand on its hands.

Under a Gaussian, postures unlike those of training people are too unlikely. `LivePosture` therefore takes a factor on
its covariance, and a limit on how far a joint moves, relative to what the Gaussian predicts of such moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import from_rotation_vectors
from steadypose.prior.body.skeleton import HIPS, MIRROR, PARENT, REST_LENGTHS, SHOULDERS
from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import Arrays, load_weights

DIMENSIONS, TURNS = 66, 3
UNLIKE = 0.01
"""Standard deviation along an axis of a joint's difference from the postures of training people, metres."""

UNMOVED = 0.01
"""Variance added to that of a joint's move, relative to its noise: moves of a tenth of its deviation have no limit."""

MIN_SIGMA, MAX_SIGMA = 1e-5, 0.5
"""Bounds of a joint's standard deviation, metres; an unknown joint has the upper bound."""

LENGTH_SIGMA = 0.01  # assumed standard deviation of a person's bone lengths, metres
_ROUNDS = 2

MIN_SIZE = 0.05  # least size of a body whose postures are compared, relative to an adult's: joints may coincide

_CORNERS = (*HIPS, *SHOULDERS)
_REST_SIZE = float(REST_LENGTHS.sum())


class Expected(NamedTuple):
    """Expected joints of B bodies."""

    positions: Floats  # (B, 22, 3) metres
    sigma: Floats  # (B, 22) metres, their standard deviations along an axis
    frame: Floats  # (B, 3, 3) axes of the trunk as columns
    adult: Floats  # (B, 66) metres, the joints of an adult in that frame, less the mean
    covariance: Floats  # (B, 66, 66) m² of them


class Root(NamedTuple):
    """Orientations of the pelvis of B bodies, as their postures show them."""

    orientation: Floats  # (B, 3, 3)
    covariance: Floats  # (B, 3, 3) rad² about the pelvis' axes, the part that is caused by the joints' noise


class LivePosture:
    """The Gaussian of `steadypose train posture`.

    ``mean`` (66,) metres and ``covariance`` (66, 66) m² are of the joints of an adult in the trunk's frame.
    """

    def __init__(self, weights: Arrays) -> None:
        factor, mean = weights["factor"].astype(np.float64), weights["mean"].astype(np.float64)
        whole = factor @ factor.T
        self.mean, self._turn = mean[:DIMENSIONS], mean[DIMENSIONS:]
        self._of_training = np.ascontiguousarray(whole[:DIMENSIONS, :DIMENSIONS])
        self.covariance = self._of_training + UNLIKE**2 * np.eye(DIMENSIONS)
        self._turned_by = np.linalg.solve(self.covariance, whole[:DIMENSIONS, DIMENSIONS:]).T

    @classmethod
    def load(cls, weights: str) -> LivePosture:
        """Load the weights of this name; raises like `load_weights`."""
        return cls(load_weights(weights, "posture")[0])

    def __call__(
        self,
        positions: Floats,
        sigma: Floats,
        lengths: Floats,
        spread: Floats | float = 1.0,
        limit: float = math.inf,
    ) -> Expected:
        """Estimate joints from noisy ones.

        Args:
            positions: (B, 22, 3) metres.
            sigma: (B, 22) metres along an axis, their standard deviations.
            lengths: (B, 22) metres, length of each joint's bone, 0 for the root.
            spread: (B,) factor on the covariance: how much more this person may differ from the mean than training
                people do.
            limit: largest distance that the Gaussian moves a joint, in standard deviations of that distance.
        """
        frame, middle = trunk_frame(positions), positions[:, list(_CORNERS)].mean(axis=1)
        size = lengths.sum(axis=-1) / _REST_SIZE
        scale = size[:, None, None]
        local = (positions - middle[:, None]) @ frame / scale
        noise = np.repeat(np.square(np.fmax(np.fmin(sigma, MAX_SIGMA), MIN_SIGMA) / size[:, None]), 3, axis=1)
        off, left = local.reshape(len(local), -1) - self.mean, np.empty((len(local), DIMENSIONS, DIMENSIONS))
        observed = off.copy()
        _condition(self._of_training, np.full(len(local), spread), noise, off, left)
        if limit < math.inf:
            _limit(limit, noise, observed, off, left)
        local = (self.mean + off).reshape(local.shape)
        expected, left = on_bones(local * scale, left * scale**2, np.ascontiguousarray(lengths[:, 1:]))
        off = (expected / scale).reshape(len(local), -1) - self.mean
        variance = np.diagonal(left, axis1=1, axis2=2).reshape(-1, 22, 3).mean(axis=-1)
        placed = expected @ frame.swapaxes(-1, -2) + middle[:, None]
        return Expected(placed, np.sqrt(variance), frame, off, left / scale**2)

    def root(self, expected: Expected) -> Root:
        """Return the orientation of the pelvis that goes with these joints."""
        turned = from_rotation_vectors(self._turn + expected.adult @ self._turned_by.T)
        return Root(expected.frame @ turned, self._turned_by @ expected.covariance @ self._turned_by.T)

    def misfit(self, positions: Floats, sigma: float) -> Floats:
        """(N,) half the squared Mahalanobis distance of one body's joints in N orders (N, 22, 3), metres, NaN where
        unobserved, with errors of ``sigma`` metres along an axis. Only joints that are observed on both sides count.

        The difference of two is the logarithm of the ratio of their likelihoods.
        """
        known = np.isfinite(positions[0, :, 0]) & np.isfinite(positions[0, MIRROR, 0])
        bones = np.linalg.norm(positions[0] - positions[0, PARENT], axis=-1)
        both = known & known[PARENT] & (REST_LENGTHS > 0.0)
        size = max(float(np.median(bones[both] / REST_LENGTHS[both])), MIN_SIZE) if both.any() else 1.0
        middle = positions[:, list(_CORNERS)].mean(axis=1)
        local = (positions - middle[:, None]) @ trunk_frame(positions) / size
        off = local[:, known].reshape(len(local), -1) - self.mean.reshape(22, 3)[known].ravel()
        rows = np.repeat(known, 3)
        covariance = self.covariance[np.ix_(rows, rows)] + sigma**2 * np.eye(int(rows.sum()))
        return 0.5 * (off.T * np.linalg.solve(covariance, off.T)).sum(axis=0)

    def sigma_given(self, known: Bools) -> Floats:
        """(22,) metres along an axis, standard deviations of joints given exactly those that are ``known`` (22,)."""
        rows, left = np.repeat(known, 3), self.covariance.copy()
        if rows.any():
            across = self.covariance[:, rows]
            left -= across @ np.linalg.solve(self.covariance[np.ix_(rows, rows)], across.T)
        return np.sqrt(np.maximum(np.diagonal(left), 0.0).reshape(22, 3).mean(axis=1))


@njit(cache=True)
def _condition(covariance, spread, noise, off, left):
    """Condition a zero-mean Gaussian of ``covariance`` (66, 66) times ``spread`` (B,), plus `UNLIKE` squared, on
    observations ``off`` (B, 66) of variance ``noise``.

    Observations are processed one by one, because their errors are independent. The expectation is written to ``off``,
    the covariance to ``left`` (B, 66, 66).
    """
    column, expected = np.empty(DIMENSIONS), np.empty(DIMENSIONS)
    for b in range(len(off)):
        for i in range(DIMENSIONS):
            expected[i] = 0.0
            for j in range(DIMENSIONS):
                left[b, i, j] = spread[b] * covariance[i, j]
            left[b, i, i] += UNLIKE**2
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


@njit(cache=True)
def _limit(limit, noise, observed, off, left):
    """Limit the moves from ``observed`` to ``off`` (B, 66), in place, joint by joint, to ``limit`` standard deviations.

    A joint's move has the covariance R - left, with its noise R and the covariance ``left`` (B, 66, 66) after it.
    """
    square, moved = np.empty((3, 3)), np.empty(3)
    for b in range(len(off)):
        for first in range(0, DIMENSIONS, 3):
            for i in range(3):
                moved[i] = off[b, first + i] - observed[b, first + i]
                for j in range(3):
                    square[i, j] = -left[b, first + i, first + j]
                square[i, i] += (1.0 + UNMOVED) * noise[b, first + i]
            _solve_three(square, moved)
            ratio = 0.0
            for i in range(3):
                ratio += moved[i] * (off[b, first + i] - observed[b, first + i])
            if ratio > limit**2:
                share = limit / math.sqrt(ratio)
                for i in range(3):
                    off[b, first + i] = observed[b, first + i] + share * (off[b, first + i] - observed[b, first + i])


@njit(cache=True)
def _solve_three(matrix, vector):
    """Solve a positive definite system (3, 3) by elimination; the solution overwrites ``vector`` (3,)."""
    for i in range(3):
        for row in range(i + 1, 3):
            factor = matrix[row, i] / matrix[i, i]
            for column in range(i, 3):
                matrix[row, column] -= factor * matrix[i, column]
            vector[row] -= factor * vector[i]
    for i in range(2, -1, -1):
        for column in range(i + 1, 3):
            vector[i] -= matrix[i, column] * vector[column]
        vector[i] /= matrix[i, i]


def on_bones(mean: Floats, covariance: Floats, lengths: Floats) -> tuple[Floats, Floats]:
    """Condition joints on bone lengths by an iterated extended Kalman filter update (Bell and Cathey 1993).

    A length gives no information across its bone, but a joint's error across one bone lies along another.

    Args:
        mean: (B, 22, 3) metres.
        covariance: (B, 66, 66) m².
        lengths: (B, 21) metres, length of each joint's bone without the root, with the standard deviation
            `LENGTH_SIGMA`.

    Returns:
        Mean and covariance given the lengths.
    """
    given, left = mean.copy(), covariance.copy()
    _on_bones(mean, covariance, lengths, given, left)
    return given, left


@njit(cache=True)
def _on_bones(prior, covariance, lengths, mean, left):
    """Compute `on_bones`. ``mean`` and ``left`` start as ``prior`` and ``covariance`` and are overwritten by the
    results.

    With the Cholesky factor L of the innovations' covariance, `across` and `off` are multiplied by L^-1. Their product
    is then the gain times the innovation, and the square of `across` is the reduction of the covariance by the lengths.
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
    """Return the axes forward, left, up as columns (B, 3, 3), from hips and shoulders of joints (B, 22, 3)."""
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
    """(B,) total length of bones (B, 22, 3), relative to the rest skeleton's."""
    return np.linalg.norm(offsets, axis=-1).sum(axis=-1) / _REST_SIZE
