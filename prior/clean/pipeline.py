"""The prior, stage by stage: adapt, gate, correct, smooth, encode, denoise, bones, score, impute, solve, refine, fuse.

One object serves a stream: `PriorPipeline.process` takes ``pose/raw`` messages and gives the ``pose/clean`` messages
they complete. All bodies go through each stage together, one slot a body. Nothing here reads a clock or draws a
random number: the same input gives the same output, bit for bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import CleanBody, Pose, PoseClean, PoseRaw, RawBody
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.layouts import CANONICAL, SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.skeleton import REST_OFFSETS, J, finite_joints
from steadypose.prior.clean.correct import Correct, CorrectSettings
from steadypose.prior.clean.denoise import Denoise, DenoiseSettings
from steadypose.prior.clean.frame import Estimate, Stage, Window
from steadypose.prior.clean.fuse import Fuse, FuseSettings
from steadypose.prior.clean.gate import Gate, GateSettings
from steadypose.prior.clean.identify import Identify, IdentifySettings
from steadypose.prior.clean.impute import Impute, ImputeSettings
from steadypose.prior.clean.person import Bones, BonesSettings
from steadypose.prior.clean.reconstruct import Encode, EncodeSettings
from steadypose.prior.clean.refine import Refine, RefineSettings
from steadypose.prior.clean.score import Score, ScoreSettings
from steadypose.prior.clean.smooth import Smooth, SmoothSettings
from steadypose.prior.clean.solve import Solve
from steadypose.prior.settings import build_settings
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.resample import Resampler

MAX_DISTANCE = 30.0
"""Metres from the sensor beyond which a joint is no sighting."""
MIN_JOINTS = 6
"""Canonical joints that must be seen for a body to be taken up."""
UNIT_TOLERANCE = 0.01
"""How far from 1 the norm of a sensor pose's quaternion may be."""
BACKWARDS_NS = 1_000_000_000
"""A stamp this far before the last starts a new stream; one nearer is a frame out of order."""


