"""The prior over one stream: from ``pose/raw`` messages to ``pose/clean`` messages."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cache
from typing import Generic

import numpy as np

from steadypose.msgs.types import Pose, PoseClean, PoseRaw, RawBody
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import SensorFrame
from steadypose.prior.body.layouts import CANONICAL, Skeleton
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.clean.adapt import (
    BodyJoints,
    RecentMessages,
    canonical_bodies,
    clean_bodies,
    clean_message,
    end_of_stream,
    layout_of,
    stacked,
)
from steadypose.prior.clean.admission import BACKWARDS_NS, SensorPoseGate, StampGate, Verdict
from steadypose.prior.clean.core import CleanCore
from steadypose.prior.clean.frame import CleanFrame, Observation, SensorNoise
from steadypose.prior.clean.identify import Identify
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.clean.slots import Key, Slots
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.resample import Frame, Resampler

CATCH_UP = 3
"""Largest number of grid frames that one message completes after messages were dropped. Processing all of them would
take as long as the dropped messages."""


class BodyPipeline(ABC, Generic[Key]):
    """Base of the prior over one stream and over many: the stages, and the slots that hold the bodies.

    Attributes:
        counters: numbers of messages, bodies and joints refused or dropped so far, by cause.
        delay_frames: frames at 30 Hz between a frame and its output.
        most_bodies: largest number of bodies that are processed, set by a node that lacks time; the nearest ones are
            kept.
    """

    def __init__(self, settings: PriorSettings) -> None:
        self.most_bodies = settings.max_bodies
        self.counters: Counter[str] = Counter()
        self.delay_frames = settings.delay
        self._settings = settings
        self._timeout_ns = round(settings.timeout * 1e9)
        self._core = CleanCore(settings, self.counters)
        self._slots: Slots[Key] = Slots(settings.max_bodies, settings.timeout, self.counters)
        self._layout_sigma = np.zeros((settings.max_bodies, 22))
        self._origin_ns = 0  # stages count seconds from here, because float seconds since 1970 would be rounded

    @property
    def bodies(self) -> int:
        """Number of bodies that are processed."""
        return self._slots.taken

    @property
    def offered(self) -> int:
        """Number of bodies that are processed or left out for lack of time."""
        return self._slots.taken + self._slots.left_out

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """The latest estimate of the sensor's error: the median over bodies. None before the first body."""
        return self._core.sensor_noise

    @abstractmethod
    def _resamplers(self) -> Iterable[Resampler]:
        """The resamplers of all open streams."""

    def _new_identify(self) -> Identify | None:
        """A tracker that assigns ids, if the settings ask for one."""
        settings = self._settings.identify
        return Identify(settings, 2 * self._settings.max_bodies, self.counters) if settings.enabled else None

    def _arranged(
        self, raw: PoseRaw, layout: Skeleton, sensor: SensorFrame, identify: Identify | None, key: Callable[[int], Key]
    ) -> BodyJoints:
        """Return a message's bodies by slot, in the world. ``key`` converts a body id to the key of a slot."""
        bodies = canonical_bodies(raw, layout, sensor, self.counters, numbered=identify is not None)
        ids = identify.update(raw.stamp_ns, *stacked(bodies.values())) if identify else bodies
        keys = [None if body_id is None else key(body_id) for body_id in ids]
        keyed = list(zip(keys, bodies.values(), strict=True))
        if (out := self._slots.crowded_out(self.most_bodies, keyed, sensor.origin)).any():
            self._drop(out)
        if (out := self._slots.making_way(keyed)).any():
            self._drop(out)
        joints = self._slots.arrange(keyed)
        self._layout_sigma[np.isfinite(joints.positions).any(axis=(1, 2))] = layout.sigma
        return joints

    def _advance_to(self, stamp_ns: int, joints: BodyJoints, sensor_position: Floats) -> CleanFrame | None:
        """Process one step of the 30 Hz grid."""
        timed_out = self._slots.advance(stamp_ns, joints.positions)
        if timed_out.any():
            self._drop(timed_out)
        return self._core.step(
            Observation(
                stamp_s=(stamp_ns - self._origin_ns) * 1e-9,
                positions=joints.positions,
                confidence=joints.confidence,
                present=self._slots.present,
                sensor_position=sensor_position,
                layout_sigma=self._layout_sigma.copy(),
            )
        )

    def _drop(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._core.forget(slot)
        self._slots.free(slot)
        for resampler in self._resamplers():
            resampler.clear(slot)


class PriorPipeline(BodyPipeline[int]):
    """The prior over one stream. The same messages give the same output, bit for bit."""

    def __init__(self, settings: PriorSettings) -> None:
        super().__init__(settings)
        self._identify = self._new_identify()
        self._resampler = Resampler(settings.max_bodies, delayed=settings.delay > 0)
        self._stamps = StampGate(self._timeout_ns, self.counters)
        self._sensor_pose = SensorPoseGate()
        self._recent = RecentMessages()

    def process(self, raw: PoseRaw, *, gap: bool = False) -> list[PoseClean]:
        """Process a ``pose/raw`` message and return the ``pose/clean`` messages that it completes, oldest first.

        A message that cannot be used is counted in `counters` and otherwise ignored. A message whose stamp jumps waits
        until the next messages show whether the jump lasts.

        Args:
            raw: the message.
            gap: whether the node dropped messages before this one, so that a gap in the stamps starts no new stream.
        """
        return [clean for admitted, _ in self._stamps.admit(raw, gap=gap) for clean in self._process(admitted, gap=gap)]

    def _process(self, raw: PoseRaw, *, gap: bool) -> list[PoseClean]:
        if raw.end_of_stream:
            if self._identify:
                self._identify.reset()
            return [*self._flush(), end_of_stream(raw, self.delay_frames)]
        layout = layout_of(raw, self.counters)
        if layout is None:
            return []
        flushed: list[PoseClean] = []
        if self._recent:
            step = raw.stamp_ns - self._recent[-1].stamp_ns
            if -BACKWARDS_NS < step <= 0:
                self.counters["stamp_repeated" if step == 0 else "stamp_out_of_order"] += 1
                return []
            if gap and step > self._timeout_ns:
                self._slots.excuse(raw.stamp_ns)
            elif step <= 0 or step > self._timeout_ns:
                self.counters["stamp_jumped_back" if step <= 0 else "stream_gap"] += 1
                flushed = self._flush()
        verdict = self._sensor_pose.judge(raw.sensor_pose, raw.stamp_ns)
        if verdict is Verdict.SUSPECT:
            self.counters["sensor_pose_jumped"] += 1
            return flushed
        if verdict is Verdict.MOVED:
            self.counters["sensor_moved"] += 1
            flushed += self._flush()
            self._sensor_pose.judge(raw.sensor_pose, raw.stamp_ns)
        if not self._recent:
            self._origin_ns = raw.stamp_ns
        self._recent.append(raw)
        joints = self._arranged(raw, layout, SensorFrame.of(raw.sensor_pose), self._identify, int)
        ticks = self._resampler.update(raw.stamp_ns, *joints)
        if gap and len(ticks) > CATCH_UP:
            self.counters["frames_skipped"] += len(ticks) - CATCH_UP
            ticks = ticks[-CATCH_UP:]
        return flushed + self._stepped(ticks)

    def flush(self) -> list[PoseClean]:
        """Return the frames that the delay still holds, oldest first, and forget the stream."""
        held = [clean for raw, _ in self._stamps.release() for clean in self._process(raw, gap=False)]
        return held + self._flush()

    def _flush(self) -> list[PoseClean]:
        cleaned: list[PoseClean] = []
        if self._recent:
            cleaned += self._stepped(self._resampler.drain())
            cleaned += [self._message(frame) for frame in self._core.flush()]
        self._drop(np.ones_like(self._slots.present))
        self._resampler.reset()
        self._sensor_pose.reset()
        self._recent.clear()
        return cleaned

    def _stepped(self, ticks: list[Frame]) -> list[PoseClean]:
        """Process frames of the 30 Hz grid and return the messages that they complete."""
        origin = SensorFrame.of(self._recent[-1].sensor_pose).origin
        frames = (self._advance_to(stamp_ns, BodyJoints(*joints), origin) for stamp_ns, *joints in ticks)
        return [self._message(frame) for frame in frames if frame is not None]

    def _resamplers(self) -> Iterable[Resampler]:
        return (self._resampler,)

    def _message(self, frame: CleanFrame) -> PoseClean:
        """Build the output message, in the sensor's frame at the time of the frame."""
        stamp_ns = self._origin_ns + round(frame.estimate.stamp_s * 1e9)
        raw = self._recent.at(stamp_ns)
        ids = {slot: key for slot, key in enumerate(self._slots.keys) if key is not None}
        bodies = clean_bodies(frame, SensorFrame.of(raw.sensor_pose), ids)
        self._core.note_published(frame, bodies)
        return clean_message(raw, stamp_ns, self.delay_frames, list(bodies.values()))


@cache
def load_loops(settings: PriorSettings) -> None:
    """Load or compile the loops of every stage in use. Numba does so at a first call, and no frame should wait."""
    pipeline = PriorPipeline(settings)
    pose = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    for frame in range(settings.delay + 5):
        positions = (REST_POSITIONS + 0.001 * frame).astype(np.float32)
        if frame == 2:
            positions[J["left_wrist"]] += 0.5
        if frame > 2:
            positions[J["right_wrist"]] = np.nan
        bodies = [RawBody(0, positions, np.ones(22, dtype=np.float32))]
        if frame > 3:  # arrays of two bodies have another memory layout, for which numba compiles another loop
            bodies.append(RawBody(1, positions + np.float32(1.0), np.ones(22, dtype=np.float32)))
        pipeline.process(PoseRaw(round(frame * 1e9 / FPS), "", "", CANONICAL.name, pose, False, bodies))
