"""How the pelvis is turned: a rigid part of the body that carries both hips and the lowest joint of the spine.

The line to the chest, three times as long, is less noisy, but bends with the spine: motion files turn their pelvis by
0.9 degrees (median) otherwise than the rigid part, and by 3.4 otherwise than hips and chest (validation people).
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, J
from steadypose.prior.compiled import njit

_CARRIED = (*HIPS, J["spine1"])
_LEAST = 1e-6
"""Square metres, added to the moments of a body whose bones have no length."""


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
