"""Runs the prior over many streams in batches: each stage processes a frame of all streams together.

Bodies of several cameras share the stages' slots like bodies of one camera. Only the clocks differ: each stream is
stamped by its own. All streams are therefore resampled to one shared grid, whose times are those of the first stream. A
grid time is processed when every stream has reached it, or after `PATIENCE_NS`. A stream that is later misses that
frame and delays no other stream. If it often is, because the time between its messages is longer than the server waits,
it starts anew on later grid times, by its slack.

The offset from a stream's clock to the server's is the minimum of arrival time minus capture stamp: the clock
difference plus the least network latency. The minimum decays slowly (`DRIFT`), so that it follows clocks that drift.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from steadypose.msgs.types import PoseClean, PoseRaw
from steadypose.prior.body.kinematics import SensorFrame
from steadypose.prior.body.layouts import Skeleton
from steadypose.prior.clean.adapt import (
    BodyJoints,
    RecentMessages,
    clean_bodies,
    clean_message,
    end_of_stream,
    layout_of,
)
from steadypose.prior.clean.admission import BACKWARDS_NS, SLOWEST_NS, SensorPoseGate, StampGate, Verdict
from steadypose.prior.clean.frame import CleanFrame
from steadypose.prior.clean.identify import Identify
from steadypose.prior.clean.pipeline import CATCH_UP, BodyPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.timing.resample import PERIOD_NS, Resampler

PATIENCE_NS = 2 * PERIOD_NS
"""Longest time that a frame waits for the other streams, nanoseconds: one period for their different phases, and one
for the network."""
DRIFT = 200e-6  # largest relative drift between two clocks, twice that of two poor quartz oscillators
LATE_IN_A_ROW = 15
"""Number of late frames in a row after which a stream starts anew (half a second). Its clock was set or its latency
grew."""
OFTEN_LATE = 15
"""Number of late frames, each forgotten after `FORGOTTEN` timely ones, after which a stream gets more slack."""
FORGOTTEN = 10
MAX_SLACK_NS = 8 * PERIOD_NS
"""Largest slack, nanoseconds; enough for 4 Hz."""


@dataclass
class _Stream:
    """State of one stream. Times are on the server's clock."""

    resampler: Resampler  # to the shared grid; its slots are those of the batch
    identify: Identify | None  # None if the source assigns ids to its bodies
    offset_ns: float  # from its clock to the server's
    recent: RecentMessages
    sensor_pose: SensorPoseGate
    time_ns: int = -1  # capture time of the newest message
    heard_ns: int = -1  # arrival time of the newest message
    first_ns: int = -1  # first and newest grid time with joints of this stream; negative before the first
    newest_ns: int = -1
    late: int = 0  # number of its frames in a row that came too late
    slack_ns: int = 0  # added to its times
    often_late: float = 0.0  # number of late frames after long intervals, see `OFTEN_LATE`, and the longest of these
    interval_ns: int = 0

    @property
    def shift_ns(self) -> int:
        """From its clock to the times of the grid."""
        return round(self.offset_ns) + self.slack_ns

    @property
    def wanted_slack_ns(self) -> int:
        """The slack with which its late frames would have been in time."""
        return min(self.interval_ns - PATIENCE_NS + PERIOD_NS, MAX_SLACK_NS)

    @property
    def needs_slack(self) -> bool:
        """Whether frames are often late that more slack would bring in time."""
        return self.often_late >= OFTEN_LATE and self.wanted_slack_ns > self.slack_ns

    @property
    def last(self) -> PoseRaw:
        """Its newest message."""
        return self.recent[-1]


