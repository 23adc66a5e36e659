"""Key points of a picture as ``.npz``, with the camera that took it: what ``steadypose fit`` lifts to a motion.

In: ``keypoints`` (T, J, 2) pixels, NaN where not found; ``skeleton``, a name; ``stamp_ns`` (T,) or ``fps``; ``focal``,
pixels, one number or two; ``centre`` (2,) pixels; and where known ``confidence`` (T, J) in 0..1, ``up``, the axis of
the camera that points up (``-y``, a level camera, unless given), ``camera_height``, metres above the floor, and
``points`` (T, N, 3) metres in the camera's frame, of the body's surface, from a depth camera.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, JointState, Pose
from steadypose.nodes.driving import clean_arrays
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.sources.npz import ArraySource, NpzError, read_arrays, read_stamps
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import quaternions, rotation_matrix
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.body.skeleton import REST_OFFSETS

if TYPE_CHECKING:
    from steadypose.prior.fit.humor_network import HumorNet
    from steadypose.prior.fit.observations import Pinhole
    from steadypose.prior.fit.solve import FitSettings, Start
    from steadypose.prior.fit.windows import FittedTrack, Track


PIXEL_SIGMA = 0.01
"""Of the focal length: what a key point is off by in the picture."""

CAMERA_HEIGHT, CAMERA_HEIGHT_SIGMA = 1.3, 0.3
"""Metres above the floor at which a camera hangs of which that is not known."""

HIGHEST, NEAREST, FARTHEST = 100.0, 0.05, 100.0
"""Metres: of a camera above the floor, and of a point from it."""

LIFTED_DELAY, LIFTED_SIGMA = 8, 0.08
"""Of key points as deep as the surface about them: frames, of `clean`; metres that they are off along an axis."""

LONGEST_GAP_NS = 200_000_000
"""over which key points are interpolated"""

LONGEST_NS = 24 * 3600 * 10**9
"""of a recording: one wrong stamp must not make a grid of years"""

_NUMBERS = {"keypoints", "confidence", "focal", "centre", "camera_height", "points"}


@dataclass(frozen=True)
class KeyPointRecording:
    """One person's key points at the times of a 30 Hz grid, in canonical joints.

    Attributes:
        stamps_ns: (T,) of the grid.
        pixels: (T, 22, 2); NaN where not found.
        confidence: (T, 22).
        focal: (2,) pixels.
        centre: (2,) pixels.
        rotation: (3, 3) from the camera's frame to one that is z up.
        camera_height: metres; None where not known.
        points: (T, N, 3) metres, in the camera's frame; None where there are none.
    """

    stamps_ns: NDArray[np.int64]
    pixels: Floats
    confidence: Floats
    focal: Floats
    centre: Floats
    rotation: Floats
    camera_height: float | None
    points: Floats | None


def has_key_points(path: Path) -> bool:
    """Whether an ``.npz`` holds key points of a picture, not positions."""
    if path.suffix != ".npz" or not path.is_file():
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False
    return "keypoints.npy" in names and "positions.npy" not in names


def read_key_points(path: Path) -> KeyPointRecording:
    """Read and check it.

    Raises:
        NpzError: an array is missing, or has the wrong form; says what was expected.
    """
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
        raise NpzError(f"{path}: skeleton: expected one of {', '.join(SKELETONS)}, got {name!r}")
    layout, keypoints = SKELETONS[name], np.asarray(arrays["keypoints"], dtype=np.float64)
    joints = len(layout.joints)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (joints, 2) or len(keypoints) < 2:
        raise NpzError(f"{path}: keypoints: expected (T, {joints}, 2) pixels for {name}, T of 2 or more, got "
                       f"{keypoints.shape}")  # fmt: skip
    confidence = np.asarray(arrays.get("confidence", np.ones(keypoints.shape[:2])), dtype=np.float64)
    focal = np.asarray(arrays["focal"], dtype=np.float64).ravel()
    focal = focal.repeat(2) if focal.size == 1 else focal
    centre = np.asarray(arrays["centre"], dtype=np.float64).ravel()
    for what, value, fits in (
        ("confidence", confidence, confidence.shape == keypoints.shape[:2]),
        ("focal", focal, focal.shape == (2,) and bool((focal > 0).all())),
        ("centre", centre, centre.shape == (2,)),
    ):
        if not fits or not np.isfinite(value).all():
            raise NpzError(
                f"{path}: {what}: expected finite numbers, of each key point, or of x and y; got {value!r:.80}"
            )
    try:
        pose = Pose.from_up(str(arrays.get("up", "-y")))
    except ValueError as error:
        raise NpzError(f"{path}: {error}") from error
    stamps = _stamps(path, arrays, len(keypoints))
    weights = layout.to_canonical
    pixels = np.einsum("cj,tjx->tcx", weights, np.nan_to_num(keypoints))
    found = np.isfinite(keypoints).all(axis=-1)
    needed = weights > 0
    sure = np.where(needed, np.where(found, confidence, 0.0)[:, None], np.inf).min(axis=-1)
    sure = np.where(needed.any(axis=1), sure, 0.0)
    pixels[sure <= 0] = np.nan
    if not np.isfinite(pixels).any():
        raise NpzError(f"{path}: keypoints: expected somebody, got no key point that is finite and has a confidence")
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


def in_sight(points: Floats) -> Floats:
    """Points (T, N, 3) metres from a depth camera, NaN where none can see them: at its place, where many put what they
    have no depth of, or too far away."""
    away = np.linalg.norm(np.where(np.isfinite(points), points, np.inf), axis=-1, keepdims=True)
    return np.where((away > NEAREST) & (away < FARTHEST), points, np.nan)


def _stamps(path: Path, arrays: Mapping[str, NDArray[Any]], frames: int) -> NDArray[np.int64]:
    stamps = read_stamps(path, arrays, frames)
    if (np.diff(stamps) <= 0).any() or stamps[-1] - stamps[0] > LONGEST_NS:
        raise NpzError(f"{path}: stamp_ns: expected stamps that grow, by {LONGEST_NS / 1e9:g} s at most in all")
    return stamps


def _on_grid(
    pixels: Floats, sure: Floats, stamps: NDArray[np.int64], grid: NDArray[np.int64], nearest: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Interpolated between neighbours that both have a key point, if they are near in time."""
    after = np.clip(np.searchsorted(stamps, grid, side="right"), 1, len(stamps) - 1)
    span = stamps[after] - stamps[after - 1]
    share = np.where(span > 0, (grid - stamps[after - 1]) / np.maximum(span, 1), 0.0)[:, None, None]
    mixed = (1 - share) * pixels[after - 1] + share * pixels[after]
    mixed[span > LONGEST_GAP_NS] = np.nan
    return np.where(np.isfinite(mixed), mixed, pixels[nearest]), sure[nearest]


