"""Fuses several calibrated cameras: matches their bodies by position, and merges them joint by joint.

Cameras do not take images at the same time, so each camera's bodies are first interpolated to a common grid. The
observations of a joint are then averaged as independent measurements, with inverse covariances as weights. These depend
on confidence, distance and direction, because a depth camera's error is larger along the line of sight than across it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import CANONICAL, SKELETONS, to_canonical
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.timing.resample import PERIOD_NS

SOURCE, FRAME_ID = "merged", "world"
MATCH_RADIUS_M = 0.4
"""Largest distance between two cameras' observations of one body, median over the joints, metres."""
CONFLICT_M = 0.25
"""Distance between two observations of a joint above which only the one with less variance is used, metres."""
DEPTH_ERROR_RATIO = 2.0  # ratio of the error along the line of sight to the error across it
MAX_WAIT_NS = 100_000_000  # longest time to wait for a camera before the others are merged without it, nanoseconds
CAMERA_TIMEOUT_NS = 500_000_000  # time without an image after which a camera is no longer awaited, nanoseconds
MAX_GAP_NS = 150_000_000  # longest gap between images of a camera that is interpolated, nanoseconds
CLOCK_RESET_FRAMES = 30
"""Number of consecutive late images of all cameras after which the merged stream starts anew (clocks were set)."""
MAX_BODIES = 16  # largest number of a message's bodies that are merged; cameras observe fewer


@dataclass(frozen=True)
class CameraFrame:
    """The bodies in one frame of one camera."""

    stamp_ns: int  # time of capture, nanoseconds
    joints: Floats  # (N, 22, 3) metres, world; NaN where unobserved
    confidence: Floats  # (N, 22), 0 where unobserved
    eye: Floats  # (3,) metres, world: where the camera stands