class StreamBatch(BodyPipeline[tuple[str, int]]):
    """The prior for many streams, at most ``max_streams``, which are distinguished by their messages' ``source``.
    ``settings.max_bodies`` limits all of them together."""

    def __init__(self, settings: PriorSettings, max_streams: int) -> None:
        super().__init__(settings)
        self._max_streams = max_streams
        self._streams: dict[str, _Stream] = {}
        self._stamps: dict[str, StampGate] = {}
        self._waiting: dict[int, list[BodyJoints]] = {}
        self._grid_ns: int | None = None  # a time of the shared grid
        self._done_ns: int | None = None

    @property
    def streams(self) -> int:
        """Number of open streams."""
        return len(self._streams)

    def process_at(self, raw: PoseRaw, now_ns: int, *, hurry: bool = False, gap: bool = False) -> list[PoseClean]:
        """Process a message of any stream and return the frames of all streams that are now complete, oldest first.

        Args:
            raw: the message.
            now_ns: its arrival time, on the server's clock.
            hurry: whether the node falls behind and should skip grid times that are late.
            gap: as in `PriorPipeline.process`.
        """
        stamps = self._stamps.pop(raw.source, None) or StampGate(self._timeout_ns, self.counters)
        self._stamps[raw.source] = stamps
        if len(self._stamps) > 2 * self._max_streams:
            del self._stamps[next(iter(self._stamps))]
        admitted = stamps.admit(raw, now_ns, gap=gap)
        if not admitted:
            self.heard(raw.source, now_ns)
        cleaned = [clean for held, at in admitted for clean in self._process(held, at, hurry=hurry, gap=gap)]
        return cleaned if admitted else self._advance(now_ns, hurry)

    def heard(self, source: str, now_ns: int) -> None:
        """Note that a stream continues, although the node dropped its message."""
        if stream := self._streams.get(source):
            stream.heard_ns = now_ns

    def _process(self, raw: PoseRaw, now_ns: int, *, hurry: bool, gap: bool) -> list[PoseClean]:
        cleaned: list[PoseClean] = []
        if not gap and self._done_ns is not None and now_ns - self._done_ns > self._timeout_ns + 2 * PATIENCE_NS:
            cleaned += self.flush()  # all streams were silent and start anew
        for name, stream in list(self._streams.items()):
            if not gap and now_ns - stream.heard_ns > self._timeout_ns and name != raw.source:
                self.counters["stream_silent"] += 1
                self._forget(name)
        stream = self._streams.get(raw.source)
        if raw.end_of_stream:
            if stream:
                # only the sensor's pose of the last message is used, and the pose of this one was not checked
                stream.recent.append(dataclasses.replace(raw, sensor_pose=stream.last.sensor_pose))
                stream.heard_ns = now_ns
        else:
            layout = layout_of(raw, self.counters)
            if layout is not None and self._is_pose_accepted(raw):
                self._take(raw, layout, now_ns, gap=gap, hurry=hurry)
        cleaned += self._advance(now_ns, hurry)
        if self._streams and all(stream.last.end_of_stream for stream in self._streams.values()):
            cleaned += self.flush()  # all streams have ended, so no further frame will arrive
        return cleaned

    def flush(self) -> list[PoseClean]:
        """Return the frames that the delay still holds, oldest first, and forget all streams."""
        cleaned = [part for frame in self._core.flush() for part in self._split(frame)]
        for name, stream in list(self._streams.items()):
            if stream.last.end_of_stream:
                cleaned.append(self._end(stream))
            self._forget(name)
        self._drop(np.ones_like(self._slots.present))
        self._waiting.clear()
        self._grid_ns = self._done_ns = None
        return cleaned

    def _is_pose_accepted(self, raw: PoseRaw) -> bool:
        """Whether the message's sensor pose is accepted. A stream whose sensor was moved starts anew."""
        stream = self._streams.get(raw.source)
        if stream is None or raw.stamp_ns <= stream.last.stamp_ns:
            return True
        verdict = stream.sensor_pose.judge(raw.sensor_pose, raw.stamp_ns)
        if verdict is Verdict.SUSPECT:
            self.counters["sensor_pose_jumped"] += 1
        elif verdict is Verdict.MOVED:
            self.counters["sensor_moved"] += 1
            self._forget(raw.source)
        return verdict is not Verdict.SUSPECT

    def _take(self, raw: PoseRaw, layout: Skeleton, now_ns: int, *, gap: bool, hurry: bool) -> None:
        """Put a stream's message on the grid."""
        stream = self._streams.get(raw.source)
        longest_ns = SLOWEST_NS if gap else self._timeout_ns
        slack_ns = 0
        if stream and not -BACKWARDS_NS < raw.stamp_ns - stream.last.stamp_ns <= longest_ns:
            self.counters["stream_gap" if raw.stamp_ns > stream.last.stamp_ns else "stamp_jumped_back"] += 1
            self._forget(raw.source)
            stream = None
        elif stream and (stream.late >= LATE_IN_A_ROW or stream.needs_slack):
            self.counters["stream_late"] += 1
            slack_ns = stream.wanted_slack_ns if stream.needs_slack else stream.slack_ns
            self._forget(raw.source)
            stream = None
        if stream is None:
            if len(self._streams) >= self._max_streams:
                self.counters["too_many_streams"] += 1
                return
            if self._grid_ns is None:
                self._grid_ns = now_ns
            stream = self._streams[raw.source] = _Stream(
                resampler=Resampler(self._settings.max_bodies, grid_ns=self._grid_ns, delayed=self._settings.delay > 0),
                identify=self._new_identify(),
                offset_ns=now_ns - raw.stamp_ns,
                recent=RecentMessages(),
                sensor_pose=SensorPoseGate(),
                heard_ns=now_ns,
                slack_ns=slack_ns,
            )
        stream.offset_ns = min(stream.offset_ns + DRIFT * (now_ns - stream.heard_ns), now_ns - raw.stamp_ns)
        stream.heard_ns = now_ns
        time_ns = raw.stamp_ns + stream.shift_ns
        if time_ns <= stream.time_ns:
            # out of order, or the clock's offset was overestimated because the first messages came late
            self.counters["stamp_out_of_order"] += 1
            stream.late += 1
            return
        # neither a server that falls behind nor messages that it dropped make a client slow
        interval_ns = 0 if gap or hurry or stream.time_ns < 0 else time_ns - stream.time_ns
        stream.recent.append(raw)
        stream.time_ns = time_ns
        # levelled, with the sensor at the origin, because the streams share no world frame
        sensor = SensorFrame.of(raw.sensor_pose).levelled()
        joints = self._arranged(raw, layout, sensor, stream.identify, lambda body_id: (raw.source, body_id))
        for tick_ns, *ready in stream.resampler.update(time_ns, *joints):
            if self._done_ns is not None and tick_ns <= self._done_ns:
                # the first frames of a new stream do not count as late
                self.counters["late_for_batch"] += stream.first_ns >= 0
                stream.late += 1
                if interval_ns > PATIENCE_NS:
                    stream.often_late += 1.0
                    stream.interval_ns = max(stream.interval_ns, interval_ns)
                continue
            stream.late = 0
            stream.often_late = max(stream.often_late - 1 / FORGOTTEN, 0.0)
            stream.first_ns = tick_ns if stream.first_ns < 0 else stream.first_ns
            stream.newest_ns = tick_ns
            self._waiting.setdefault(tick_ns, []).append(BodyJoints(*ready))

    def _advance(self, now_ns: int, hurry: bool) -> list[PoseClean]:
        """Process the grid times that need not wait for any stream."""
        cleaned: list[PoseClean] = []
        if hurry:
            self._catch_up(now_ns)
        while self._waiting:
            tick_ns = min(self._waiting) if self._done_ns is None else self._done_ns + PERIOD_NS
            awaited = any(s.newest_ns < tick_ns and not s.last.end_of_stream for s in self._streams.values())
            if awaited and now_ns - tick_ns <= PATIENCE_NS:
                break
            if self._done_ns is None:
                self._origin_ns = tick_ns
            self._done_ns = tick_ns
            frame = self._advance_to(tick_ns, self._merged(self._waiting.pop(tick_ns, [])), np.zeros(3))
            if frame is not None:
                cleaned += self._split(frame)
        return cleaned

    def _catch_up(self, now_ns: int) -> None:
        """Skip grid times that are so late that processing them would delay all later ones."""
        if self._done_ns is None:
            return
        late = (now_ns - PATIENCE_NS - self._done_ns) // PERIOD_NS - CATCH_UP
        if late <= 0 or not self._waiting:
            return
        for _ in range(late):
            self._done_ns += PERIOD_NS
            self._waiting.pop(self._done_ns, None)
        self.counters["frames_skipped"] += int(late)
        self._slots.excuse(self._done_ns)

    def _merged(self, parts: list[BodyJoints]) -> BodyJoints:
        slots = self._settings.max_bodies
        merged = BodyJoints(np.full((slots, 22, 3), np.nan), np.zeros((slots, 22)))
        for part in parts:
            there = np.isfinite(part.positions[..., 0])
            merged.positions[there], merged.confidence[there] = part.positions[there], part.confidence[there]
        return merged

    def _split(self, frame: CleanFrame) -> list[PoseClean]:
        """Split a frame of all streams into one message for each stream that was present."""
        stamp_ns = self._origin_ns + round(frame.estimate.stamp_s * 1e9)
        cleaned = []
        published: set[int] = set()
        for name, stream in list(self._streams.items()):
            # stamps were converted to seconds and back, and may be a nanosecond off the grid
            if not 0 <= stream.first_ns <= stamp_ns + 1000:
                continue
            if stream.last.end_of_stream and stream.newest_ns < stamp_ns - 1000:
                cleaned.append(self._end(stream))
                self._forget(name)
                continue
            ids = {slot: key[1] for slot, key in enumerate(self._slots.keys) if key is not None and key[0] == name}
            own_ns = max(stamp_ns - stream.shift_ns, 0)
            raw = stream.recent.at(own_ns)
            bodies = clean_bodies(frame, SensorFrame.of(raw.sensor_pose).levelled(), ids)
            published |= bodies.keys()
            cleaned.append(clean_message(raw, own_ns, self.delay_frames, list(bodies.values())))
        self._core.note_published(frame, published)
        return cleaned

    def _end(self, stream: _Stream) -> PoseClean:
        """A stream's last message, not before its last frame: the grid's may lie after the last that was captured."""
        own_ns = stream.newest_ns - stream.shift_ns
        last = dataclasses.replace(stream.last, stamp_ns=max(stream.last.stamp_ns, own_ns))
        return end_of_stream(last, self.delay_frames)

    def _forget(self, name: str) -> None:
        """Forget a stream."""
        self._drop(np.array([key is not None and key[0] == name for key in self._slots.keys]))
        del self._streams[name]

    def _resamplers(self) -> Iterable[Resampler]:
        return (stream.resampler for stream in self._streams.values())
