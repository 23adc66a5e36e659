"""The orientation of the pelvis, from its own joints and from the whole body (`prior.models.posture`).

The Gaussian of postures contains the pelvis' rotation, so this is also estimated from shoulders,
spine and thighs. The root's rotation is a weighted average of this estimate and the estimate from the pelvis' own
joints. If those joints are exact, they determine it; if they are noisy, the whole body does.

The pelvis is a rigid part with both hips and the lowest spine joint. The line to the chest is three times as long and
less noisy, but bends with the spine. The orientation of the pelvis in motion files differs by 0.9 degrees (median) from
that of the rigid part, and by 3.4 degrees from the frame of hips and chest (validation people).
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import from_rotation_vectors, to_rotation_vectors
from steadypose.prior.body.skeleton import HIPS, PARENT, J
from steadypose.prior.compiled import njit
from steadypose.prior.models.posture import MAX_SIGMA, MIN_SIGMA, LivePosture, Root

LEAST_SIGMA = math.radians(0.5)
"""Least standard deviation of the root's rotation about an axis, for any sensor, radians."""

WITHIN = np.radians((1.5, 4.0, 5.0))
"""Standard deviations about the pelvis' axes of its rotation, given exact joints of the rest of the body, radians."""

DEPENDENT = 1.7
"""Factor on the covariance of the averaged root, because the two estimates share most noise (validation people)."""

_CARRIED = (*HIPS, J["spine1"])
_LEAST = 1e-6
"""Moment added to a body's moments, so that bones without length cause no division by zero, m²."""


def average_root(root: Root, positions: Floats, sigma: Floats, offsets: Floats) -> Floats:
    """Average the root's orientations (B, 3, 3) from the posture and from the pelvis' own joints by their covariances:
    observed joints (B, 22, 3) metres, deviations (B, 22) along an axis and bones (B, 22, 3)."""
    known, rigid = root.covariance + np.diag(WITHIN**2), rigid_covariance(sigma, offsets)
    off = to_rotation_vectors(root.orientation.swapaxes(-1, -2) @ rigid_pelvis(positions, offsets))
    share = known @ np.linalg.inv(known + rigid)
    return root.orientation @ from_rotation_vectors((share @ off[..., None])[..., 0])


class RootCovariance:
    """The covariance of a root's orientation, which messages do not carry, of published joints and deviations."""

    def __init__(self) -> None:
        self._posture = LivePosture.load("default")

    def __call__(self, positions: Floats, sigma: Floats, root: Floats) -> Floats:
        """Return the covariance (B, 3, 3), rad², of rotations about the axes of the positions' frame, of joints (B, 22,
        3) metres, deviations (B, 22) along an axis and orientations of the pelvis (B, 3, 3)."""
        bones = positions - positions[:, PARENT]
        bones[:, 0] = 0.0
        expected = self._posture(positions, sigma, np.linalg.norm(bones, axis=-1))
        known = self._posture.root(expected).covariance + np.diag(WITHIN**2)
        rigid = rigid_covariance(sigma, bones @ root)
        covariance = DEPENDENT * known @ np.linalg.inv(known + rigid) @ rigid + LEAST_SIGMA**2 * np.eye(3)
        return root @ covariance @ root.swapaxes(-1, -2)


def rigid_pelvis(positions: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) least squares rotation from the pelvis' bones (B, 22, 3) to its joints (B, 22, 3) (Kabsch)."""
    observed = positions[:, list(_CARRIED)] - positions[:, :1]
    u, _, vt = np.linalg.svd(observed.swapaxes(-1, -2) @ offsets[:, list(_CARRIED)])
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def rigid_covariance(sigma: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) rad², covariance of `rigid_pelvis` in the pelvis' own axes, for joint deviations ``sigma`` (B, 22)
    metres.

    To first order, the rotation vector is M^-1 sum(b x e) for bones b and errors e, with M = sum(|b|² I - b b^T).
    """
    moved, moments = np.empty((2, len(offsets), 3, 3))
    _moments(np.fmax(np.fmin(sigma, MAX_SIGMA), MIN_SIGMA), offsets, moved, moments)
    inverse = np.linalg.inv(moments)
    return inverse @ moved @ inverse


@njit(cache=True)
def _moments(sigma, offsets, moved, moments):
    """Write the sums over bones b of |b|² I - b b^T, weighted by the joints' errors, and unweighted."""
    whole = np.empty(3)  # the pelvis' own error affects all its bones
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
