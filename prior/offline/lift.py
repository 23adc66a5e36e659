"""Initial poses for key points without depth.

Depth follows from the longest bones in the picture, for these lie across the line of sight; the angle of the heading
from the widths of hips and shoulders, but not its sign. So there are two starts, of which the fit of less energy is
taken.
"""

from __future__ import annotations

import numpy as np
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
"""Percentile of the ratios of bones' lengths in the picture to their own that counts as that of a bone across the line
of sight; the largest is as likely an outlier."""
_MEDIAN_FRAMES, _SMOOTHING_SIGMA = 5, 3.0
"""Frames: window of the median filter, standard deviation of the Gaussian one, of root and heading."""


def starts_of_key_points(pixels: Floats, camera: Pinhole, offsets: Floats, ground: float) -> list[Start]:
    """Two motions of a body in the rest pose with its arms down, that follow the key points in place and heading.

    Args:
        pixels: (T, 22, 2), NaN where not found.
        camera: that took it.
        offsets: (22, 3) metres, initial bones.
        ground: metres, world, initial height of the floor.

    Returns:
        The two, with their left side away from the camera and towards it.
    """
    focal, centre = camera.focal.numpy().astype(float), camera.centre.numpy().astype(float)
    rotation, position = camera.rotation.numpy().astype(float), camera.position.numpy().astype(float)
    rays = (pixels - centre) / focal
    rest = _arms_down(offsets)
    depth = _depth(rays, rest)
    hips = _nanmean(rays[:, HIPS])
    middle = _interpolated(np.where(np.isfinite(hips), hips, _nanmean(rays)))
    root = np.concatenate([middle, np.ones((len(middle), 1))], axis=1) * depth[:, None]
    root = gaussian_filter1d(root, _SMOOTHING_SIGMA, axis=0, mode="nearest") @ rotation.T + position
    across = _across(rays, depth, rest)
    right_axis, ahead = rotation[:, 0], rotation[:, 2]
    starts = []
    for side in (1.0, -1.0):
        left = across[:, None] * right_axis + side * np.sqrt(1.0 - across**2)[:, None] * ahead
        yaw = np.arctan2(-left[:, 0], left[:, 1])
        rotations = np.tile(solve_rotations(rest, offsets), (len(root), 1, 1, 1))
        rotations[:, 0] = yaw_matrix(yaw)
        starts.append(Start.of(root, rotations, offsets, ground))
    return starts


def _depth(rays: Floats, rest: Floats) -> Floats:
    """(T,) metres along the optical axis, of key points (T, 22, 2) at depth 1, by the bones of the pose ``rest``."""
    a, b = np.array(_BONES).T
    lengths = np.linalg.norm(rest[b] - rest[a], axis=-1)
    ratios = np.linalg.norm(rays[:, b] - rays[:, a], axis=-1) / lengths
    inverse = [np.percentile(row[np.isfinite(row)], _ACROSS) if np.isfinite(row).any() else np.nan for row in ratios]
    return 1.0 / _interpolated(np.array(inverse))


def _across(rays: Floats, depth: Floats, rest: Floats) -> Floats:
    """(T,) component, -1 to 1, of the body's left axis along the picture's x, by the widths of hips and shoulders."""
    widths = [
        (rays[:, left, 0] - rays[:, right, 0]) * depth / np.linalg.norm(rest[left] - rest[right])
        for left, right in (HIPS, SHOULDERS)
    ]
    width = _interpolated(_nanmean(np.stack(widths, axis=1)))
    return np.clip(gaussian_filter1d(width, _SMOOTHING_SIGMA, mode="nearest"), -1.0, 1.0)


def _arms_down(offsets: Floats) -> Floats:
    """(22, 3) metres from the pelvis: the rest pose of these bones, with the arms down."""
    pose = REST_POSITIONS.copy()
    for side in ("left", "right"):
        shoulder = pose[J[f"{side}_shoulder"]]
        for part in ("elbow", "wrist"):
            joint = J[f"{side}_{part}"]
            pose[joint] = shoulder - [0.0, 0.0, np.linalg.norm(pose[joint] - shoulder)]
    return place_joints(solve_rotations(pose, offsets), offsets)


def _nanmean(values: Floats) -> Floats:
    """(T, ...) mean over the second axis of (T, K, ...), without a warning where all is NaN."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    return np.where(count > 0, np.where(known, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def _interpolated(values: Floats) -> Floats:
    """(T,) or (T, D) with NaN interpolated in time, then median-filtered."""
    rows = np.arange(len(values))
    columns = values.reshape(len(values), -1).copy()
    for column in columns.T:
        known = np.isfinite(column)
        column[:] = np.interp(rows, rows[known], column[known])
    return median_filter(columns, (_MEDIAN_FRAMES, 1), mode="nearest").reshape(values.shape)
