"""Many streams through one prior, in batches: a frame of all of them goes through each stage together.

Bodies of several cameras share the stages' slots as bodies of one camera do; what differs is the clock. Each stream has
its own, and its frames come at times of their own. So each is put on one grid that all share, and a grid time is worked
on when every stream has come to it, or has had its time: who is later than that goes without for that frame, and holds
up nobody.

From a stream's clock to the server's: a message arrives after its capture by the difference of the clocks and what the
way takes, which is never less than the network's least. The smallest difference seen is kept, and let go of slowly, so
that it follows clocks that drift.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import CleanBody, Pose, PoseClean, PoseRaw
from steadypose.prior.clean.identify import Identify
from steadypose.prior.clean.pipeline import BACKWARDS_NS, PriorPipeline, PriorSettings
from steadypose.prior.timing.resample import PERIOD_NS, Resampler

PATIENCE_NS = 2 * PERIOD_NS
"""How long a frame waits for those of the other streams: a period, because they come at any time in it, and as much
again for the network."""
DRIFT = 200e-6
"""By how much two clocks may run apart: twice what two bad quartzes do."""
LATE_IN_A_ROW = 15
"""Frames of a stream, half a second; then its clock was set or its way has become longer, and it starts anew."""

Joints = tuple[NDArray[np.float64], NDArray[np.float64]]
"""(S, 22, 3) metres and the confidence (S, 22)"""


@dataclass
class _Stream:
    """What is kept of one stream; times are the server's.

    Attributes:
        resampler: to the shared grid; its slots are the batch's.
        identify: who tells its bodies apart, if it does not itself.
        offset_ns: from its clock to the server's.
        last: its newest message.
        time_ns: of that message's capture.
        heard_ns: when it came.
        first_ns, newest_ns: the first and the newest grid time that it has given joints for; none yet if negative.
        late: how many of its frames in a row came too late.
        ids: from its bodies' ids to the batch's.
    """

    resampler: Resampler
    identify: Identify | None
    offset_ns: float
    last: PoseRaw
    time_ns: int = -1
    heard_ns: int = -1
    first_ns: int = -1
    newest_ns: int = -1
    late: int = 0
    ids: dict[int, int] = field(default_factory=dict)


class StreamBatch(PriorPipeline):
    """The prior for many streams, told apart by ``source``.

    Args:
        settings: of the prior; ``max_bodies`` is of all streams together.
        streams: at most so many; further ones are refused.
    """

    def __init__(self, settings: PriorSettings, streams: int) -> None:
        super().__init__(settings)
        self._most = streams
        self._streams: dict[str, _Stream] = {}
        self._waiting: dict[int, list[Joints]] = {}
        self._done_ns: int | None = None
        self._next_id = 0

    @property
    def streams(self) -> int:
        """How many there are now."""
        return len(self._streams)

    def process_at(self, raw: PoseRaw, now_ns: int, *, hurry: bool = False) -> list[PoseClean]:
        """Take a message of any stream, and give the frames that are then complete, of all streams, oldest first.

        Args:
            raw: the message.
            now_ns: when it came, on the server's clock.
            hurry: as of `PriorPipeline.process`.
        """
        if self._impute:
            self._impute.hurry = hurry
        silence_ns = round(self.settings.timeout * 1e9)
        cleaned: list[PoseClean] = []
        if self._done_ns is not None and now_ns - self._done_ns > silence_ns + 2 * PATIENCE_NS:
            cleaned += self.flush()  # all were silent, and start anew
        for name, stream in list(self._streams.items()):
            if now_ns - stream.heard_ns > silence_ns and name != raw.source:
                self.counters["stream_silent"] += 1
                self._forget(name)
        stream = self._streams.get(raw.source)
        if raw.end_of_stream:
            if stream:
                stream.last, stream.heard_ns = raw, now_ns
        elif self._skeleton(raw) is not None:
            self._take(raw, now_ns)
        cleaned += self._advance(now_ns)
        if self._streams and all(stream.last.end_of_stream for stream in self._streams.values()):
            cleaned += self.flush()  # nobody is left for whose sake there will be another frame
        return cleaned

    def flush(self) -> list[PoseClean]:
        """Give the frames that the delay still holds, and forget all streams."""
        ids = {name: stream.ids for name, stream in self._streams.items()}
        held = super().flush()
        for name, stream in self._streams.items():
            stream.ids = ids[name]  # bodies are gone, and still in what was held
        cleaned = [part for joint in held for part in self._split(joint)]
        for name, stream in list(self._streams.items()):
            if stream.last.end_of_stream:
                cleaned.append(self._end(stream))
            self._forget(name)
        self._waiting.clear()
        self._done_ns = None
        return cleaned

    def _take(self, raw: PoseRaw, now_ns: int) -> None:
        """Put a stream's message on the grid."""
        stream = self._streams.get(raw.source)
        if stream and not -BACKWARDS_NS < raw.stamp_ns - stream.last.stamp_ns <= self.settings.timeout * 1e9:
            self.counters["stream_gap" if raw.stamp_ns > stream.last.stamp_ns else "stamp_jumped_back"] += 1
            self._forget(raw.source)
            stream = None
        elif stream and stream.late >= LATE_IN_A_ROW:
            self.counters["stream_late"] += 1
            self._forget(raw.source)
            stream = None
        if stream is None:
            if len(self._streams) >= self._most:
                self.counters["too_many_streams"] += 1
                return
            slots, identify = self.settings.max_bodies, self.settings.identify
            stream = self._streams[raw.source] = _Stream(
                resampler=Resampler(slots, aligned=True),
                identify=Identify(identify, 2 * slots, self.counters) if identify.enabled else None,
                offset_ns=now_ns - raw.stamp_ns,
                last=raw,
                heard_ns=now_ns,
            )
        stream.offset_ns = min(stream.offset_ns + DRIFT * (now_ns - stream.heard_ns), now_ns - raw.stamp_ns)
        stream.heard_ns = now_ns
        time_ns = raw.stamp_ns + round(stream.offset_ns)
        if time_ns <= stream.time_ns:
            # out of order; or the first messages came late, and the clock turns out to be another
            self.counters["stamp_out_of_order"] += 1
            stream.late += 1
            return
        stream.last, stream.time_ns = raw, time_ns
        self._current, self._identify = stream, stream.identify
        # levelled, but seen from where the sensor stands: the streams have no world in common
        levelled = Pose(np.zeros(3), raw.sensor_pose.orientation)
        skeleton = self._skeleton(raw)
        assert skeleton is not None, "checked before"
        joints = self._adapt(dataclasses.replace(raw, sensor_pose=levelled), skeleton)
        for tick_ns, *ready in stream.resampler.update(time_ns, *joints):
            if self._done_ns is not None and tick_ns <= self._done_ns:
                # the first frames of a stream, which nobody expected yet, are not late
                self.counters["late_for_batch"] += stream.first_ns >= 0
                stream.late += 1
                continue
            stream.late = 0
            stream.first_ns = tick_ns if stream.first_ns < 0 else stream.first_ns
            stream.newest_ns = tick_ns
            self._waiting.setdefault(tick_ns, []).append((ready[0], ready[1]))

    def _advance(self, now_ns: int) -> list[PoseClean]:
        """Work on the grid times for which nobody is waited for any more."""
        cleaned: list[PoseClean] = []
        while self._waiting:
            tick_ns = min(self._waiting) if self._done_ns is None else self._done_ns + PERIOD_NS
            awaited = any(s.newest_ns < tick_ns and not s.last.end_of_stream for s in self._streams.values())
            if awaited and now_ns - tick_ns <= PATIENCE_NS:
                break
            if self._done_ns is None:
                self._origin_ns = tick_ns
            self._done_ns = tick_ns
            self._last = PoseRaw(tick_ns, "", "", "smpl22", Pose.identity(), False, [])
            positions, confidence = self._merge(self._waiting.pop(tick_ns, []))
            for joint in self._step(tick_ns, positions, confidence, self._last):
                cleaned += self._split(joint)
        return cleaned

    def _merge(self, parts: list[Joints]) -> Joints:
        slots = self.settings.max_bodies
        positions, confidence = np.full((slots, 22, 3), np.nan), np.zeros((slots, 22))
        for seen, trust in parts:
            there = np.isfinite(seen[..., 0])
            positions[there], confidence[there] = seen[there], trust[there]
        return positions, confidence

    def _split(self, joint: PoseClean) -> list[PoseClean]:
        """The answer for all streams, as one message for each stream that was there."""
        bodies = {body.id: body for body in joint.bodies}
        cleaned = []
        for name, stream in list(self._streams.items()):
            # stamps were seconds on the way, and may be a nanosecond off the grid
            if not 0 <= stream.first_ns <= joint.stamp_ns + 1000:
                continue
            ended = stream.last.end_of_stream and stream.newest_ns < joint.stamp_ns - 1000
            if ended:
                cleaned.append(self._end(stream))
                self._forget(name)
                continue
            turn = Rotation.from_quat(stream.last.sensor_pose.orientation)
            parts = [_in_sensor(bodies[g], own, turn) for own, g in stream.ids.items() if g in bodies]
            cleaned.append(self._answer(stream, max(joint.stamp_ns - round(stream.offset_ns), 0), parts))
        return cleaned

    def _end(self, stream: _Stream) -> PoseClean:
        ended = self._answer(stream, stream.last.stamp_ns, [])
        ended.end_of_stream = True
        return ended

    def _answer(self, stream: _Stream, stamp_ns: int, bodies: list[CleanBody]) -> PoseClean:
        return self._clean(stamp_ns, stream.last, bodies)

    def _slot(self, body_id: int, seen: int) -> int | None:
        ids = self._current.ids
        known = ids.get(body_id, self._next_id)
        slot = super()._slot(known, seen)
        if slot is not None and known == self._next_id:
            ids[body_id] = known
            self._next_id += 1
        return slot

    def _drop(self, slot: NDArray[np.bool_]) -> None:
        gone = {self._ids[k] for k in np.flatnonzero(slot)}
        super()._drop(slot)
        for stream in self._streams.values():
            stream.resampler.clear(slot)
            stream.ids = {own: shared for own, shared in stream.ids.items() if shared not in gone}

    def _forget(self, name: str) -> None:
        mine = set(self._streams[name].ids.values())
        self._drop(np.array([shared in mine for shared in self._ids]))
        del self._streams[name]


def _in_sensor(body: CleanBody, own_id: int, turn: Rotation) -> CleanBody:
    """A body of the batch, levelled, in the frame of its own sensor, which is turned so, and with its own id."""
    to_world = turn.as_matrix()
    rotations = body.rotations.copy()
    rotations[0] = (turn.inv() * Rotation.from_quat(rotations[0])).as_quat()
    return dataclasses.replace(
        body,
        id=own_id,
        positions=body.positions @ to_world,
        rotations=rotations,
        raw_positions=body.raw_positions @ to_world,
    )
