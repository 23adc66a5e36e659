"""Baselines for hidden joints that use the whole body: held in the body frame, and one Gaussian over training poses.

Held: each joint keeps its offset from the nearest observed joint, rotated with the trunk.

Gaussian: poses are relative to the root, in the frame of the body's heading. Hidden joints are at the conditional mean
E[h | s] = m_h + C_hs C_ss^-1 (s - m_s) (Bishop, Pattern Recognition and Machine Learning, 2006, equation 2.96), each
frame separately. This is what linear correlation alone knows of a body.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import BONES_BETWEEN, HIPS, REST_POSITIONS, SHOULDERS, J

_ACROSS = HIPS, SHOULDERS


def beside(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """Hold hidden joints (NaN) of (T, C, 22, 3) metres, z up, in the body frame; observed joints are returned as they
    are.

    A hidden joint keeps its last offset, rotated with the trunk, from the nearest visible joint: the one with the
    fewest bones between them and, of several, the nearest in space. Without any visible joint, all are held. A joint
    never observed has the offset of a generic adult who stands with the arms down.
    """
    answers = seen.copy()
    clips, joints = seen.shape[1:3]
    # the output pose when each joint was last observed; for a joint never observed, of the last frame
    then = np.tile(_standing(), (clips, joints, 1, 1))
    never = np.ones((clips, joints), dtype=bool)
    for t, frame in enumerate(seen):
        known = np.isfinite(frame).all(axis=-1)
        never &= ~known
        c, j = np.nonzero(~known & (known | ~never).any(axis=1, keepdims=True))
        was, now, rows = then[c, j], np.where(known[c, :, None], frame[c], np.nan), np.arange(len(c))
        offset = was[rows, j][:, None] - was
        apart = BONES_BETWEEN[j] + 1e-3 * np.linalg.norm(offset, axis=-1)
        nearest = np.where(np.isfinite(apart) & known[c], apart, np.inf).argmin(axis=1)
        moved = now[rows, nearest] + np.einsum("nab,nb->na", _turned(was, now), offset[rows, nearest])
        answers[t, c, j] = np.where(known[c].any(axis=1, keepdims=True), moved, was[rows, j])
        kept = known | (never & known.any(axis=1, keepdims=True))
        then[kept] = np.broadcast_to(answers[t][:, None], then.shape)[kept]
    return answers


def _standing() -> Floats:
    """Return `REST_POSITIONS` with the arms down, (22, 3) metres."""
    pose = np.array(REST_POSITIONS)
    for side in ("left", "right"):
        arm, shoulder = [J[f"{side}_elbow"], J[f"{side}_wrist"]], pose[J[f"{side}_shoulder"]]
        pose[arm] = shoulder - np.outer(np.linalg.norm(pose[arm] - shoulder, axis=1), (0.0, 0.0, 1.0))
    return pose


def _turned(was: Floats, now: Floats) -> Floats:
    """Return the rotation about z of hips and shoulders observed in both poses (N, 22, 3), (N, 3, 3)."""
    before, after = np.zeros((len(was), 2)), np.zeros((len(was), 2))
    for left, right in _ACROSS:
        a, b = (pose[:, left, :2] - pose[:, right, :2] for pose in (was, now))
        both = np.isfinite(a + b).all(axis=1, keepdims=True)
        before, after = before + np.where(both, a, 0.0), after + np.where(both, b, 0.0)
    angle = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)


RIDGE = 1e-6
"""Regularisation of the variances along each axis, m²: 1 mm, so that joints tied by a bone can be solved for."""

_ROOT = J["pelvis"]


class ConditionalGaussian:
    """Mean and covariance of complete poses (N, 22, 3), metres, z up."""

    def __init__(self, poses: Floats) -> None:
        x = ((poses - poses[:, _ROOT, None]) @ yaw_matrix(facing(poses))).reshape(len(poses), -1)
        self.mean = x.mean(axis=0)
        self.covariance = np.cov(x, rowvar=False, bias=True) + RIDGE * np.eye(x.shape[1])

    def __call__(self, seen: Floats, yaw: Floats | None = None) -> Floats:
        """Fill hidden joints (NaN) of poses (..., 22, 3), metres, with their conditional mean.

        Poses stay as they are if the root is hidden, or if a hip or shoulder is hidden and the heading is not given as
        ``yaw`` (...), radians.
        """
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


def facing(poses: Floats, pairs: Sequence[tuple[int, int]] = _ACROSS) -> Floats:
    """Return the heading (...) of poses (..., 22, 3), radians about z.

    It is the normal of the lines from the right to the left joint of these ``pairs``, by default of hips and shoulders,
    because the pelvis' rotation is unknown.
    """
    across = np.sum([poses[..., left, :] - poses[..., right, :] for left, right in pairs], axis=0)
    return np.arctan2(-across[..., 0], across[..., 1])
