"""Reads an ``.npz`` of 2D key points and their camera, which ``steadypose fit`` lifts to a motion.

Required arrays: ``keypoints`` (T, J, 2) pixels, NaN where not detected; ``skeleton``, a layout's name; ``stamp_ns``
(T,) or ``fps``; ``focal``, pixels, one number or two; ``centre`` (2,) pixels.

Optional arrays: ``confidence`` (T, J) 0 to 1; ``up``, the camera's axis that points up (default ``-y``, a level
camera); ``camera_height``, metres above the floor; ``points`` (T, N, 3) metres in the camera's frame, points on the
body's surface from a depth camera.
"""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Pose
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.sources.npz import NpzError, read_arrays, read_stamps
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rotation_matrix
from steadypose.prior.body.layouts import SKELETONS, layout_names
from steadypose.prior.body.skeleton import HIPS, SHOULDERS
from steadypose.prior.camera.key_points import KeyPointRecording, in_sight

HIGHEST = 100.0  # largest height of a camera above the floor, metres
LONGEST_GAP_NS = 200_000_000  # longest gap over which key points are interpolated, nanoseconds
LONGEST_NS = 24 * 3600 * 10**9
"""Longest duration of a recording, nanoseconds. It prevents a single wrong stamp from creating a grid of years."""
NORMALISED = 2.0
"""Largest coordinate of key points that are not pixels; those of a normalised image may lie a little outside of it."""
MOSTLY = 0.95  # share of frames with shoulders below hips from which on the image's y axis is probably the other
_NUMBERS = {"keypoints", "confidence", "focal", "centre", "camera_height", "points"}


def has_key_points(path: Path) -> bool:
    """Whether an ``.npz`` contains 2D key points and no positions."""
    if path.suffix != ".npz" or not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
    return "keypoints.npy" in names and "positions.npy" not in names


