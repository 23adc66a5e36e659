"""How one recording is cleaned offline: the nodes' own pipelines over it, as fast as they go."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.commands.output import ARRAY_FILES, check_replaceable, put_in_place, unfinished, write_arrays
from steadypose.nodes.driving import OfflineRun
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sinks.recorder import LogTimes
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.layouts import add_layouts


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
        out: the recording to make, or .npz or .csv.
        settings: ``[prior]``, ``[trajectory]`` and, if it has them, ``[skeletons]`` of a launch file; ``rig`` is what a
            file of motion does not say.
        replace: whether what is at ``out`` may be replaced, if it is a recording or an .npz.
        began: called with the number of frames.
        advanced: called after each.

    Raises:
        LaunchError, RecordingError, NpzError: the input cannot be used, or the output not be made.
    """
    to_file = out.suffix in ARRAY_FILES
    check_replaceable(out, replace=replace)
    add_layouts(settings.get("skeletons", {}))
    frames = open_recording(source, settings.get("rig", {}))
    run = OfflineRun(frames, settings)
    began(len(frames))
    collector = NpzCollector()
    log_times = LogTimes()
    started = time.perf_counter()
    with unfinished(out) as part:
        with nullcontext() if to_file else RecordingWriter(part) as writer:
            for topic, message in run:
                if writer:
                    writer.write(topic, message, log_times.next(topic, message.stamp_ns))
                else:
                    collector.add(message)
                if isinstance(message, PoseRaw) and not message.end_of_stream:
                    advanced()
        stamps_ns = run.stamps_ns
        if not len(stamps_ns):
            raise LaunchError(f"{source}: expected frames, but none of {len(frames)} could be read")
        if to_file:
            write_arrays(part, collector.arrays(stamps_ns))
        put_in_place(part, out)
    return Cleaned(
        frames=len(stamps_ns),
        duration_s=float(np.ptp(stamps_ns)) / 1e9,
        spent_s=time.perf_counter() - started,
        poses=run.poses,
        refused=dict(run.refused),
        problems=run.diagnosis.texts,
        unread={cause: n for cause, n in frames.refused.items() if n},
    )
