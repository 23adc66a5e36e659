"""The prior over one stream: from ``pose/raw`` messages to ``pose/clean`` messages."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np

from steadypose.msgs.types import Pose, PoseClean, PoseRaw, RawBody
from steadypose.prior.arrays import Bools
from steadypose.prior.body.layouts import CANONICAL, Skeleton
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.clean.adapt import (
    SensorFrame,
    Sighting,
    clean_bodies,
    clean_message,
    end_of_stream,
    layout_of,
    sightings,
    stacked,
)
from steadypose.prior.clean.core import CleanCore
from steadypose.prior.clean.frame import CleanFrame, Observation, SensorNoise
from steadypose.prior.clean.identify import Identify
from steadypose.prior.clean.sensor_pose import SensorPoseGate, Verdict
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.clean.slots import Slots
from steadypose.prior.clean.stamp_gate import StampGate
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.resample import Resampler

BACKWARDS_NS = 1_000_000_000
"""A stamp this far before the last starts a new stream; one nearer is a frame out of order."""
CATCH_UP = 3
"""Grid frames that one message completes at most where messages before it were dropped: all of them would take as long
as the messages themselves."""


class PriorPipeline:
    """The prior over one stream. The same messages give the same answers, bit for bit.

    Attributes:
        counters: messages, bodies and joints refused or dropped so far, by cause.
        delay_frames: frames at 30 Hz between a frame and its answer.
        most_bodies: that are worked on, if a node has no time for all; the nearest to the sensor.
    """

    def __init__(self, settings: PriorSettings) -> None:
        self.most_bodies = settings.max_bodies
        self.counters: Counter[str] = Counter()
        self.delay_frames = settings.delay
        self._timeout_ns = settings.timeout * 1e9
        slots = settings.max_bodies
        self._core = CleanCore(settings, self.counters)
        self._identify = Identify(settings.identify, 2 * slots, self.counters) if settings.identify.enabled else None
        self._slots: Slots[int] = Slots(slots, settings.timeout, self.counters)
        self._resampler = Resampler(slots, delayed=settings.delay > 0)
        self._stamps = StampGate(self._timeout_ns, BACKWARDS_NS, self.counters)
        self._sensor_pose = SensorPoseGate()
        self._last: PoseRaw | None = None
        self._origin_ns = 0  # stamps within are seconds since: a float of seconds since 1970 would round them

    def process(self, raw: PoseRaw, *, hurry: bool = False, gap: bool = False) -> list[PoseClean]:
        """Take a ``pose/raw`` message and give the ``pose/clean`` messages it completes, oldest first.

        A message that cannot be used is counted in `counters` and otherwise ignored; one whose stamp jumps waits until
        it is seen whether that lasts.

        Args:
            raw: the message.
            hurry: hidden joints are imputed without gradient ascent: for a live node that falls behind. A replay is
                never in a hurry.
            gap: messages before this one were dropped by the node, so that a gap in the stamps is no new stream.
        """
        return [
            clean
            for admitted, _ in self._stamps.admit(raw, gap=gap)
            for clean in self._process(admitted, hurry=hurry, gap=gap)
        ]

    def _process(self, raw: PoseRaw, *, hurry: bool, gap: bool) -> list[PoseClean]:
        if raw.end_of_stream:
            if self._identify:
                self._identify.reset()
            return [*self._flush(), end_of_stream(raw, self.delay_frames)]
        layout = layout_of(raw, self.counters)
        if layout is None:
            return []
        flushed: list[PoseClean] = []
        if self._last is not None:
            step = raw.stamp_ns - self._last.stamp_ns
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
        if self._last is None:
            self._origin_ns = raw.stamp_ns
        self._last = raw
        ticks = self._resampler.update(raw.stamp_ns, *self._arranged(raw, layout))
        if gap and len(ticks) > CATCH_UP:
            self.counters["frames_skipped"] += len(ticks) - CATCH_UP
            ticks = ticks[-CATCH_UP:]
        cleaned = [self._step(stamp_ns, Sighting(*joints), raw, hurry=hurry) for stamp_ns, *joints in ticks]
        return flushed + [message for message in cleaned if message is not None]

    @property
    def bodies(self) -> int:
        """That are worked on."""
        return self._slots.taken

    @property
    def offered(self) -> int:
        """Bodies that are worked on, and those that would be if there were time."""
        return self._slots.taken + self._slots.left_out

    @property
    def sensor_noise(self) -> SensorNoise | None:
        """The latest estimate of the sensor's error, the median over bodies; None before the first body."""
        return self._core.sensor_noise

    def flush(self) -> list[PoseClean]:
        """The frames that the delay still holds, oldest first; the stream is then forgotten."""
        held = [clean for raw, _ in self._stamps.release() for clean in self._process(raw, hurry=False, gap=False)]
        return held + self._flush()

    def _flush(self) -> list[PoseClean]:
        last = self._last
        cleaned: list[PoseClean] = []
        if last is not None:
            for stamp_ns, *joints in self._resampler.drain():
                message = self._step(stamp_ns, Sighting(*joints), last, hurry=False)
                cleaned += [] if message is None else [message]
            cleaned += [self._message(frame, last) for frame in self._core.flush()]
        self._drop(np.ones_like(self._slots.present))
        self._resampler.reset()
        self._sensor_pose.reset()
        self._last = None
        return cleaned

    def _arranged(self, raw: PoseRaw, layout: Skeleton) -> Sighting:
        """A message's bodies, by slot."""
        sensor = SensorFrame.of(raw.sensor_pose)
        found = sightings(raw, layout, sensor, self.counters, numbered=self._identify is not None)
        keys = self._identify.update(raw.stamp_ns, *stacked(found.values())) if self._identify else found
        named = list(zip(keys, found.values(), strict=True))
        if (out := self._slots.crowded_out(self.most_bodies, named, sensor.origin)).any():
            self._drop(out)
        return self._slots.arrange(named)

    def _step(self, stamp_ns: int, seen: Sighting, raw: PoseRaw, *, hurry: bool) -> PoseClean | None:
        """One step of the 30 Hz grid."""
        gone = self._slots.advance(stamp_ns, seen.positions)
        if gone.any():
            self._drop(gone)
        observation = Observation(
            stamp_s=(stamp_ns - self._origin_ns) * 1e-9,
            positions=seen.positions,
            confidence=seen.confidence,
            present=self._slots.present,
            sensor_position=SensorFrame.of(raw.sensor_pose).origin,
        )
        frame = self._core.step(observation, hurry=hurry)
        return None if frame is None else self._message(frame, raw)

    def _drop(self, slot: Bools) -> None:
        self._core.forget(slot)
        self._resampler.clear(slot)
        self._slots.free(slot)

    def _message(self, frame: CleanFrame, raw: PoseRaw) -> PoseClean:
        """The answer, in the frame of the message that completed it."""
        ids = {slot: key for slot, key in enumerate(self._slots.keys) if key is not None}
        bodies = clean_bodies(frame, SensorFrame.of(raw.sensor_pose), ids)
        self._core.note_answered(frame, bodies)
        stamp_ns = self._origin_ns + round(frame.estimate.stamp_s * 1e9)
        return clean_message(raw, stamp_ns, self.delay_frames, list(bodies.values()))


@cache
def load_loops(settings: PriorSettings) -> None:
    """Have the compiled loops of every stage in use loaded, or compiled: they are at their first call, and no frame
    should wait."""
    pipeline = PriorPipeline(settings)
    pose = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    for frame in range(settings.delay + 5):
        positions = (REST_POSITIONS + 0.001 * frame).astype(np.float32)
        if frame == 2:
            positions[J["left_wrist"]] += 0.5
        if frame > 2:
            positions[J["right_wrist"]] = np.nan
        bodies = [RawBody(0, positions, np.ones(22, dtype=np.float32))]
        if frame > 3:  # arrays of two bodies lie otherwise in memory, which is another loop
            bodies.append(RawBody(1, positions + np.float32(1.0), np.ones(22, dtype=np.float32)))
        pipeline.process(PoseRaw(round(frame * 1e9 / FPS), "", "", CANONICAL.name, pose, False, bodies))