class Merge:
    """Merges the ``pose/raw`` of several cameras into one, on a 30 Hz grid of capture times.

    A frame is published when every active camera has sent its image, or after `MAX_WAIT_NS`. Only stamps count, so the
    cameras' clocks must be synchronised (across machines by NTP or PTP). Late images are counted.

    Attributes:
        counters: numbers of refused and late messages, by cause and camera.
    """

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._reset()

    def _reset(self) -> None:
        self._last: dict[str, CameraFrame] = {}
        self._waiting: dict[int, list[CameraFrame]] = {}
        self._given_ns = -1
        self._late = 0

    def update(self, raw: PoseRaw) -> list[PoseRaw]:
        """Process a camera's message and return the merged messages that it completes, oldest first."""
        frame = self._frame(raw)
        if frame is None:
            return []
        before = self._last.get(raw.source)
        late = frame.stamp_ns <= max(self._given_ns, before.stamp_ns if before else -1)
        self._late = self._late + 1 if late else 0
        if late:
            self.counters[f"late or repeated, {raw.source}"] += 1
            if self._late >= CLOCK_RESET_FRAMES:
                self._reset()
            return []
        self._last[raw.source] = frame
        if before and frame.stamp_ns - before.stamp_ns > MAX_GAP_NS:
            before = None  # too long ago to interpolate bodies in between
        after_ns = before.stamp_ns if before else frame.stamp_ns - PERIOD_NS
        for tick in range((after_ns // PERIOD_NS + 1) * PERIOD_NS, frame.stamp_ns + 1, PERIOD_NS):
            if tick > self._given_ns:
                self._waiting.setdefault(tick, []).append(_interpolated(before, frame, tick))
        return self._complete()

    def _frame(self, raw: PoseRaw) -> CameraFrame | None:
        """Return a message's bodies in the world; None if it cannot be used."""
        skeleton, place = SKELETONS.get(raw.skeleton), raw.sensor_pose
        unit = abs(float(np.linalg.norm(place.orientation)) - 1.0) < 0.01
        if raw.end_of_stream:
            self._last.pop(raw.source, None)
        elif skeleton is None:
            self.counters[f"unknown skeleton, {raw.source}"] += 1
        elif not raw.calibrated or not np.isfinite(place.position).all() or not unit:
            self.counters[f"not calibrated, {raw.source}"] += 1
        else:
            bodies = [body for body in raw.bodies if len(body.positions) == len(skeleton.joints)][:MAX_BODIES]
            self.counters[f"wrong joint count, {raw.source}"] += len(raw.bodies[:MAX_BODIES]) - len(bodies)
            joints = np.array([body.positions for body in bodies], np.float64).reshape(-1, len(skeleton.joints), 3)
            trust = np.array([body.confidence for body in bodies], np.float64).reshape(joints.shape[:2])
            joints, trust = to_canonical(skeleton, joints, np.clip(np.nan_to_num(trust), 0.0, 1.0))
            turn = Rotation.from_quat(place.orientation).as_matrix()
            return CameraFrame(raw.stamp_ns, joints @ turn.T + place.position, trust, place.position)
        return None

    def _complete(self) -> list[PoseRaw]:
        newest_ns = max(frame.stamp_ns for frame in self._last.values())
        merged = []
        for tick in sorted(self._waiting):
            expected = [f for f in self._last.values() if abs(newest_ns - f.stamp_ns) <= CAMERA_TIMEOUT_NS]
            if any(frame.stamp_ns < tick for frame in expected) and newest_ns < tick + MAX_WAIT_NS:
                break
            merged.append(self._message(tick, self._waiting.pop(tick)))
            self._given_ns = tick
        return merged

    def _message(self, stamp_ns: int, views: list[CameraFrame]) -> PoseRaw:
        bodies = [RawBody(k, *merge_joints(group)) for k, group in enumerate(match_views(views))]
        return PoseRaw(stamp_ns, FRAME_ID, SOURCE, CANONICAL.name, Pose.identity(), True, bodies)


@dataclass(frozen=True)
class CameraBody:
    """One body as one camera observes it."""

    joints: Floats  # (22, 3) metres, world; NaN where unobserved
    confidence: Floats  # (22,)
    eye: Floats  # (3,) metres, world


def match_views(views: list[CameraFrame]) -> list[list[CameraBody]]:
    """Match the bodies of several cameras at one time; returns a list of observations for each body."""
    groups: list[list[CameraBody]] = []
    for view in sorted(views, key=lambda view: -len(view.joints)):
        own = [CameraBody(j, c, view.eye) for j, c in zip(view.joints, view.confidence, strict=True)]
        # a body's position is that of the first camera that observes it
        firsts = np.array([group[0].joints for group in groups]).reshape(-1, 22, 3)
        pairs = {body: group for group, body in match_bodies(firsts, view.joints)}
        for body, observed in enumerate(own):
            if body in pairs:
                groups[pairs[body]].append(observed)
            else:
                groups.append([observed])
    return groups


def match_bodies(some: Floats, others: Floats) -> list[tuple[int, int]]:
    """Return pairs of bodies (N, 22, 3) and (M, 22, 3) at the same position, by the assignment of least distance."""
    away = np.linalg.norm(some[:, None] - others[None], axis=-1)
    both = np.isfinite(away).any(axis=-1)
    distance = np.full(away.shape[:2], np.inf)
    distance[both] = np.nanmedian(away[both], axis=-1)
    near = distance < MATCH_RADIUS_M
    rows, columns = linear_sum_assignment(np.where(near, distance - MATCH_RADIUS_M, 0.0))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if near[r, c]]


def merge_joints(bodies: list[CameraBody]) -> tuple[Floats, Floats]:
    """Merge several cameras' observations of a body to joints (22, 3) and their confidence (22,).

    The precision of an observation, up to a factor, is ``c² / d² (I + (1 / q² - 1) r rᵀ)`` for confidence c,
    distance d, line of sight r and q = `DEPTH_ERROR_RATIO`. The probability that all observations are wrong is the
    product of theirs.
    """
    joints = np.array([observed.joints for observed in bodies])
    confidence = np.array([observed.confidence for observed in bodies])
    ray = joints - np.array([observed.eye for observed in bodies])[:, None]
    reach = np.maximum(np.linalg.norm(ray, axis=-1), 0.1)
    valid = finite_joints(joints) & (confidence > 0)
    weight = np.where(valid, (confidence / np.where(valid, reach, 1.0)) ** 2, 0.0)
    surest = np.take_along_axis(joints, weight.argmax(axis=0)[None, :, None], axis=0)
    weight[~(np.linalg.norm(joints - surest, axis=-1) < CONFLICT_M)] = 0.0
    used = weight > 0
    ray = np.where(used[..., None], ray / reach[..., None], 0.0)
    precision = weight[..., None, None] * (
        np.eye(3) + (DEPTH_ERROR_RATIO**-2 - 1.0) * ray[..., :, None] * ray[..., None, :]
    )
    pulled = (precision @ np.where(used[..., None], joints, 0.0)[..., None]).sum(axis=0)
    any_used = np.asarray(used.any(axis=0))
    total = np.where(any_used[:, None, None], precision.sum(axis=0), np.eye(3))
    merged = np.linalg.solve(total, pulled)[..., 0]
    merged = np.where(any_used[:, None], merged, np.nan)
    return merged, 1.0 - np.prod(np.where(used, 1.0 - confidence, 1.0), axis=0)


def _interpolated(before: CameraFrame | None, after: CameraFrame, tick: int) -> CameraFrame:
    """Interpolate a camera's observations between two images; without an earlier one, use the later one."""
    joints, confidence = after.joints.copy(), after.confidence.copy()
    if before:
        share = (tick - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        for earlier, later in match_bodies(before.joints, after.joints):
            joints[later] += (1.0 - share) * (before.joints[earlier] - joints[later])
            confidence[later] = np.minimum(before.confidence[earlier], confidence[later])
    confidence[~finite_joints(joints)] = 0.0
    return CameraFrame(tick, joints, confidence, after.eye)