@dataclass(frozen=True)
class PriorSettings:
    """Settings of the prior: ``[prior]`` of a launch file.

    Attributes:
        delay: frames at 30 Hz to wait for before answering, 0 to twice the model's window (4, the default, half of
            it, is the paper's centre-frame refinement).
        max_bodies: bodies followed at once.
        timeout: seconds without a sighting after which a body is dropped, and without a frame after which the
            stream starts anew.
        bias_sigma: metres along an axis, the sensor's slow error, which no filter averages out: the less of it, the
            more bones are measured rather than taken from human proportions, and the surer joints are said to be.
            Depth cameras have 2 cm or more, marker-based motion capture next to none.
        identify: who tells bodies apart: the source (the default), or the prior.
        gate, correct, smooth, encode, denoise, bones, score, impute, refine, fuse: settings of the stages.
    """

    delay: int = 4
    max_bodies: int = 8
    timeout: float = 0.5
    bias_sigma: float = 0.02
    identify: IdentifySettings = field(default_factory=IdentifySettings)
    gate: GateSettings = field(default_factory=GateSettings)
    correct: CorrectSettings = field(default_factory=CorrectSettings)
    smooth: SmoothSettings = field(default_factory=SmoothSettings)
    encode: EncodeSettings = field(default_factory=EncodeSettings)
    denoise: DenoiseSettings = field(default_factory=DenoiseSettings)
    bones: BonesSettings = field(default_factory=BonesSettings)
    score: ScoreSettings = field(default_factory=ScoreSettings)
    impute: ImputeSettings = field(default_factory=ImputeSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    fuse: FuseSettings = field(default_factory=FuseSettings)

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> PriorSettings:
        """From the section of a launch file.

        Raises:
            ValueError: a key that does not exist (the message names the nearest that does) or a wrong type.
        """
        return build_settings(cls, settings, "prior")


class PriorPipeline:
    """The stages of the prior over a stream.

    Attributes:
        counters: what was refused or dropped so far, by cause.
        delay_frames: frames at 30 Hz between a frame and its answer.
    """

    def __init__(self, settings: PriorSettings) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self.delay_frames = settings.delay
        slots = settings.max_bodies
        refine = Refine(settings.refine, settings.delay)
        self._identify = Identify(settings.identify, 2 * slots, self.counters) if settings.identify.enabled else None
        self._resampler = Resampler(slots)
        # what the sensor may be off by, slowly and fast
        sensor_sigma = float(np.hypot(settings.bias_sigma, settings.smooth.measurement_sigma))
        denoise, score, impute = settings.denoise.enabled, settings.score.enabled, settings.impute.enabled
        needed = denoise or score or impute
        self._encode = Encode(settings.encode, sensor_sigma, settings.bias_sigma, slots) if needed else None
        self._denoise = Denoise(settings.smooth.measurement_sigma, settings.delay, slots) if denoise else None
        self._impute = Impute(settings.impute, settings.delay, slots, self.counters) if impute else None
        shortest = max(refine.window, settings.delay + 1)
        window_frames = max(shortest, self._encode.frames if self._encode else 0)
        self._window = Window(window_frames, slots, decoded_frames=shortest)
        self._smooth = Smooth(settings.smooth, settings.delay, slots)
        self._fuse = Fuse(settings.fuse, settings.bias_sigma, settings.delay, slots)
        stages: tuple[Stage | None, ...] = (
            Gate(settings.gate, slots, self.counters),
            Correct(settings.correct, slots) if settings.correct.sensor else None,
            self._smooth,
            self._encode,
            self._denoise,
            Bones(settings.bones, settings.bias_sigma, slots),
            Score(settings.score, settings.encode.weights, sensor_sigma, slots) if score else None,
            self._impute,
            Solve(),
            refine,
            self._fuse,
        )
        self._stages = [stage for stage in stages if stage]
        self._ids: list[int | None] = [None] * slots
        self._unseen_ns = np.zeros(slots, dtype=np.int64)
        self._last: PoseRaw | None = None
        self._origin_ns = 0  # stage times are seconds since: a float of seconds since 1970 would round stamps

    def process(self, raw: PoseRaw, *, hurry: bool = False) -> list[PoseClean]:
        """Take a ``pose/raw`` message and give the ``pose/clean`` messages it completes, oldest first.

        A message that cannot be used is counted in `counters` and otherwise ignored. In a hurry, hidden joints are
        imputed without gradient ascent: for a live node that falls behind. A replay is never in a hurry.
        """
        if self._impute:
            self._impute.hurry = hurry
        if raw.end_of_stream:
            ended = self._clean(raw.stamp_ns, raw, [])
            ended.end_of_stream = True
            if self._identify:
                self._identify.reset()
            return [*self.flush(), ended]
        skeleton = self._skeleton(raw)
        if skeleton is None:
            return []
        flushed: list[PoseClean] = []
        if self._last is not None:
            step = raw.stamp_ns - self._last.stamp_ns
            if -BACKWARDS_NS < step <= 0:
                self.counters["stamp_repeated" if step == 0 else "stamp_out_of_order"] += 1
                return []
            if step <= 0 or step > self.settings.timeout * 1e9:
                self.counters["stamp_jumped_back" if step <= 0 else "stream_gap"] += 1
                flushed = self.flush()
        if self._last is None:
            self._origin_ns = raw.stamp_ns
        self._last = raw
        positions, confidence = self._adapt(raw, skeleton)
        cleaned = []
        for stamp_ns, tick_positions, tick_confidence in self._resampler.update(raw.stamp_ns, positions, confidence):
            cleaned += self._step(stamp_ns, tick_positions, tick_confidence, raw)
        return flushed + cleaned

    def _skeleton(self, raw: PoseRaw) -> Skeleton | None:
        """The skeleton of a message, or None if the message cannot be used."""
        skeleton = SKELETONS.get(raw.skeleton)
        if skeleton is None:
            self.counters["unknown_skeleton"] += 1
            return None
        pose = raw.sensor_pose
        if not (np.isfinite(pose.position).all() and abs(np.linalg.norm(pose.orientation) - 1) < UNIT_TOLERANCE):
            self.counters["sensor_pose_invalid"] += 1
            return None
        return skeleton

    def flush(self) -> list[PoseClean]:
        """Give the frames that the delay still holds, and forget the stream."""
        last = self._last
        cleaned = []
        if last is not None:
            held = self._smooth.flush(self._window)
            for back, smoothed in zip(reversed(range(len(held))), held, strict=True):
                if self._denoise:
                    smoothed = self._denoise.denoised(self._window, smoothed, back)
                cleaned.append(self._message(self._fuse.estimate(self._window, smoothed, back), back, last))
        self._drop(np.ones(self.settings.max_bodies, dtype=bool))
        self._resampler.reset()
        self._last = None
        return cleaned

    def _adapt(self, raw: PoseRaw, skeleton: Skeleton) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Canonical joints of every slot, (S, 22, 3) metres with z up, and their confidence (S, 22)."""
        slots = self.settings.max_bodies
        positions = np.full((slots, 22, 3), np.nan)
        confidence = np.zeros((slots, 22))
        sightings: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        to_world, origin = _sensor(raw)
        for index, body in enumerate(raw.bodies):
            if len(body.positions) != len(skeleton.joints):
                self.counters["wrong_joint_count"] += 1
                continue
            body_id = index if self._identify else body.id
            if body_id in sightings:
                self.counters["body_id_repeated"] += 1
                continue
            joints, trust = self._sighting(body, skeleton)
            sightings[body_id] = joints @ to_world.T + origin, trust
        ids: list[int | None] = [*sightings]
        if self._identify:
            joints = np.array([joints for joints, _ in sightings.values()]).reshape(-1, 22, 3)
            trust = np.array([trust for _, trust in sightings.values()]).reshape(-1, 22)
            ids = self._identify.update(raw.stamp_ns, joints, trust)
        for body_id, (joints, trust) in zip(ids, sightings.values(), strict=True):
            if body_id is None:
                continue
            slot = self._slot(body_id, seen=int(np.isfinite(joints[:, 0]).sum()))
            if slot is not None:
                positions[slot], confidence[slot] = joints, trust
        return positions, confidence

    def _sighting(self, body: RawBody, skeleton: Skeleton) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A body's canonical joints in the sensor's frame; what is not finite or too far away is missing."""
        joints = body.positions.astype(np.float64)
        finite = finite_joints(joints)
        far = finite & (np.abs(np.where(finite[:, None], joints, 0.0)).max(axis=1) > MAX_DISTANCE)
        if far.any():
            self.counters["joints_too_far"] += int(far.sum())
            joints[far] = np.nan
        trust = np.nan_to_num(body.confidence.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
        return to_canonical(skeleton, joints, np.clip(trust, 0.0, 1.0))

    def _slot(self, body_id: int, seen: int) -> int | None:
        """The slot of a body, a free one if it is new and enough of it is seen."""
        if body_id in self._ids:
            return self._ids.index(body_id)
        if seen < MIN_JOINTS:
            self.counters["body_too_little_seen"] += 1
            return None
        if None not in self._ids:
            self.counters["too_many_bodies"] += 1
            return None
        slot = self._ids.index(None)
        self._ids[slot] = body_id
        self._unseen_ns[slot] = 0
        return slot

    def _step(
        self, stamp_ns: int, positions: NDArray[np.float64], confidence: NDArray[np.float64], raw: PoseRaw
    ) -> list[PoseClean]:
        """One step of the 30 Hz grid through all stages."""
        window = self._window
        taken = np.array([i is not None for i in self._ids])
        seen = np.asarray(finite_joints(positions).any(axis=1))
        window.present = window.present & taken | seen
        self._unseen_ns = np.where(seen, stamp_ns, np.where(self._unseen_ns == 0, stamp_ns, self._unseen_ns))
        gone = taken & (stamp_ns - self._unseen_ns > self.settings.timeout * 1e9)
        if gone.any():
            self._drop(gone)
        window.stamp_s.push((stamp_ns - self._origin_ns) * 1e-9)
        window.raw.push(positions)
        window.confidence.push(confidence)
        window.sensor_position = _sensor(raw)[1]
        for stage in self._stages:
            window = stage.update(window)
        return [] if window.out is None else [self._message(window.out, self.delay_frames, raw)]

    def _drop(self, slot: NDArray[np.bool_]) -> None:
        for stage in self._stages:
            stage.reset(slot)
        self._window.clear(slot)
        self._resampler.clear(slot)
        for k in np.flatnonzero(slot):
            self._ids[k] = None

    def _message(self, estimate: Estimate, back: int, raw: PoseRaw) -> PoseClean:
        """The estimate of the frame ``back`` before the newest, in the frame of the message that completed it."""
        window = self._window
        to_world, origin = _sensor(raw)
        bodies = []
        for slot, body_id in enumerate(self._ids):
            if body_id is None or not np.isfinite(estimate.positions[slot, 0, 0]):
                continue
            rotations = estimate.rotations[slot].copy()
            rotations[0] = to_world.T @ rotations[0]
            bodies.append(
                CleanBody(
                    id=body_id,
                    positions=(estimate.positions[slot] - origin) @ to_world,
                    rotations=Rotation.from_matrix(rotations, assume_valid=True).as_quat(),
                    state=estimate.state[slot],
                    sigma=estimate.sigma[slot],
                    anomaly=float(window.anomaly[slot]),
                    anomaly_flag=bool(window.anomaly_flag[slot]),
                    joint_anomaly=window.joint_anomaly[slot],
                    bone_lengths=np.sqrt((estimate.offsets[slot] ** 2).sum(axis=-1)),
                    raw_positions=(window.raw.all[-1 - back][slot] - origin) @ to_world,
                    raw_confidence=window.confidence.all[-1 - back][slot],
                )
            )
        return self._clean(self._origin_ns + round(estimate.stamp_s * 1e9), raw, bodies)

    def _clean(self, stamp_ns: int, raw: PoseRaw, bodies: list[CleanBody]) -> PoseClean:
        return PoseClean(
            stamp_ns=stamp_ns,
            frame_id=raw.frame_id,
            source=raw.source,
            sensor_pose=raw.sensor_pose,
            calibrated=raw.calibrated,
            delay_frames=self.delay_frames,
            bodies=bodies,
        )


@cache
def load_loops() -> None:
    """Have every stage's compiled loops loaded, or compiled: they are at their first call, and no frame should wait."""
    pipeline = PriorPipeline(PriorSettings(impute=ImputeSettings(steps=1)))
    pose = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    standing = place_joints(np.tile(np.eye(3), (22, 1, 1)), REST_OFFSETS).astype(np.float32)
    for frame in range(40):
        positions = standing + np.float32(0.001 * frame)
        if frame == 20:
            positions[J["left_wrist"]] += 0.5
        if frame > 30:
            positions[J["right_wrist"]] = np.nan
        body = RawBody(0, positions, np.ones(22, dtype=np.float32))
        pipeline.process(PoseRaw(round(frame * 1e9 / FPS), "", "", CANONICAL.name, pose, False, [body]))


@lru_cache(maxsize=8)
def _rotation(quaternion: bytes) -> NDArray[np.float64]:
    return Rotation.from_quat(np.frombuffer(quaternion)).as_matrix()


def _sensor(raw: PoseRaw) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and position (3,) of the sensor in the world."""
    return _rotation(raw.sensor_pose.orientation.tobytes()), raw.sensor_pose.position
