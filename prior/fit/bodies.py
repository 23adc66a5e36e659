"""Fit of the bodies of a cleaned stream: test-time optimisation, initialised by ``pose/clean``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import CleanBody, JointState, Message, PoseClean, PoseRaw, PoseWorld, WorldBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import REST_HEIGHT, SensorFrame, quaternions, rotation_matrices
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.motion import float_tensor
from steadypose.prior.fit.observations import POINT_SHARE, Observed, SeenJoints, SurfacePoints, thinned
from steadypose.prior.fit.solve import FitSettings, Start
from steadypose.prior.fit.windows import MIN_FRAMES, FittedTrack, Track, fit_track
from steadypose.prior.timing.rate import FPS

FRAME_NS = 1e9 / FPS
MIN_SIGMA = 0.01
"""Least standard deviation of an observed joint, metres; sensors' joint definitions differ from ours by this much."""

FAR = 0.1
"""Largest distance, plus five times the noise, between an observed joint and ``pose/clean``, metres. An observation
farther away is an outlier: another limb, or no joint."""

LOWEST = 5.0
"""Share of the frames in which the lower foot is assumed to stand on the floor, if the floor is unknown, per cent."""

WORSE, WORSE_M = 2.0, 0.02
"""Ratio to the median misfit of ``pose/clean``, and difference from it in metres, above which a fit has failed."""

ELSEWHERE, ELSEWHERE_SHARE, STILL = 0.1, 0.4, 0.3
"""Thresholds for a body on stairs or a chair: distance of the lower foot from the floor, metres; least share of the
frames with that distance among those in which the foot is slow; and largest speed of a slow foot, m/s. The motion model
has only one floor, to which it would move the feet."""

_MEDIAN_NORM, _THIRD = 1.538, np.sqrt(20.0)
"""Median length of a standard normal 3D vector, and standard deviation of third differences of unit white noise."""


@dataclass(frozen=True)
class Seen:
    """One body while it is present without a gap, at 30 Hz."""

    id: int  # id of the body
    clean: Sequence[PoseClean]  # (T,) messages that contain it
    bodies: Sequence[CleanBody]  # (T,) the body in ``pose/clean``
    calibrated: bool  # whether the world's floor is at 0

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """(T,)"""
        return np.array([message.stamp_ns for message in self.clean])

    def in_world(self, name: str) -> Floats:
        """(T, 22, 3) metres, positions or raw positions in the world, z up."""
        return np.stack([
            SensorFrame.of(message.sensor_pose).to_world(np.asarray(getattr(body, name), dtype=np.float64))
            for message, body in zip(self.clean, self.bodies, strict=True)
        ])  # fmt: skip

    @property
    def rotations(self) -> Floats:
        """(T, 22, 3, 3) local; the root's to the world."""
        published = np.stack([body.rotations for body in self.bodies]).astype(np.float64)
        turned = rotation_matrices(published / np.linalg.norm(published, axis=-1, keepdims=True))
        sensor = np.stack([SensorFrame.of(message.sensor_pose).rotation for message in self.clean])
        turned[:, 0] = sensor @ turned[:, 0]
        return turned


@dataclass(frozen=True)
class Fit:
    """The fit of a body."""

    seen: Seen  # the body
    track: FittedTrack | None  # the fit; None if it failed, so that ``pose/clean`` stays
    misfit: Floats
    """(T, 22) remaining distance from the observations, metres or pixels; NaN where a joint is unobserved"""


def bodies_seen(messages: Sequence[tuple[str, Message]], least: int) -> list[Seen]:
    """Return every body of a cleaned stream, divided at gaps, if it is complete for at least ``least`` frames."""
    found: list[Seen] = []
    of_body: dict[int, list[tuple[PoseClean, CleanBody]]] = {}
    for _, message in messages:
        if isinstance(message, PoseClean):
            for body in message.bodies:
                if np.isfinite(body.positions).all():
                    of_body.setdefault(body.id, []).append((message, body))
    for number, rows in of_body.items():
        stamps = np.array([message.stamp_ns for message, _ in rows])
        cuts = np.flatnonzero(np.diff(stamps) > 1.5 * FRAME_NS) + 1
        for first, last in zip([0, *cuts], [*cuts, len(rows)], strict=True):
            clean, bodies = zip(*rows[first:last], strict=True)
            if last - first >= least:
                found.append(Seen(number, clean, bodies, clean[0].calibrated))
    return found


