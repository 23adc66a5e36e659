"""Fits to key points of one camera: initial poses, and tracks to fit.

With points of a depth camera, a key point has the depth of the surface around it in the image. Without them, depth
follows from the intersection of the feet's rays with a known floor, or from the longest bones in the image, which lie
across the line of sight. The widths of hips and shoulders give the angle of the heading, the direction of the toes its
sign. If no toes are visible, there are two starts, and the fit with less energy is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter, percentile_filter

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import CAPSULES
from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT, quaternions, yaw_matrix
from steadypose.prior.body.skeleton import HIPS, JOINTS, REST_OFFSETS, SHOULDERS, J
from steadypose.prior.camera.key_points import KeyPointRecording
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.motion import float_tensor
from steadypose.prior.fit.observations import KeyPoints, Observed, Pinhole, SeenJoints, SurfacePoints, thinned
from steadypose.prior.fit.solve import FitSettings, Start
from steadypose.prior.fit.windows import FittedTrack, Track, fit_track
from steadypose.prior.models.occlusion import STANDING
from steadypose.prior.timing.rate import FPS

_BONES = [(J[a], J[b]) for side in ("left", "right") for a, b in (
    (f"{side}_hip", f"{side}_knee"), (f"{side}_knee", f"{side}_ankle"), (f"{side}_shoulder", f"{side}_elbow"),
    (f"{side}_elbow", f"{side}_wrist"), (f"{side}_hip", f"{side}_shoulder"),
)]  # fmt: skip
_ACROSS = 80.0
"""Percentile of the ratios of bones' lengths in the image to their actual lengths that is assigned to a bone across the
line of sight; the largest ratio may be an outlier."""
_MEDIAN_FRAMES, _SMOOTHING_SIGMA = 5, 3.0
"""Window of the median filter and standard deviation of the Gaussian filter of root and heading, frames."""

_REACH, _NEAREST = 0.08, 5
"""Largest distance in the image between a key point and points that give its depth, metres; number of such points."""
_FLESH = np.array([max((r for a, b, r in CAPSULES if name in (a, b)), default=0.1) for name in JOINTS])
"""Distance from the skin to each joint, metres."""
_SIZES = 0.6, 1.25  # least and largest size from the floor, relative to the initial bones
_ANKLES_TOES = [(J[f"{side}_ankle"], J[f"{side}_foot"]) for side in ("left", "right")]
_FEET = np.array(CONTACT_JOINTS[2:6])
_AHEAD, _STRIDE, _STANDS = 0.2, 15, 30.0
"""Distance by which the nearest foot is nearer than the root, metres; window of the percentile filter in which a foot
stands at some time, frames; and its percentile."""


def starts_of_key_points(
    pixels: Floats, camera: Pinhole, offsets: Floats, ground: float, *, floor_known: bool = False
) -> list[Start]:
    """Return initial motions of a body in the rest pose, without depth measurements.

    Args:
        pixels: (T, 22, 2), NaN where not detected.
        camera: the camera.
        offsets: (22, 3) metres, initial bones.
        ground: metres, world, initial height of the floor.
        floor_known: whether that height is known and not guessed; it then determines the body's size.

    Returns:
        A body in the rest pose with its arms down, which follows the key points in position and heading. If no toes are
        visible, there are two: one with its left side away from the camera and one with it towards the camera.
    """
    focal, centre = camera.focal.numpy().astype(float), camera.centre.numpy().astype(float)
    rotation, position = camera.rotation.numpy().astype(float), camera.position.numpy().astype(float)
    rays = (pixels - centre) / focal
    rest = place_joints(solve_rotations(STANDING, offsets), offsets)  # these bones, with the arms down
    depth = _depth(rays, rest)
    if floor_known and (standing := _standing_depth(rays, rotation, position, ground)) is not None:
        size = float(np.median(standing / depth))
        if _SIZES[0] < size < _SIZES[1]:
            depth, offsets, rest = standing, offsets * size, rest * size
    hips = _nanmean(rays[:, HIPS])
    middle = _interpolated(np.where(np.isfinite(hips), hips, _nanmean(rays)))
    root = np.concatenate([middle, np.ones((len(middle), 1))], axis=1) * depth[:, None]
    root = gaussian_filter1d(root, _SMOOTHING_SIGMA, axis=0, mode="nearest") @ rotation.T + position
    across = _across(rays, depth, rest)
    right_axis, ahead = rotation[:, 0], rotation[:, 2]
    starts = []
    toes = _toes(rays)
    for side in (np.ones(len(root)), -np.ones(len(root))) if toes is None else (toes,):
        left = across[:, None] * right_axis + (side * np.sqrt(1.0 - across**2))[:, None] * ahead
        yaw = np.arctan2(-left[:, 0], left[:, 1])
        rotations = np.tile(solve_rotations(rest, offsets), (len(root), 1, 1, 1))
        rotations[:, 0] = yaw_matrix(yaw)
        starts.append(Start.of(root, rotations, offsets, ground))
    return starts


def lift(pixels: Floats, camera: Pinhole, points: Floats) -> Floats:
    """Lift key points (T, 22, 2) to (T, 22, 3) metres, world, behind the surface of the points (T, N, 3) around them.

    Key points without surface points around them are NaN.
    """
    focal, centre = camera.focal.numpy().astype(float), camera.centre.numpy().astype(float)
    rotation, position = camera.rotation.numpy().astype(float), camera.position.numpy().astype(float)
    seen = (points - position) @ rotation
    depth = seen[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        places = seen[..., :2] / depth[..., None]
    rays = (pixels - centre) / focal
    found = np.full((*pixels.shape[:2], 3), np.nan)
    for row, (keys, near, far) in enumerate(zip(rays, places, depth, strict=True)):
        off = np.linalg.norm(keys[:, None] - near, axis=-1) * far
        off[~(far > 0)[None] | ~np.isfinite(off)] = np.inf
        order = np.argsort(off, axis=1)[:, :_NEAREST]
        beside = np.take_along_axis(off, order, axis=1) < _REACH
        known = beside.any(axis=1)
        if not known.any():
            continue
        z = np.nanmedian(np.where(beside, far[order], np.nan)[known], axis=1) + _FLESH[known]
        found[row, known] = np.concatenate([keys[known], np.ones((len(z), 1))], axis=1) * z[:, None]
    return found @ rotation.T + position


def _standing_depth(rays: Floats, rotation: Floats, position: Floats, ground: float) -> Floats | None:
    """(T,) metres along the optical axis to the root of a body that stands on the floor; None if no foot is visible.

    The ray of a standing foot meets the floor at the foot, the ray of a foot in the air farther away.
    """
    feet = np.concatenate([rays[:, _FEET], np.ones((len(rays), len(_FEET), 1))], axis=-1) @ rotation.T
    drop = ground + np.array(REST_HEIGHT)[2:6] - position[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        meets = np.where((feet[..., 2] < 0) & (drop < 0), drop / feet[..., 2], np.inf)
    nearest = np.where(np.isfinite(meets), meets, np.inf).min(axis=1)
    if not np.isfinite(nearest).any():
        return None
    depth = _interpolated(np.where(np.isfinite(nearest), nearest, np.nan)) + _AHEAD
    return percentile_filter(depth, _STANDS, _STRIDE, mode="nearest")


def _depth(rays: Floats, rest: Floats) -> Floats:
    """(T,) metres along the optical axis, from key points (T, 22, 2) at depth 1 and the bones of the pose ``rest``."""
    a, b = np.array(_BONES).T
    lengths = np.linalg.norm(rest[b] - rest[a], axis=-1)
    ratios = np.linalg.norm(rays[:, b] - rays[:, a], axis=-1) / lengths
    inverse = [np.percentile(row[np.isfinite(row)], _ACROSS) if np.isfinite(row).any() else np.nan for row in ratios]
    return 1.0 / _interpolated(np.array(inverse))


def _across(rays: Floats, depth: Floats, rest: Floats) -> Floats:
    """(T,) component, -1 to 1, of the body's left axis along the image's x, from the widths of hips and shoulders."""
    widths = [
        (rays[:, left, 0] - rays[:, right, 0]) * depth / np.linalg.norm(rest[left] - rest[right])
        for left, right in (HIPS, SHOULDERS)
    ]
    width = _interpolated(_nanmean(np.stack(widths, axis=1)))
    return np.clip(gaussian_filter1d(width, _SMOOTHING_SIGMA, mode="nearest"), -1.0, 1.0)


def _toes(rays: Floats) -> Floats | None:
    """(T,) 1 if toes point to the right of the image, so that the left side is farther, -1 if to the left.

    None if the toes are not visible in half of the frames.
    """
    pointing = np.stack([rays[:, toe, 0] - rays[:, ankle, 0] for ankle, toe in _ANKLES_TOES], axis=1)
    if np.isfinite(pointing).any(axis=1).mean() < 0.5:
        return None
    smooth = gaussian_filter1d(_interpolated(_nanmean(pointing)), _SMOOTHING_SIGMA, mode="nearest")
    return np.where(smooth < 0.0, -1.0, 1.0)


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


Clean = Callable[[Floats], Floats]
"""Type of `steadypose clean` as a function: joints (T, 22, 3) metres, world, at 30 Hz; NaN without a body."""

PIXEL_SIGMA = 0.01  # standard deviation of a key point in the image, focal lengths

CAMERA_HEIGHT, CAMERA_HEIGHT_SIGMA = 1.3, 0.3
"""Assumed height of a camera above the floor if it is unknown, and its standard deviation, metres."""

LIFTED_SIGMA = 0.08  # standard deviation along an axis of key points with the depth of the surface around them, metres


def track_of_picture(
    pixels: Floats,
    confidence: Floats,
    camera: Pinhole,
    floor: float,
    *,
    floor_known: bool = False,
    points: Floats | None = None,
    clean: Clean,
) -> Track:
    """Build the track to fit of a person in images, with initial motions.

    With points, key points get the depth of the surface around them. They are observations, and the start is `clean`
    applied to them. Without points, or if `clean` finds nobody, the start is that of `starts_of_key_points`.

    Args:
        pixels: (T, 22, 2) at 30 Hz, NaN where not detected.
        confidence: (T, 22) 0 to 1.
        camera: the camera.
        floor: metres, world, height of the floor, known or guessed.
        floor_known: whether the height is known.
        points: (T, N, 3) metres, world, points of the body's surface, padded with NaN; None if there are none.
        clean: `steadypose clean`.
    """
    sigma = PIXEL_SIGMA * float(camera.focal.mean())
    observed: list[Observed] = [KeyPoints(float_tensor(pixels), float_tensor(confidence), camera, sigma)]
    starts = starts_of_key_points(pixels, camera, REST_OFFSETS, floor, floor_known=floor_known)
    if points is not None:
        lifted = lift(pixels, camera, points)
        observed.append(SurfacePoints(float_tensor(thinned(points)), camera.position))
        observed.append(SeenJoints(float_tensor(lifted), torch.full(lifted.shape[:-1], LIFTED_SIGMA)))
        starts = _start_of_joints(clean(lifted), floor) or starts
    return Track(starts, observed)


def _start_of_joints(cleaned: Floats, floor: float) -> list[Start]:
    """Return the motion of joints (T, 22, 3) metres, world; none if half of them or more are NaN."""
    known = np.flatnonzero(np.isfinite(cleaned).all(axis=(1, 2)))
    if 2 * len(known) < len(cleaned):
        return []
    nearest = known[np.abs(np.arange(len(cleaned))[:, None] - known).argmin(axis=1)]
    positions = cleaned[nearest]
    return [Start.of_joints(positions, floor)]


def track_of_key_points(recording: KeyPointRecording, clean: Clean) -> Track:
    """Build the track of a recording (see `track_of_picture`), with the camera at the world's origin."""
    camera = Pinhole(
        float_tensor(recording.focal),
        float_tensor(recording.centre),
        float_tensor(recording.rotation),
        position=torch.zeros(3),
    )
    return track_of_picture(
        recording.pixels,
        recording.confidence,
        camera,
        -(recording.camera_height or CAMERA_HEIGHT),
        floor_known=recording.camera_height is not None,
        points=None if recording.points is None else recording.points @ recording.rotation.T,
        clean=clean,
    )


