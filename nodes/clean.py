"""``steadypose clean``: the nodes' own pipelines over a recording, offline, as fast as they go."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from msgs.recording import RecordingWriter
from msgs.topics import POSE_CLEAN, POSE_WORLD
from msgs.types import Message, PoseClean, PoseRaw, PoseWorld
from nodes.launch import LaunchError, apply_override
from nodes.npz import NpzCollector
from nodes.pose_input import open_source, with_end
from nodes.recorder import Filing


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


def clean(
    source: Annotated[Path, tyro.conf.arg(name="in", metavar="IN")],
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")],
    weights: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
    delay: Annotated[int | None, tyro.conf.arg(metavar="K")] = None,
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="STAGE.OPTION=VALUE")] = (),
) -> None:
    """Clean recorded poses: what `run` does live, offline, with the same numbers.

    Args:
        source: a recording, or .npz with positions (T, J, 3) in metres, skeleton, and stamp_ns (T,) or fps.
        out: the recording to make, or .npz with one row for each row of the input.
        weights: weight set of the models: 'default', unless given, or 'research'.
        delay: frames at 30 Hz to wait for, 0 to 16; more is smoother. 4 unless given.
        settings: any setting of [prior], such as gate.enabled=false, or of [trajectory], such as
            trajectory.contacts=false. May be given again.
    """
    table: dict[str, Any] = {"prior": {}, "trajectory": {}}
    if weights is not None:
        table = {"prior": {"refine": {"weights": weights}}, "trajectory": {"weights": weights}}
    if delay is not None:
        table["prior"]["delay"] = delay
    for override in settings:
        apply_override(table, override if override.startswith("trajectory.") else f"prior.{override}")
    if source.resolve() == out.resolve():
        raise LaunchError(f"{out}: expected another path than the input's; nothing is cleaned in place")
    if not out.resolve().parent.is_dir():
        raise LaunchError(f"{out}: expected its folder {out.resolve().parent} to exist; make it first")
    frames = open_source(source)
    # these bring torch, which takes seconds: not before it is known that there is something to do
    import torch

    from nodes.prior import make_prior
    from nodes.trajectory import make_trajectory

    torch.set_num_threads(1)  # the models are too small to gain from more
    prior, trajectory = make_prior(table["prior"]), make_trajectory(table["trajectory"])
    collector = NpzCollector() if out.suffix == ".npz" else None
    stamps_ns: list[int] = []
    answers = 0
    filing = Filing()
    started = time.perf_counter()
    console = Console(stderr=True)
    with ExitStack() as stack:
        writer = None if collector else stack.enter_context(RecordingWriter(out))
        progress = stack.enter_context(Progress(console=console, disable=not console.is_terminal))
        bar = progress.add_task(source.name, total=len(frames))
        for topic, message in stream(frames, prior, trajectory):
            if writer:
                writer.write(topic, message, filing.stamp(topic, message.stamp_ns))
            elif collector:
                collector.add(message)
            if isinstance(message, PoseRaw) and not message.end_of_stream:
                stamps_ns.append(message.stamp_ns)
                progress.advance(bar)
            elif isinstance(message, PoseClean):
                answers += len(message.bodies)
    if not stamps_ns:
        raise LaunchError(f"{source}: expected frames, but none of {len(frames)} could be read")
    if collector:
        _save(out, collector.arrays(np.array(stamps_ns, np.int64)))
    spent = time.perf_counter() - started
    covered = (max(stamps_ns) - min(stamps_ns)) / 1e9
    console.print(f"{out}: {len(stamps_ns)} frames, {covered:.1f} s, cleaned in {spent:.1f} s", highlight=False)
    for cause, count in (frames.refused + prior.counters + trajectory.counters).items():
        console.print(f"  refused or dropped, {cause}: {count}", highlight=False)
    if not answers:
        console.print(f"  no body was recognised: is the skeleton right, are the units metres? See what {source} holds")


def _save(path: Path, arrays: dict[str, Any]) -> None:
    unfinished = path.with_name(path.name + ".tmp")
    with unfinished.open("wb") as file:
        np.savez(file, **arrays)
    unfinished.replace(path)
