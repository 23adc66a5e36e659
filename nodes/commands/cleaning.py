"""How one recording is cleaned offline: the nodes' own pipelines over it, as fast as they go."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import POSE_CLEAN, POSE_WORLD
from steadypose.msgs.types import Message, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.checks.stream import StreamCheck
from steadypose.nodes.commands.output import check_replaceable, put_in_place, unfinished
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.npz import NpzCollector
from steadypose.nodes.sinks.recorder import LogTimes
from steadypose.nodes.sources.recording import open_recording, with_end
from steadypose.prior.body.own_layouts import add_layouts

CHECKED, CHECKED_NS = 45, 1_500_000_000
"""frames between two looks at whether the input can be right, and the time in which they count as having come"""


class Cleaner(Protocol):
    """What `stream` needs of a `PriorPipeline`."""

    def process(self, raw: PoseRaw) -> list[PoseClean]: ...


class Placer(Protocol):
    """What `stream` needs of a `TrajectoryPipeline`."""

    def process(self, clean: PoseClean) -> list[PoseWorld]: ...


def stream(
    messages: Iterable[tuple[str, Message]], prior: Cleaner, trajectory: Placer
) -> Iterator[tuple[str, Message]]:
    """All that the nodes publish when the input node publishes ``messages``: these, and the answers to each.

    Both pipelines are new, or have seen the end of their last stream.
    """
    for topic, message in with_end(messages):
        yield topic, message
        if isinstance(message, PoseRaw):
            for clean in prior.process(message):
                yield POSE_CLEAN, clean
                for world in trajectory.process(clean):
                    yield POSE_WORLD, world


@dataclass(frozen=True)
class Cleaned:
    """Summary of the cleaning of one recording.

    Attributes:
        frames: of the input.
        duration_s: from its first stamp to its last.
        spent_s: computing time.
        poses: number of poses in the output; 0 if no body was recognised.
        refused: what was refused or dropped, by cause.
        problems: what is wrong with the input, each as it was first found.
        unread: what of it the input holds and could not be read, because it is damaged.
    """

    frames: int
    duration_s: float
    spent_s: float
    poses: int
    refused: dict[str, int]
    problems: list[str]
    unread: dict[str, int]


def clean_recording(
    source: Path,
    out: Path,
    settings: Mapping[str, Mapping[str, Any]],
    *,
    replace: bool = False,
    began: Callable[[int], None] = lambda frames: None,
    advanced: Callable[[], None] = lambda: None,
) -> Cleaned:
    """Clean one recording. The output is there whole, or not at all.

    Args:
        source: a recording or file of poses.
        out: the recording to make, or .npz.
        settings: ``[prior]``, ``[trajectory]`` and, if it has them, ``[skeletons]`` of a launch file.
        replace: whether what is at ``out`` may be replaced, if it is a recording or an .npz.
        began: called with the number of frames.
        advanced: called after each.

    Raises:
        LaunchError, RecordingError, NpzError: the input cannot be used, or the output not be made.
    """
    to_npz = out.suffix == ".npz"
    check_replaceable(out, replace=replace)
    add_layouts(settings.get("skeletons", {}))
    frames = open_recording(source)
    # these bring torch, which takes seconds: not before it is known that there is something to do
    from steadypose.nodes.graph.prior_node import make_prior
    from steadypose.nodes.graph.threads import one_thread
    from steadypose.nodes.graph.trajectory_node import make_trajectory
    from steadypose.prior.clean.settings import PriorSettings

    one_thread()
    prior, trajectory = make_prior(settings["prior"]), make_trajectory(settings["trajectory"])
    began(len(frames))
    collector = NpzCollector()
    stamps_ns: list[int] = []
    poses = 0
    problems: dict[str, str] = {}
    prior_settings = PriorSettings.from_dict(settings["prior"])
    check = StreamCheck(prior_settings.max_bodies, identified=prior_settings.identify.enabled)
    log_times = LogTimes()
    started = time.perf_counter()
    with unfinished(out) as part:
        with nullcontext() if to_npz else RecordingWriter(part) as writer:
            for topic, message in stream(frames, prior, trajectory):
                if writer:
                    writer.write(topic, message, log_times.next(topic, message.stamp_ns))
                else:
                    collector.add(message)
                if isinstance(message, PoseRaw) and not message.end_of_stream:
                    now_ns = len(stamps_ns) * CHECKED_NS // CHECKED
                    check.see(message, now_ns)
                    if len(stamps_ns) % CHECKED == CHECKED - 1:
                        for problem in check.problems(now_ns, live=False):
                            problems.setdefault(problem.cause, f"{problem.cause}: {problem.text}")
                    stamps_ns.append(message.stamp_ns)
                    advanced()
                elif isinstance(message, PoseClean):
                    poses += len(message.bodies)
        if not stamps_ns:
            raise LaunchError(f"{source}: expected frames, but none of {len(frames)} could be read")
        if to_npz:
            arrays: dict[str, Any] = collector.arrays(np.array(stamps_ns, np.int64))
            np.savez(part, **arrays)
        put_in_place(part, out)
    return Cleaned(
        frames=len(stamps_ns),
        duration_s=(max(stamps_ns) - min(stamps_ns)) / 1e9,
        spent_s=time.perf_counter() - started,
        poses=poses,
        refused={cause: n for cause, n in (frames.refused + prior.counters + trajectory.counters).items() if n},
        problems=list(problems.values()),
        unread={cause: n for cause, n in frames.refused.items() if n},
    )
