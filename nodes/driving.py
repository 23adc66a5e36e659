"""Runs both pipelines on recorded input as fast as possible; shared by the offline commands and the library."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_WORLD
from steadypose.msgs.types import Level, Message, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.checks.problem import Problem, error, observed
from steadypose.nodes.checks.stamps import check_back, check_length
from steadypose.nodes.checks.stream import StreamCheck
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sources.npz import ArraySource
from steadypose.nodes.sources.recording import with_end
from steadypose.nodes.sources.source import RecordedSource
from steadypose.nodes.timeline import EventTimeline
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.events.detector import NOWHERE, EventSettings
from steadypose.prior.settings import build_settings

if TYPE_CHECKING:
    from steadypose.prior.clean.pipeline import PriorPipeline
    from steadypose.prior.world.pipeline import TrajectoryPipeline

CHECKED, CHECKED_NS = 45, 1_500_000_000
"""Number of frames between checks of the input, and the time that they are assumed to take, nanoseconds."""
ENOUGH = 8  # number of joints of a body that are certainly enough for a pose
LYING = ("up_axis", "not_upright")  # causes of problems that somebody who lies or leans for a while also has
Settings = Mapping[str, Mapping[str, Any]]


def stream(
    messages: Iterable[tuple[str, Message]], prior: PriorPipeline, trajectory: TrajectoryPipeline
) -> Iterator[tuple[str, Message]]:
    """All messages that the nodes would publish for an input of ``messages``: the input, and the outputs after each.

    Both pipelines must be new, or have processed the end of their last stream.
    """
    for topic, message in with_end(messages):
        yield topic, message
        if isinstance(message, PoseRaw):
            for clean in prior.process(message):
                yield POSE_CLEAN, clean
                for world in trajectory.process(clean):
                    yield POSE_WORLD, world


class Diagnosis:
    """Checks an offline stream, whose frames are assumed to arrive at 30 Hz."""

    def __init__(self, settings: PriorSettings) -> None:
        self.problems: dict[str, Problem] = {}
        """by cause, as first detected"""
        self._check = StreamCheck(settings)
        self._delay_frames = settings.delay
        self._first_ns: int | None = None
        self._span_ns = self._back_ns = 0
        self._stamps_ns: deque[int] = deque(maxlen=4)
        self._useless = False
        self._inhabited = self._looks = self._lying = 0
        self.frames = 0

    def see(self, raw: PoseRaw) -> None:
        """Add the next frame without examining it yet."""
        self._check.see(raw, self.frames * CHECKED_NS // CHECKED)
        if self._first_ns is None:
            self._first_ns = raw.stamp_ns
            self._stamps_ns.extend([raw.stamp_ns] * 3)
        self._span_ns = max(self._span_ns, abs(raw.stamp_ns - self._first_ns))
        self._stamps_ns.append(raw.stamp_ns)
        before, last, back, after = self._stamps_ns
        if min(before, last) > max(back, after):  # a single wrong stamp is dropped, and the stream goes on
            self._back_ns = max(self._back_ns, last - back)
        self.frames += 1

    def look(self) -> list[str]:
        """Examine the last frames. Returns the new problems, one line each."""
        found = self._check.problems((self.frames - 1) * CHECKED_NS // CHECKED, live=False)
        self._looks += self._check.inhabited > self._inhabited
        self._inhabited = self._check.inhabited
        self._lying += any(problem.cause in LYING for problem in found)
        return self._note(found)

    def end(self) -> list[str]:
        """End the stream; another may follow. Returns as `look`, including whether it went back or was too short."""
        new = self.look()
        if "stamps_out_of_order" not in self.problems:
            new += self._note(check_back(self._back_ns))
        if self._first_ns is not None and not self.problems:
            new += self._note(check_length(self._span_ns, self._delay_frames))
        self._first_ns, self._span_ns, self._back_ns = None, 0, 0
        return new

    def check_output(self, frames: int, poses: int) -> list[str]:
        """Add, unless there is a reason already, that few or none of the 30 Hz ``frames`` with a body gave ``poses``.

        Returns as `look`.
        """
        if not self.trusted or 0 < poses >= frames / 2:
            return []
        if not self._check.inhabited:
            found = error("nobody", "no frame has a body: expected joints; does the tracker detect people?")
        elif not poses:
            expected = "expected one each; is the skeleton right, are the units metres?"
            found = error("nobody_recognised", f"no body in any frame gave a pose: {expected}")
        else:
            got = f"{poses} of {frames} frames with a body gave a pose"
            found = error("few_poses", f"{got}: expected nearly all; the others are counted by cause")
        return self._note([found])

    def _note(self, found: Iterable[Problem]) -> list[str]:
        new = []
        for problem in found:
            self._useless |= problem.level == Level.ERROR
            if self.problems.setdefault(problem.cause, problem) is problem:
                new.append(str(problem))
        return new

    @property
    def trusted(self) -> bool:
        """Whether the output can be trusted: no problem is an ERROR, and bodies do not lie or lean most of the time."""
        return not self._useless and 2 * self._lying <= self._looks

    @property
    def texts(self) -> list[str]:
        return list(map(str, self.problems.values()))


class OfflineRun:
    """Runs both pipelines on a recorded source, with ``[prior]``, ``[trajectory]`` and ``[events]`` of a launch file.
    It can be iterated once, and yields the messages of `stream`.

    If ``events``, ``timeline`` collects them; ``advanced`` is called after each frame of the input. ``diagnosis`` has
    the problems of the input, ``stamps_ns`` its stamps, ``poses`` counts the bodies in the output so far. Raises
    LaunchError if a setting is unknown or its value invalid and, at the end, if no frame could be read.
    """

    def __init__(
        self,
        source: RecordedSource,
        settings: Settings,
        *,
        events: bool = False,
        advanced: Callable[[], None] = lambda: None,
    ) -> None:
        # imported late, because these imports compile loops
        from steadypose.nodes.graph.prior_node import make_prior
        from steadypose.nodes.graph.threads import one_thread
        from steadypose.nodes.graph.trajectory_node import make_trajectory

        one_thread()
        self._source, self._events, self._advanced = source, events, advanced
        self.timeline = EventTimeline(build_settings(EventSettings, settings.get("events", {}), "events"))
        self._prior, self._trajectory = make_prior(settings["prior"]), make_trajectory(settings["trajectory"])
        self.stamps_ns: list[int] = []
        prior = PriorSettings.from_dict(settings["prior"])
        self.diagnosis = Diagnosis(prior)
        self._identifies = prior.identify.enabled
        self.poses = 0
        self._frames_with_body: set[int] = set()
        self._frames_with_pose = 0

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        sensor, calibrated = NOWHERE, False
        for topic, message in stream(self._source, self._prior, self._trajectory):
            if isinstance(message, PoseRaw) and not message.end_of_stream:
                self.stamps_ns.append(message.stamp_ns)
                self._advanced()
                self.diagnosis.see(message)
                if any(np.isfinite(observed(body)[:, 0]).sum() >= ENOUGH for body in message.bodies):
                    self._frames_with_body.add(round(message.stamp_ns / FRAME_NS))
                if self.diagnosis.frames % CHECKED == 0:
                    self.diagnosis.look()
            elif isinstance(message, PoseClean):
                self.poses += len(message.bodies)
                self._frames_with_pose += bool(message.bodies)
                sensor, calibrated = message.sensor_pose.position, message.calibrated
            elif self._events and topic == POSE_WORLD and isinstance(message, PoseWorld):
                self.timeline.add(message, sensor, calibrated=calibrated)
            yield topic, message
        if not self.stamps_ns:
            raise LaunchError(f"{self._source.path}: expected frames, but none of {len(self._source)} could be read")
        self.diagnosis.end()
        self.diagnosis.check_output(len(self._frames_with_body), self._frames_with_pose)

    @property
    def refused(self) -> Counter[str]:
        """Number of refused or dropped frames, bodies and joints, by cause."""
        counted = self._source.refused + self._prior.counters + self._trajectory.counters
        return Counter({cause: n for cause, n in counted.items() if n})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Process the whole source. Returns the arrays of `NpzCollector`, one row per input frame.

        They have the input's axis of bodies, unless the prior assigns ids itself.
        """
        bodies = self._source.bodies if isinstance(self._source, ArraySource) and not self._identifies else ()
        collector = NpzCollector(self, bodies)
        return collector.arrays(np.array(self.stamps_ns, np.int64))


def clean_joints(joints: Floats, delay: int = 8) -> Floats:
    """Output positions (T, 22, 3) of `steadypose clean` for joints (T, 22, 3) metres, z up, at 30 Hz; NaN without a
    body.
    """
    stamps = np.round(np.arange(len(joints)) * FRAME_NS).astype(np.int64)
    source = ArraySource(Path("joints"), {"positions": joints, "stamp_ns": stamps, "skeleton": np.array("smpl22")})
    return OfflineRun(source, {"prior": {"delay": delay}, "trajectory": {}}).arrays()["positions"].astype(float)
