"""How the pelvis is turned: a rigid part of the body that carries both hips and the lowest joint of the spine.

The line to the chest, three times as long, is less noisy, but bends with the spine: motion files turn their pelvis by
0.9 degrees (median) otherwise than the rigid part, and by 3.4 otherwise than hips and chest (validation people).
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, J

_CARRIED = [*HIPS, J["spine1"]]
_LEAST = 1e-6
"""Square metres, added to the moments of a body whose bones have no length."""


def rigid_pelvis(positions: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) the rotation of the pelvis' bones (B, 22, 3) that lies nearest to its joints (B, 22, 3) (Kabsch)."""
    seen = positions[:, _CARRIED] - positions[:, :1]
    u, _, vt = np.linalg.svd(seen.swapaxes(-1, -2) @ offsets[:, _CARRIED])
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def rigid_covariance(sigma: Floats, offsets: Floats) -> Floats:
    """(B, 3, 3) rad², in the pelvis' own axes, of `rigid_pelvis` of joints with deviations ``sigma`` (B, 22) metres.

    To first order the rotation vector is M^-1 sum(b x e), of bones b and errors e, where M = sum(|b|² I - b b^T).
    """
    cross = np.zeros((len(offsets), len(_CARRIED), 3, 3))
    x, y, z = np.moveaxis(offsets[:, _CARRIED], -1, 0)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross -= cross.swapaxes(-1, -2)
    variance = np.square(sigma)
    each = cross @ cross.swapaxes(-1, -2)
    total = cross.sum(axis=1)  # the pelvis' own error is in all three
    moved = (variance[:, _CARRIED, None, None] * each).sum(axis=1)
    moved += variance[:, 0, None, None] * (total @ total.swapaxes(-1, -2))
    moments = np.linalg.inv(each.sum(axis=1) + _LEAST * np.eye(3))
    return moments @ moved @ moments
