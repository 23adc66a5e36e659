"""Poses to start from where a camera gave key points without depth.

A pinhole camera and bones say how far a body is, for a bone looks as long as it is where it lies across the line of
sight; its hips and shoulders how far it is turned, but not to which side. So there are two starts, and the energy of
what becomes of them decides.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter

from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import HIPS, REST_POSITIONS, SHOULDERS, J
from steadypose.prior.offline.observations import Pinhole
from steadypose.prior.offline.solve import Start

Floats = NDArray[np.float64]

_BONES = [(J[a], J[b]) for side in ("left", "right") for a, b in (
    (f"{side}_hip", f"{side}_knee"), (f"{side}_knee", f"{side}_ankle"), (f"{side}_shoulder", f"{side}_elbow"),
    (f"{side}_elbow", f"{side}_wrist"), (f"{side}_hip", f"{side}_shoulder"),
)]  # fmt: skip
_ACROSS = 80.0
"""Per cent: which of the bones' lengths in the picture, by their own, counts as that of a bone across the line of
sight; the longest is as likely an error."""
_WIDTH = 5
_SMOOTH = 3.0
"""Frames, of the root and its heading at the start."""


def starts_of_key_points(pixels: Floats, camera: Pinhole, offsets: Floats, ground: float) -> list[Start]:
    """Two motions of a body at rest with its arms down, which stands where key points say and turns as they do.

    Args:
        pixels: (T, 22, 2), NaN where not found.
        camera: that took it.
        offsets: (22, 3) metres, bones believed.
        ground: metres, world, the floor believed.
    """
    focal, centre = camera.focal.numpy().astype(float), camera.centre.numpy().astype(float)
    rotation, position = camera.rotation.numpy().astype(float), camera.position.numpy().astype(float)
    flat = (pixels - centre) / focal
    placed = _placed(offsets)
    a, b = np.array(_BONES).T
    lengths = np.linalg.norm(placed[b] - placed[a], axis=-1)
    seen = np.linalg.norm(flat[:, b] - flat[:, a], axis=-1) / lengths
    across_most = np.array(
        [np.percentile(row[np.isfinite(row)], _ACROSS) if np.isfinite(row).any() else np.nan for row in seen]
    )
    depth = 1.0 / _filled(across_most)
    hips = _mean(flat[:, HIPS])
    middle = _filled(np.where(np.isfinite(hips), hips, _mean(flat)))
    root = np.concatenate([middle, np.ones((len(middle), 1))], axis=1) * depth[:, None]
    root = gaussian_filter1d(root, _SMOOTH, axis=0, mode="nearest") @ rotation.T + position
    widths = [
        (flat[:, left, 0] - flat[:, right, 0]) * depth / np.linalg.norm(placed[left] - placed[right])
        for left, right in (HIPS, SHOULDERS)
    ]
    across = np.clip(gaussian_filter1d(_filled(_mean(np.stack(widths, axis=1))), _SMOOTH, mode="nearest"), -1.0, 1.0)
    # the body's left axis is `across` along the picture's x, and the rest of it along the line of sight or against it
    right_axis, ahead = rotation[:, 0], rotation[:, 2]
    starts = []
    for side in (1.0, -1.0):
        left = across[:, None] * right_axis + side * np.sqrt(1.0 - across**2)[:, None] * ahead
        yaw = np.arctan2(-left[:, 0], left[:, 1])
        rotations = np.tile(solve_rotations(placed, offsets), (len(root), 1, 1, 1))
        rotations[:, 0] = yaw_matrix(yaw)
        starts.append(Start(_tensor(root), _tensor(rotations), _tensor(offsets), ground))
    return starts


def _placed(offsets: Floats) -> Floats:
    """(22, 3) metres from the pelvis: at rest, the arms down."""
    pose = REST_POSITIONS.copy()
    for side in ("left", "right"):
        shoulder = pose[J[f"{side}_shoulder"]]
        for part in ("elbow", "wrist"):
            joint = J[f"{side}_{part}"]
            pose[joint] = shoulder - [0.0, 0.0, np.linalg.norm(pose[joint] - shoulder)]
    return place_joints(solve_rotations(pose, offsets), offsets)


def _mean(values: Floats) -> Floats:
    """(T, ...) over the second axis, of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def _filled(values: Floats) -> Floats:
    """(T,) or (T, D) without gaps, and without lone values far from their neighbours."""
    rows = np.arange(len(values))
    columns = values.reshape(len(values), -1).copy()
    for column in columns.T:
        known = np.isfinite(column)
        column[:] = np.interp(rows, rows[known], column[known])
    return median_filter(columns, (_WIDTH, 1), mode="nearest").reshape(values.shape)


def _tensor(values: Floats) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).float()
