"""A simulated depth camera with a body tracker that observes simulated people.

Each joint's line of sight is traced through the bodies' capsules. A hidden joint is guessed or lost. A joint near a
silhouette sometimes takes the depth of the surface behind or in front of it. All other errors come from the `noise`
model. Their fast part grows with distance: along the ray with its square, as in stereo, and across the ray linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.capsules import CAPSULES, REST_HEIGHT, Mount, mount, stature
from steadypose.prior.body.skeleton import COLLARS, JOINTS, TRUNK, J
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.noise import (
    SWAP_GROUPS,
    NoiseModel,
    confidence_of,
    draw_errors,
    ray_axes,
    stationary,
    swapped,
    travelled,
)

REFERENCE_RANGE = 2.6  # median distance at which the noise was measured, metres

FRAME_ID = "camera_optical_frame"


@dataclass(frozen=True)
class Camera:
    """A camera: its pose, field of view, timing and tracker."""

    position: tuple[float, float, float]  # metres, world
    look_at: tuple[float, float, float]  # metres, world, the point in the middle of the image
    roll: float = 0.0  # radians about the line of sight, positive clockwise as seen in the image
    field_of_view: tuple[float, float] = (1.22, 1.05)  # radians, horizontal and vertical
    near: float = 0.5  # metres, distance below which it measures no depth
    background: float = 5.5  # metres along the line of sight to the wall behind the people
    fps: float = 30.0  # nominal frames per second
    stamp_jitter: float = 0.002  # seconds, standard deviation of the frames' times about equal intervals
    drop_rate: float = 0.01  # share of frames that never arrive
    skeleton: str = "kinect22"  # joint layout of its tracker
    calibrated: bool = True  # whether its pose in the world is known; if not, only the direction of gravity is

    @property
    def orientation(self) -> Floats:
        """(3, 3) rotation from the optical frame (x right, y down, z forward) to the world."""
        forward = np.subtract(self.look_at, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(self.roll), np.sin(self.roll)
        return np.stack([c * right + s * down, c * down - s * right, forward], axis=-1)

    def estimated_pose(self) -> Pose:
        """The pose in its messages: the true pose if calibrated, otherwise only the up direction."""
        if self.calibrated:
            return Pose(np.array(self.position), Rotation.from_matrix(self.orientation).as_quat())
        forward = self.orientation[:, 2]
        unturn = Rotation.from_euler("z", -np.arctan2(forward[1], forward[0])).as_matrix()
        return Pose(np.zeros(3), Rotation.from_matrix(unturn @ self.orientation).as_quat())

    def capture_times(self, duration: float, rng: np.random.Generator) -> Floats:
        """Capture times of the frames that arrive, seconds, between 0 and ``duration``."""
        nominal = np.arange(0.1, duration - 0.1, 1.0 / self.fps)
        jitter = np.clip(self.stamp_jitter * rng.standard_normal(len(nominal)), -0.3 / self.fps, 0.3 / self.fps)
        # frames are lost singly and in runs: after a lost frame, the next is lost too two times in five
        lost = rng.random(len(nominal)) < 0.6 * self.drop_rate
        for k in range(1, len(lost)):
            lost[k] |= lost[k - 1] and rng.random() < 0.4
        return (nominal + jitter)[~lost]

    def in_view(self, points: Floats) -> Bools:
        """Which points (..., 3), optical frame, lie in the image and beyond `near`."""
        x, y, z = np.moveaxis(points, -1, 0)
        half = np.tan(np.array(self.field_of_view) / 2)
        return (z > self.near) & (np.abs(x) < half[0] * z) & (np.abs(y) < half[1] * z)


@dataclass(frozen=True)
class Sight:
    """Occlusion of joints (T, J) from a camera."""

    hidden: Floats  # 0 if visible, 1 behind a body, between 0 and 1 at its edge
    beside: Floats  # metres, depth of the nearest other surface that the ray almost touches; infinite if there is none


def sight(points: Floats, bodies: Sequence[Motion], position: Floats) -> Sight:
    """Trace the ray to each of ``points`` (T, J, 3) through the capsules of all bodies.

    A capsule that contains the point itself (a joint inside its own limb) does not hide it.
    """
    hidden, beside = np.zeros(points.shape[:-1]), np.full(points.shape[:-1], np.inf)
    reach = np.linalg.norm(points - position, axis=-1)
    for body in bodies:
        scale = stature(body.offsets) / REST_HEIGHT
        for first, second, radius in CAPSULES:
            radius = radius * scale
            a, b = body.positions[:, J[first], None], body.positions[:, J[second], None]
            gap, along = segment_gap(np.broadcast_to(position, points.shape), points, a, b)
            own = _to_segment(points, a, b) < 1.15 * radius
            depth = along * reach
            ahead = ~own & (depth < reach - 0.3 * radius)
            cover = np.where(ahead, np.clip((radius - gap) / (0.35 * radius) + 0.5, 0.0, 1.0), 0.0)
            surface = depth - np.sqrt(np.maximum(radius**2 - gap**2, 0.0))
            hidden = np.maximum(hidden, cover)
            grazed = ~own & (gap < 1.6 * radius)
            beside = np.where(grazed & (surface < beside), surface, beside)
    return Sight(hidden, beside)


def segment_gap(p: Floats, q: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Distance (...) between segments pq and ab (..., 3), and the parameter on pq (0..1) of the nearest point.

    Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    d1, d2, r = q - p, b - a, p - a
    aa, ee, f = (d1 * d1).sum(-1), (d2 * d2).sum(-1), (d2 * r).sum(-1)
    c, bb = (d1 * r).sum(-1), (d1 * d2).sum(-1)
    denominator = aa * ee - bb * bb
    s = np.clip((bb * f - c * ee) / np.maximum(denominator, 1e-12), 0.0, 1.0)
    t = np.clip((bb * s + f) / np.maximum(ee, 1e-12), 0.0, 1.0)
    s = np.clip((bb * t - c) / np.maximum(aa, 1e-12), 0.0, 1.0)
    return np.linalg.norm(p + s[..., None] * d1 - a - t[..., None] * d2, axis=-1), s


def _to_segment(point: Floats, a: Floats, b: Floats) -> Floats:
    along = b - a
    t = np.clip(((point - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0.0, 1.0)
    return np.linalg.norm(point - a - t[..., None] * along, axis=-1)


_LIMB_ENDS = np.array([n.endswith(("elbow", "wrist", "ankle", "foot", "knee")) for n in JOINTS])
_ON_TRUNK = np.isin(np.arange(len(JOINTS)), [*TRUNK, *COLLARS])
_BLEED_RATE = 0.25  # rate at which a limb's end takes the depth of the wall behind it, 1/s
_BLEED_BESIDE_RATE = 1.5  # the same rate for a ray that grazes another surface, 1/s
_BLEED_DURATION = 0.08  # mean duration of such an error, seconds
_GUESS_STD = 0.07  # standard deviation of the tracker's guess of a hidden joint, metres
_GUESS_MEMORY = 0.6  # correlation time of such a guess, seconds
_LOST_SHARE = 0.45  # share of hidden joints that the tracker reports as lost
_MIN_JOINTS = 0.4  # least share of a body's joints that must be visible for it to be reported
_FIND_AFTER = 0.3  # time in view before a lost body is detected again, seconds
_FORGET_AFTER = 0.8  # time out of view after which a body gets a new id, seconds


def film(
    people: Sequence[Motion], camera: Camera, noise: NoiseModel, rng: np.random.Generator, source: str, start_ns: int
) -> list[PoseRaw]:
    """Simulate the camera's tracker output, with its error model, of motions of equal duration whose second 0 has the
    stamp ``start_ns``: frames in the order of their stamps, with the `Camera.estimated_pose`."""
    times = camera.capture_times(min(m.times[-1] for m in people), rng)
    filmed = [m.at(times) for m in people]
    tracks = [_track(k, filmed, camera, noise, times, rng) for k in range(len(filmed))]
    ids = _ids([t.reported for t in tracks], times)
    frames: list[PoseRaw] = []
    for f, time in enumerate(times):
        bodies = [
            RawBody(int(ids[k][f]), track.positions[f], track.confidence[f])
            for k, track in enumerate(tracks)
            if track.reported[f]
        ]
        stamp = start_ns + round(time * 1e9)
        frames.append(
            PoseRaw(stamp, FRAME_ID, source, camera.skeleton, camera.estimated_pose(), camera.calibrated, bodies)
        )
    return frames


@dataclass(frozen=True)
class _Track:
    positions: Floats  # (T, J, 3) metres, optical frame, NaN where lost
    confidence: Floats  # (T, J)
    reported: Bools  # (T,)


def _track(
    which: int, people: Sequence[Motion], camera: Camera, noise: NoiseModel, times: Floats, rng: np.random.Generator
) -> _Track:
    person = people[which]
    on_body = mount(camera.skeleton)
    dt = np.diff(times, prepend=times[0] - 1.0 / camera.fps)
    eye = np.array(camera.position)
    truth = on_body.positions(person.positions, person.orientations, stature(person.offsets) / REST_HEIGHT)
    view = sight(truth, people, eye)
    hidden = as_tracked(view.hidden, on_body)
    points = _exchanged(truth, on_body, swapped(dt, rng, _swap_rate_factor(person, eye)))

    reach = np.linalg.norm(points - eye, axis=-1)
    drawn = draw_errors(travelled(person.positions), dt, rng, noise)
    farther = (reach / REFERENCE_RANGE)[..., None]
    error = drawn.steady[:, on_body.joint]
    error = error + drawn.quick[:, on_body.joint] * np.concatenate([farther**2, farther, farther], axis=-1)
    scale = drawn.scale[:, on_body.joint] * farther[..., 0]

    # a hidden joint is a guess that drifts; whether the tracker reports it as lost changes more slowly
    joints = truth.shape[1]
    guess = _GUESS_STD * stationary(dt, _GUESS_MEMORY, (joints, 3), rng)
    error += hidden[..., None] * guess
    scale = np.hypot(scale, _GUESS_STD * hidden)
    mood = stationary(dt, 2.0, (joints, 1), rng)[..., 0]
    given_up = (hidden > 0.5) & (mood > ndtri(1 - _LOST_SHARE))

    # depth read beside the joint instead of on it
    ends = _LIMB_ENDS[on_body.joint]
    to_wall = _bursts(dt, ends * _BLEED_RATE * farther[..., 0], rng)
    to_flesh = _bursts(dt, np.where(np.isfinite(view.beside), _BLEED_BESIDE_RATE, 0.0), rng)
    share = rng.uniform(0.3, 1.0, reach.shape)
    error[..., 0] += np.where(to_wall, 0.35 * share * np.maximum(camera.background - reach, 0.0), 0.0)
    error[..., 0] += np.where(to_flesh & np.isfinite(view.beside), share * (np.minimum(view.beside, 1e3) - reach), 0.0)
    # a tracker that reads a wrong depth does not always lower its confidence
    suspects = (to_wall | to_flesh) & (rng.random(reach.shape) < 0.6)
    scale = np.where(suspects, np.maximum(scale, 0.12), scale)

    observed = points + np.einsum("tjk,tjkx->tjx", error, ray_axes(points - eye))
    optical = (observed - eye) @ camera.orientation
    outside = ~camera.in_view((truth - eye) @ camera.orientation)
    lost = given_up | outside | (optical[..., 2] < camera.near)
    positions = np.where(lost[..., None], np.nan, optical)
    confidence = np.where(lost, 0.0, confidence_of(scale, rng))
    reported = _reported((~outside & (hidden < 0.5)).mean(axis=1) >= _MIN_JOINTS, times)
    return _Track(positions, confidence, reported)


def as_tracked(hidden: Floats, on_body: Mount) -> Floats:
    """Treat the trunk as a whole: an arm in front of it hides none of its joints, another body hides all of them."""
    trunk = _ON_TRUNK[on_body.joint]
    return np.where(trunk, np.minimum(hidden, hidden[:, trunk].mean(axis=1, keepdims=True)), hidden)


def _swap_rate_factor(person: Motion, eye: Floats) -> Floats:
    """(T,) factor on `SWAP_RATE`: 1 for a body that faces the camera, 10 for one seen from its side or back."""
    away = person.root - eye
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    facing = -(person.orientations[:, 0, :, 0] * away).sum(axis=-1)
    return 1.0 + 9.0 * np.clip(1.0 - facing, 0.0, 1.0) ** 2


def _exchanged(truth: Floats, on_body: Mount, when: dict[str, Bools]) -> Floats:
    points = truth.copy()
    for group, active in when.items():
        columns = np.flatnonzero(np.isin(on_body.joint, SWAP_GROUPS[group]))
        points[:, columns] = np.where(active[:, None, None], truth[:, on_body.mirror[columns]], truth[:, columns])
    return points


def _bursts(dt: Floats, rate: Floats, rng: np.random.Generator) -> Bools:
    """(T, J) random bursts with the rate ``rate`` (T, J) 1/s and the mean duration `_BLEED_DURATION`."""
    begin = rng.random(rate.shape) < 1 - np.exp(-rate * dt[:, None])
    end = rng.random(rate.shape) < 1 - np.exp(-dt[:, None] / _BLEED_DURATION)
    on = np.zeros(rate.shape, dtype=bool)
    for t in range(1, len(dt)):
        on[t] = np.where(on[t - 1], ~end[t], begin[t])
    return on


def _reported(visible: Bools, times: Floats) -> Bools:
    """When a body is reported: once it has been visible for a while, until it is not."""
    appears = visible & ~np.concatenate([[True], visible[:-1]])  # what is visible at the start was so before
    began = np.maximum.accumulate(np.where(appears, times, times[0] - 1.0))
    return visible & (times - began >= _FIND_AFTER)


def _ids(reported: Sequence[Bools], times: Floats) -> list[NDArray[np.int64]]:
    """(T,) track ids of each body, counted up as bodies appear; a new id after a long absence."""
    ids = [np.zeros(len(times), dtype=np.int64) for _ in reported]
    current, last_reported, next_id = [0] * len(reported), [-np.inf] * len(reported), 1
    for t, time in enumerate(times):
        for k, there in enumerate(reported):
            if there[t]:
                if time - last_reported[k] > _FORGET_AFTER:
                    current[k], next_id = next_id, next_id + 1
                last_reported[k] = time
                ids[k][t] = current[k]
    return ids
