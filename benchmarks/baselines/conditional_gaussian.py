"""A baseline for hidden joints: one Gaussian over training poses, conditioned on the joints that are seen.

Poses are about the root, in the frame of the body's heading. What is hidden is answered with the conditional mean
E[h | s] = m_h + C_hs C_ss^-1 (s - m_s) (Bishop, Pattern Recognition and Machine Learning, 2006, equation 2.96), each
frame by itself: what linear correlation alone knows of a body.
"""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import J

RIDGE = 1e-6
"""m², added to variances along each axis: 1 mm, so that joints that a bone ties to each other can be solved for."""

_ACROSS = tuple((J[f"left_{part}"], J[f"right_{part}"]) for part in ("hip", "shoulder"))
_ROOT = J["pelvis"]


class ConditionalGaussian:
    """The mean and covariance of poses (N, 22, 3), metres, z up, all of their joints seen."""

    def __init__(self, poses: Floats) -> None:
        x = ((poses - poses[:, _ROOT, None]) @ yaw_matrix(facing(poses))).reshape(len(poses), -1)
        self.mean = x.mean(axis=0)
        self.covariance = np.cov(x, rowvar=False, bias=True) + RIDGE * np.eye(x.shape[1])

    def __call__(self, seen: Floats, yaw: Floats | None = None) -> Floats:
        """Poses (..., 22, 3) metres with what was hidden (NaN) at its conditional mean; where the root is hidden, or
        any of hips and shoulders and the heading is not given as ``yaw`` (...) radians, as they were."""
        poses = seen.reshape(-1, 22, 3).copy()
        known = np.isfinite(poses).all(axis=-1)
        headings = facing(poses) if yaw is None else np.broadcast_to(yaw, seen.shape[:-2]).ravel()
        anchors = [_ROOT, *(np.ravel(_ACROSS) if yaw is None else ())]
        for pattern in np.unique(known, axis=0):
            if pattern.all() or not pattern[anchors].all():
                continue
            rows = (known == pattern).all(axis=1)
            s = np.repeat(pattern, 3)
            turn, root = yaw_matrix(headings[rows]), poses[rows, _ROOT, None]
            given = ((poses[rows] - root) @ turn)[:, pattern].reshape(rows.sum(), -1)
            gain = np.linalg.solve(self.covariance[np.ix_(s, s)], self.covariance[np.ix_(s, ~s)])
            hidden = (self.mean[~s] + (given - self.mean[s]) @ gain).reshape(rows.sum(), -1, 3)
            poses[np.ix_(rows, ~pattern)] = hidden @ turn.swapaxes(-1, -2) + root
        return poses.reshape(seen.shape)


def facing(poses: Floats) -> Floats:
    """(...) radians about z, of poses (..., 22, 3): the normal of the line from the right hip and shoulder to the left,
    as what is hidden and how the pelvis is turned are not known."""
    across = np.sum([poses[..., left, :] - poses[..., right, :] for left, right in _ACROSS], axis=0)
    return np.arctan2(-across[..., 0], across[..., 1])