def track_of(seen: Seen, points: Floats | None) -> Track:
    """Build the track to fit of a body, starting from ``pose/clean``; ``points`` (T, N, 3) metres, world, are of its
    surface, padded with NaN."""
    positions, raw = seen.in_world("positions"), seen.in_world("raw_positions")
    floor = 0.0 if seen.calibrated else lowest_floor(positions)
    start = Start.of_joints(positions, floor, rotations=seen.rotations, ground_known=seen.calibrated)
    noise = noise_of(raw)
    raw = np.where(np.linalg.norm(raw - positions, axis=-1, keepdims=True) > FAR + 5.0 * noise, np.nan, raw)
    confidence = np.clip(np.stack([body.raw_confidence for body in seen.bodies]), 0.05, 1.0)
    sigma = noise / np.sqrt(confidence)
    observed: list[Observed] = [SeenJoints(float_tensor(raw), float_tensor(sigma))]
    if points is not None:
        camera = np.stack([SensorFrame.of(message.sensor_pose).origin for message in seen.clean])
        observed.append(SurfacePoints(float_tensor(thinned(points)), float_tensor(camera), weight=POINT_SHARE))
    return Track([start], observed)


def lowest_floor(positions: Floats) -> float:
    """Return the floor's height, metres, if the lower foot of (T, 22, 3) stands on it in the lowest few frames."""
    feet = [J[f"{side}_foot"] for side in ("left", "right")]
    rest = REST_HEIGHT[4]
    return float(np.percentile(positions[:, feet, 2].min(axis=1), LOWEST) - rest)


def stands_elsewhere(positions: Floats, floor: float) -> bool:
    """Whether feet of (T, 22, 3) metres also stand elsewhere than on a floor at this height, metres."""
    feet = [J[f"{side}_{part}"] for part in ("ankle", "foot") for side in ("left", "right")]
    heights = positions[:, feet, 2] - floor - np.array(REST_HEIGHT)[2:6]
    speed = np.linalg.norm(np.gradient(positions[:, feet], 1e-9 * FRAME_NS, axis=0), axis=-1)
    rows, lower = np.arange(len(positions)), heights.argmin(axis=1)
    stands = speed[rows, lower] < STILL
    return bool(stands.any() and (np.abs(heights[rows, lower][stands]) > ELSEWHERE).mean() > ELSEWHERE_SHARE)


def noise_of(raw: Floats) -> float:
    """Estimate the noise of joints (T, 22, 3), metres along an axis, from third differences: motion has hardly any."""
    third = np.linalg.norm(np.diff(raw, n=3, axis=0), axis=-1)
    third = third[np.isfinite(third)]
    return max(float(np.median(third)) / _MEDIAN_NORM / float(_THIRD), MIN_SIGMA) if len(third) else MIN_SIGMA


def fit_body(
    model: HumorNet,
    seen: Seen,
    points: Floats | None,
    settings: FitSettings,
    folder: Path | None,
    advanced: Callable[[], None] = lambda: None,
) -> Fit:
    """Fit one body. If this fails, or the body stands elsewhere, ``pose/clean`` stays and its anomaly is flagged."""
    positions, raw = seen.in_world("positions"), seen.in_world("raw_positions")
    before = np.linalg.norm(positions - raw, axis=-1)
    if stands_elsewhere(positions, 0.0 if seen.calibrated else lowest_floor(positions)):
        return Fit(seen, None, before)
    fitted = fit_track(model, track_of(seen, points), settings, folder, advanced=advanced)
    misfit = np.linalg.norm(fitted.joints - raw, axis=-1)
    known = np.isfinite(before)
    if not np.isfinite(fitted.joints).all() or (
        known.any() and np.median(misfit[known]) > WORSE * np.median(before[known]) + WORSE_M
    ):
        return Fit(seen, None, before)
    return Fit(seen, fitted, misfit)


