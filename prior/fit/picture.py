"""What is to be fitted of a person in a picture: key points, and points of the surface where the camera has depth.

Torch is imported by the functions that need it: a recording of key points is read and checked without.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, JointState
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import quaternions
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from steadypose.prior.fit.humor_network import HumorNet
    from steadypose.prior.fit.observations import Pinhole
    from steadypose.prior.fit.solve import FitSettings, Start
    from steadypose.prior.fit.windows import FittedTrack, Track

Clean = Callable[[Floats], Floats]
"""what `steadypose clean` makes of joints (T, 22, 3) metres, world, at 30 Hz: joints of that shape, NaN where nobody"""

PIXEL_SIGMA = 0.01
"""Standard deviation of a key point in the picture, in focal lengths."""

CAMERA_HEIGHT, CAMERA_HEIGHT_SIGMA = 1.3, 0.3
"""Height of a camera above the floor where it is not known, and its standard deviation, in metres."""

NEAREST, FARTHEST = 0.05, 100.0
"""Range of distances of a point from the camera, in metres."""

LIFTED_SIGMA = 0.08
"""Standard deviation along an axis of key points as deep as the surface about them, in metres."""


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


def in_sight(points: Floats) -> Floats:
    """Points (T, N, 3) metres from a depth camera, NaN where none can see them: at its place, where many put what they
    have no depth of, or too far away."""
    away = np.linalg.norm(np.where(np.isfinite(points), points, np.inf), axis=-1, keepdims=True)
    return np.where((away > NEAREST) & (away < FARTHEST), points, np.nan)


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
        clean: `steadypose clean`.
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
        starts = _start_of_joints(clean(lifted), floor) or starts
    return Track(starts, observed)


def _start_of_joints(cleaned: Floats, floor: float) -> list[Start]:
    """The motion of joints (T, 22, 3) metres, world; none where half of them or more are NaN."""
    from steadypose.prior.fit.solve import Start

    known = np.flatnonzero(np.isfinite(cleaned).all(axis=(1, 2)))
    if 2 * len(known) < len(cleaned):
        return []
    nearest = known[np.abs(np.arange(len(cleaned))[:, None] - known).argmin(axis=1)]
    positions = cleaned[nearest]
    offsets = estimate_offsets(positions)
    return [Start.of(positions[:, 0], solve_rotations(positions, offsets), offsets, floor)]


def track_of_key_points(recording: KeyPointRecording, clean: Clean) -> Track:
    """As `track_of_picture`, of a recording; the camera is at the origin of the world."""
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
    from steadypose.prior.fit.windows import fit_track

    if recording.camera_height is None:
        settings = replace(settings, ground_height_sigma=CAMERA_HEIGHT_SIGMA)
    return fit_track(model, track_of_key_points(recording, clean), settings, folder, advanced=advanced)


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
        "root_velocity": np.gradient(track.joints[:, 0], 1.0 / FPS, axis=0),
        "world_positions": track.joints.astype(np.float32),
        "joint_names": np.array(JOINTS),
    }