def fit_key_points(
    model: HumorNet,
    recording: KeyPointRecording,
    settings: FitSettings,
    folder: Path | None,
    clean: Clean,
    advanced: Callable[[], None] = lambda: None,
) -> FittedTrack:
    """Fit one person."""
    if recording.camera_height is None:
        settings = replace(settings, ground_height_sigma=CAMERA_HEIGHT_SIGMA)
    return fit_track(model, track_of_key_points(recording, clean), settings, folder, advanced=advanced)


def arrays_of_fit(recording: KeyPointRecording, track: FittedTrack) -> dict[str, NDArray[Any]]:
    """Return the arrays of ``steadypose clean``, in the camera's frame, at 30 Hz, without deviations and anomalies."""
    rotations = track.rotations.copy()
    rotations[:, 0] = recording.rotation.T @ rotations[:, 0]
    seen = np.asarray(np.isfinite(recording.pixels).all(axis=-1))
    unknown = np.full(seen.shape, np.nan, dtype=np.float32)
    return {
        "stamp_ns": recording.stamps_ns,
        "positions": (track.joints @ recording.rotation).astype(np.float32),
        "rotations": quaternions(rotations).astype(np.float32),
        "state": np.where(seen, JointState.REFINED, JointState.IMPUTED).astype(np.uint8),
        "sigma": unknown,
        "anomaly": unknown[:, 0].astype(np.float64),
        "anomaly_flag": np.zeros(len(seen), dtype=bool),
        "joint_anomaly": unknown,
        "contacts": track.load.astype(np.float32),
        "root_velocity": np.gradient(track.joints[:, 0], 1.0 / FPS, axis=0),
        "world_positions": track.joints.astype(np.float32),
        "joint_names": np.array(JOINTS),
    }