def fit_stream(
    messages: Sequence[tuple[str, Message]],
    surface: Floats | None,
    model: HumorNet,
    folder: Path | None = None,
    began: Callable[[Sequence[Seen]], None] = lambda bodies: None,
    advanced: Callable[[], None] = lambda: None,
) -> list[Fit]:
    """Fit every body of a cleaned stream, including ``pose/raw``, that is present for long enough.

    ``surface`` (T, N, 3) metres are points of the body's surface in the sensor's frame for each frame of ``pose/raw``,
    padded with NaN. ``folder`` is a cache of finished windows, so that an interrupted call can resume. ``began`` is
    called with the bodies, ``advanced`` after each window.
    """
    bodies = bodies_seen(messages, MIN_FRAMES)
    stamps = np.array([m.stamp_ns for _, m in messages if isinstance(m, PoseRaw) and not m.end_of_stream], np.int64)
    began(bodies)
    fits = []
    for number, seen in enumerate(bodies):
        own = None
        if folder is not None:
            own = folder / f"{number:04d}"
            own.mkdir(exist_ok=True)
        points = None
        if surface is not None:
            nearest = np.abs(stamps[None] - seen.stamps_ns[:, None]).argmin(axis=1)
            points = np.stack([
                SensorFrame.of(message.sensor_pose).to_world(frame)
                for message, frame in zip(seen.clean, surface[nearest], strict=True)
            ])  # fmt: skip
        fits.append(fit_body(model, seen, points, FitSettings(), own, advanced))
    return fits


def rewritten(messages: Sequence[tuple[str, Message]], fits: Sequence[Fit]) -> list[tuple[str, Message]]:
    """Return the messages of a cleaned stream with fitted poses."""
    clean: dict[tuple[int, int], CleanBody] = {}
    world: dict[tuple[int, int], tuple[Fit, int]] = {}
    planes: dict[int, Floats] = {}
    for fit in fits:
        for row, (message, body) in enumerate(zip(fit.seen.clean, fit.seen.bodies, strict=True)):
            key = message.stamp_ns, body.id
            if fit.track is None:
                clean[key] = replace(body, anomaly_flag=True)
                continue
            clean[key] = _fitted_clean(fit.track, row, message, body)
            world[key] = fit, row
            planes[message.stamp_ns] = ground_plane(fit.track.ground.mean(axis=0))
    out: list[tuple[str, Message]] = []
    for topic, message in messages:
        if isinstance(message, PoseClean):
            message = replace(message, bodies=[clean.get((message.stamp_ns, body.id), body) for body in message.bodies])
        elif isinstance(message, PoseWorld):
            bodies = [
                _fitted_world(*world[key], body) if (key := (message.stamp_ns, body.id)) in world else body
                for body in message.bodies
            ]
            plane = planes.get(message.stamp_ns, message.ground_plane)
            message = replace(message, bodies=bodies, ground_plane=plane)
        out.append((topic, message))
    return out


def ground_plane(ground: Floats) -> Floats:
    """(4,) ground plane, as in `PoseWorld`, from a height and two tilts."""
    from scipy.spatial.transform import Rotation

    normal = Rotation.from_rotvec([ground[1], ground[2], 0.0]).as_matrix()[:, 2]
    return np.array([*normal, -normal[2] * ground[0]])


def _fitted_clean(track: FittedTrack, row: int, message: PoseClean, body: CleanBody) -> CleanBody:
    sensor = SensorFrame.of(message.sensor_pose)
    rotations = track.rotations[row].copy()
    rotations[0] = sensor.rotation.T @ rotations[0]
    state = np.where(body.state == JointState.SEEN, JointState.REFINED, body.state)
    return replace(
        body,
        positions=sensor.from_world(track.joints[row]),
        rotations=quaternions(rotations),
        state=state,
        bone_lengths=np.linalg.norm(track.offsets.mean(axis=0), axis=-1),
    )


def _fitted_world(fit: Fit, row: int, body: WorldBody) -> WorldBody:
    track = fit.track
    assert track is not None
    joints = track.joints
    around = slice(max(row - 1, 0), row + 2)
    velocity = np.gradient(joints[around, 0], 1e-9 * FRAME_NS, axis=0)[min(row, 1)]
    turned = quaternions(track.rotations[row])
    # a foot whose contacts are unknown in `pose/world` is only guessed in a fit too
    load = np.where(np.isnan(track.load[row]) | np.isnan(body.contacts), body.contacts, track.load[row])
    return replace(
        body, root_position=joints[row, 0], root_orientation=turned[0], root_velocity=velocity, positions=joints[row],
        rotations=turned, contacts=load,
    )  # fmt: skip
