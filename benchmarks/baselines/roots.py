"""Baselines for the orientation of the root, frame by frame: the line of hips and shoulders, the rest pose's trunk laid
on the joints, and that corrected by a ridge regression on the whole body."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.corruption import gaussian
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import REST_POSITIONS, TRUNK
from steadypose.prior.models.posture import trunk_frame

RIDGE, NOISE = 1e-3, 0.02
"""Ridge penalty of standardised features, per frame; and noise along an axis in which the ridge regression is fitted,
metres."""

Baseline = Callable[[Floats], Floats]
"""Maps joints (N, 22, 3) metres to root orientations (N, 3, 3), up to a constant rotation."""


def kabsch(positions: Floats) -> Floats:
    """Return the rotation (N, 3, 3) that brings the rest pose's trunk nearest to the trunk's joints (Kabsch 1976)."""
    trunk = list(TRUNK)
    seen, rest = positions[:, trunk], REST_POSITIONS[trunk]
    across = np.einsum("nja,jb->nab", seen - seen.mean(axis=1, keepdims=True), rest - rest.mean(axis=0))
    u, _, vt = np.linalg.svd(across)
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def ridge(clips: MotionClips, seed: int) -> Baseline:
    """Correct `kabsch` by a ridge regression on all joints in its frame, fitted to these clips with noise."""
    truth = clips.positions.reshape(-1, 22, 3)
    noisy = gaussian(truth, NOISE, np.random.default_rng(seed))
    turned = kabsch(noisy)
    target = Rotation.from_matrix(turned.swapaxes(-1, -2) @ clips.rotations.reshape(-1, 22, 3, 3)[:, 0]).as_rotvec()
    x = _features(noisy, turned)
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    x = (x - mean) / scale
    fitted = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ (target - target.mean(axis=0)))

    def corrected(positions: Floats) -> Floats:
        turned = kabsch(positions)
        vector = (_features(positions, turned) - mean) / scale @ fitted + target.mean(axis=0)
        return turned @ Rotation.from_rotvec(vector).as_matrix()

    return corrected


def _features(positions: Floats, turned: Floats) -> Floats:
    """Return the joints (N, 66) about the trunk's middle, in its frame."""
    return ((positions - positions[:, list(TRUNK)].mean(axis=1, keepdims=True)) @ turned).reshape(len(positions), -1)


def baselines(clips: MotionClips, seed: int) -> Mapping[str, Baseline]:
    """Return the baselines by name; ``clips`` are of training people."""
    return {"hips and shoulders": trunk_frame, "trunk, Kabsch": kabsch, "trunk, Kabsch and ridge": ridge(clips, seed)}