def track_of_picture(
    pixels: Floats,
    confidence: Floats,
    camera: Pinhole,
    floor: float,
    *,
    floor_known: bool = False,
    points: Floats | None = None,
) -> Track:
    """What is to be fitted of a person in a picture, and the motions to start from.

    With points, the start is what `clean` says of the key points as deep as the surface about them, which are observed
    too; without, or if it finds nobody, it is that of `starts_of_key_points`.

    Args:
        pixels: (T, 22, 2) at 30 Hz, NaN where not found.
        confidence: (T, 22) 0 to 1.
        camera: that took it.
        floor: metres, world, its height, or a guess.
        floor_known: which of the two.
        points: (T, N, 3) metres, world, of the body's surface, NaN where there are fewer; None if there are none.
    """
    import torch

    from steadypose.prior.fit.lift import lift, starts_of_key_points
    from steadypose.prior.fit.motion import float_tensor
    from steadypose.prior.fit.observations import KeyPoints, Observed, SeenJoints, SurfacePoints, thinned
    from steadypose.prior.fit.windows import Track

    sigma = PIXEL_SIGMA * float(camera.focal.mean())
    observed: list[Observed] = [KeyPoints(float_tensor(pixels), float_tensor(confidence), camera, sigma)]
    starts = starts_of_key_points(pixels, camera, REST_OFFSETS, floor, floor_known=floor_known)
    if points is not None:
        lifted = lift(pixels, camera, points)
        observed.append(SurfacePoints(float_tensor(thinned(points)), camera.position))
        observed.append(SeenJoints(float_tensor(lifted), torch.full(lifted.shape[:-1], LIFTED_SIGMA)))
        starts = _start_of_joints(lifted, floor) or starts
    return Track(starts, observed)


def _start_of_joints(joints: Floats, floor: float) -> list[Start]:
    """The motion that `clean` makes of joints (T, 22, 3) metres, world; none where it finds nobody in half of it."""
    from steadypose.prior.fit.solve import Start

    stamps = np.round(np.arange(len(joints)) * FRAME_NS).astype(np.int64)
    told = {"positions": joints, "stamp_ns": stamps, "skeleton": np.array("smpl22")}
    settings = {"prior": {"delay": LIFTED_DELAY}, "trajectory": {}}
    found = clean_arrays(ArraySource(Path("key points"), told), settings)["positions"].astype(float)
    known = np.flatnonzero(np.isfinite(found).all(axis=(1, 2)))
    if 2 * len(known) < len(found):
        return []
    nearest = known[np.abs(np.arange(len(found))[:, None] - known).argmin(axis=1)]
    positions = found[nearest]
    offsets = estimate_offsets(positions)
    return [Start.of(positions[:, 0], solve_rotations(positions, offsets), offsets, floor)]


def track_of_key_points(recording: KeyPointRecording) -> Track:
    """What is to be fitted of a recording; the camera is at the origin of the world."""
    import torch

    from steadypose.prior.fit.motion import float_tensor
    from steadypose.prior.fit.observations import Pinhole

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
    )


def fit_key_points(
    model: HumorNet,
    recording: KeyPointRecording,
    settings: FitSettings,
    folder: Path | None,
    advanced: Callable[[], None] = lambda: None,
) -> FittedTrack:
    """Fit one person."""
    from steadypose.prior.fit.windows import fit_track

    if recording.camera_height is None:
        settings = replace(settings, ground_height_sigma=CAMERA_HEIGHT_SIGMA)
    return fit_track(model, track_of_key_points(recording), settings, folder, advanced=advanced)


def arrays_of_fit(recording: KeyPointRecording, track: FittedTrack) -> dict[str, NDArray[Any]]:
    """As ``steadypose clean`` writes them, in the camera's frame, at 30 Hz; of deviations and anomalies, none."""
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
        "root_velocity": np.gradient(track.joints[:, 0], FRAME_NS * 1e-9, axis=0),
        "world_positions": track.joints.astype(np.float32),
        "joint_names": np.array(JOINTS),
    }
