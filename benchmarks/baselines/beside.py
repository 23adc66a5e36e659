"""A peer for hidden joints: each keeps its place beside the nearest joint that is seen, turned with the trunk."""

from __future__ import annotations

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import BONES_BETWEEN, REST_POSITIONS, J

_ACROSS = tuple((J[f"left_{part}"], J[f"right_{part}"]) for part in ("hip", "shoulder"))


def beside(seen: Floats, stamps_s: Floats, delay: int) -> Floats:
    """The input; a hidden joint keeps its last offset, turned with the trunk, from the nearest visible joint: the one
    fewest bones away and, of several, nearest in space. With no visible joint, all are held. Of a joint never seen the
    offset is that in a generic adult who stands with the arms down.

    Args:
        seen: (T, C, 22, 3) metres, z up, canonical joints, NaN where missing.
        stamps_s: (T,) seconds.
        delay: frames; not used.
    """
    answers = seen.copy()
    clips, joints = seen.shape[1:3]
    # the pose as it was answered when each joint was last seen; of one never seen, in the last frame
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
    """(22, 3) metres: `REST_POSITIONS` with the arms down."""
    pose = np.array(REST_POSITIONS)
    for side in ("left", "right"):
        arm, shoulder = [J[f"{side}_elbow"], J[f"{side}_wrist"]], pose[J[f"{side}_shoulder"]]
        pose[arm] = shoulder - np.outer(np.linalg.norm(pose[arm] - shoulder, axis=1), (0.0, 0.0, 1.0))
    return pose


def _turned(was: Floats, now: Floats) -> Floats:
    """(N, 3, 3) how hips and shoulders, those seen in both, have turned about z from one pose (N, 22, 3) to another."""
    before, after = np.zeros((len(was), 2)), np.zeros((len(was), 2))
    for left, right in _ACROSS:
        a, b = (pose[:, left, :2] - pose[:, right, :2] for pose in (was, now))
        both = np.isfinite(a + b).all(axis=1, keepdims=True)
        before, after = before + np.where(both, a, 0.0), after + np.where(both, b, 0.0)
    angle = np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], (before * after).sum(axis=1))
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