def read_key_points(path: Path) -> KeyPointRecording:
    """Read and check a file of key points. Raises NpzError if an array is missing, or has the wrong form."""
    arrays = read_arrays(path)
    missing = [name for name in ("skeleton", "focal", "centre") if name not in arrays]
    if missing:
        raise NpzError(f"{path}: expected {', '.join(missing)} beside keypoints; it has {', '.join(arrays)}")
    for name in _NUMBERS & arrays.keys():
        if arrays[name].dtype.kind not in "fiu":
            raise NpzError(f"{path}: {name}: expected numbers, got {arrays[name].dtype}")
    height = arrays.get("camera_height")
    if height is not None and (height.size != 1 or not 0.0 < height.item() < HIGHEST):
        raise NpzError(f"{path}: camera_height: expected metres above the floor, one number of more than 0 and less "
                       f"than {HIGHEST:g}, got {height!r:.80}")  # fmt: skip
    name = str(arrays["skeleton"])
    if name not in SKELETONS:
        raise NpzError(f"{path}: skeleton: expected one of {layout_names()}, got {name!r}")
    layout, keypoints = SKELETONS[name], np.asarray(arrays["keypoints"], dtype=np.float64)
    joints = len(layout.joints)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (joints, 2) or len(keypoints) < 2:
        raise NpzError(f"{path}: keypoints: expected (T, {joints}, 2) pixels for {name}, T of 2 or more, got "
                       f"{keypoints.shape}")  # fmt: skip
    confidence = np.asarray(arrays.get("confidence", np.ones(keypoints.shape[:2])), dtype=np.float64)
    focal = np.asarray(arrays["focal"], dtype=np.float64).ravel()
    focal = focal.repeat(2) if focal.size == 1 else focal
    centre = np.asarray(arrays["centre"], dtype=np.float64).ravel()
    for what, wanted, value, fits in (
        ("confidence", "a finite number of each key point", confidence, confidence.shape == keypoints.shape[:2]),
        ("focal", "pixels above 0, one number or two, of x and y", focal, focal.shape == (2,) and (focal > 0).all()),
        ("centre", "pixels, two finite numbers, of x and y", centre, centre.shape == (2,)),
    ):
        if not fits or not np.isfinite(value).all():
            raise NpzError(f"{path}: {what}: expected {wanted}; got {arrays[what]!r:.80}")
    try:
        pose = Pose.from_up(str(arrays.get("up", "-y")))
    except ValueError as error:
        raise NpzError(f"{path}: {error}") from error
    stamps = read_stamps(path, arrays, len(keypoints))
    if (np.diff(stamps) <= 0).any() or stamps[-1] - stamps[0] > LONGEST_NS:
        raise NpzError(f"{path}: stamp_ns: expected stamps that grow, by {LONGEST_NS / 1e9:g} s at most in all")
    weights = layout.to_canonical
    pixels = np.einsum("cj,tjx->tcx", weights, np.nan_to_num(keypoints))
    found = np.isfinite(keypoints).all(axis=-1)
    needed = weights != 0
    sure = np.where(needed, np.where(found, confidence, 0.0)[:, None], np.inf).min(axis=-1)
    sure = np.where(needed.any(axis=1), sure, 0.0)
    pixels[sure <= 0] = np.nan
    if not np.isfinite(pixels).any():
        raise NpzError(f"{path}: keypoints: expected somebody, got no key point that is finite and has a confidence")
    if np.nanmax(np.abs(pixels)) <= NORMALISED:
        got = f"{np.nanmin(pixels):.2g} to {np.nanmax(pixels):.2g}, as of a normalised image"
        remedy = "multiply x by its width and y by its height"
        raise NpzError(f"{path}: keypoints: expected pixels, as focal and centre, got {got}; {remedy}")
    count = int((stamps[-1] - stamps[0]) / FRAME_NS + 1e-3) + 1
    grid = stamps[0] + np.round(np.arange(count) * FRAME_NS).astype(np.int64)
    after = np.clip(np.searchsorted(stamps, grid), 1, len(stamps) - 1)
    nearest = after - (grid - stamps[after - 1] <= stamps[after] - grid)
    points = arrays.get("points")
    if points is not None and (points.ndim != 3 or points.shape[0] != len(stamps) or points.shape[2] != 3):
        raise NpzError(f"{path}: points: expected ({len(stamps)}, N, 3) metres, got {points.shape}")
    return KeyPointRecording(
        grid, *_on_grid(pixels, sure, stamps, grid, nearest), focal, centre, rotation_matrix(pose.orientation),
        None if height is None else height.item(),
        None if points is None else in_sight(np.asarray(points, dtype=np.float64)[nearest]),
    )  # fmt: skip


def check_up(recording: KeyPointRecording) -> list[str]:
    """The problem, if there is one, that somebody's shoulders are below their hips throughout, as text."""
    shoulders, hips = (recording.pixels[:, joints].mean(axis=1) for joints in (SHOULDERS, HIPS))
    upwards = (shoulders - hips) @ recording.rotation[2, :2]
    known = upwards[np.isfinite(upwards)]
    if not len(known) or (known < 0).mean() < MOSTLY:
        return []
    return [
        "up_axis: shoulders are below hips in the image: unless people do lie or stand on their hands, expected pixels "
        "whose y grows downwards, or the camera's axis that points up as `up`; subtract y from the image's height"
    ]


def _on_grid(
    pixels: Floats, sure: Floats, stamps: NDArray[np.int64], grid: NDArray[np.int64], nearest: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Key points and confidences on a time grid.

    Key points are interpolated if both neighbours in time have one and are near; otherwise the nearest frame's is used.
    """
    after = np.clip(np.searchsorted(stamps, grid, side="right"), 1, len(stamps) - 1)
    span = stamps[after] - stamps[after - 1]
    share = np.where(span > 0, (grid - stamps[after - 1]) / np.maximum(span, 1), 0.0)[:, None, None]
    mixed = (1 - share) * pixels[after - 1] + share * pixels[after]
    mixed[span > LONGEST_GAP_NS] = np.nan
    return np.where(np.isfinite(mixed), mixed, pixels[nearest]), sure[nearest]
