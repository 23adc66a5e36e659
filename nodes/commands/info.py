"""``steadypose info``: what is in a recording or a file of poses, or who publishes a topic."""

import time
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from steadypose.msgs.codec import wire_type
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, JointState, Message, PoseClean, PoseEvents, PoseRaw
from steadypose.nodes.checks.problem import observed
from steadypose.nodes.commands.inspect import Address, LaunchFile, Rate, endpoints_of, recording_at, subscribe
from steadypose.nodes.commands.output import plural
from steadypose.nodes.driving import CHECKED, Diagnosis
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.settings import printable
from steadypose.nodes.sources.npz import is_output, read_arrays
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.clean.settings import PriorSettings

INFO_S = 2.0  # for which `info` listens to a topic that is published


def info(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")], launch: LaunchFile = None, endpoints: Address = ()
) -> int:
    """Describe a recording or a file of poses, or list who publishes a topic.

    Try:
      steadypose info RECORDING
      steadypose info pose/world

    Args:
        target: a topic, such as pose/clean; a recording; or a file of poses.
        launch: launch file, or name of a bundled one, whose addresses to listen at.
        endpoints: address to listen at. Repeatable.

    Returns:
        0, or 1 if nobody publishes the topic.
    """
    if target not in TOPICS:
        path = recording_at(target)
        for line in _describe_recording(path) if path.is_dir() or path.suffix == ".mcap" else describe_file(path):
            print(printable(line))
        return 0
    print(f"{target}: {wire_type(TOPICS[target])}")
    published = False
    for endpoint in endpoints_of(target, launch, endpoints):
        with subscribe(target, launch, (endpoint,)) as subscriber:
            contents = _listen(subscriber)
        published |= bool(contents.messages)
        print(f"  {endpoint}: {plural(contents.messages, 'message')} in {INFO_S:g} s{Rate(contents.times).brief}")
        if contents.messages:
            print(f"    {contents}")
    if not published:
        print("nobody publishes it there: is `steadypose run` running?")
    return 0 if published else 1


class _Contents:
    """A summary of messages, and when they came, in seconds."""

    def __init__(self) -> None:
        self.messages = 0
        self.times: list[float] = []  # without the end of a stream, which repeats the last frame's
        self._names: dict[str, dict[str, None]] = {}
        self._bodies: set[int] = set()

    def add(self, message: Message, time_s: float) -> None:
        self.messages += 1
        if isinstance(message, Diagnostics):
            self.times.append(time_s)
            self._note("nodes", message.node)
            return
        if not message.end_of_stream:
            self.times.append(time_s)
        self._note("source", message.source)
        self._note("frame", message.frame_id)
        if isinstance(message, PoseRaw):
            self._note("skeleton", message.skeleton)
        if isinstance(message, PoseClean):
            self._note("delay", plural(message.delay_frames, "frame"))
        if isinstance(message, PoseEvents):
            self._bodies.update(event.body for event in message.events)
        else:
            self._bodies.update(body.id for body in message.bodies)

    def _note(self, what: str, name: str) -> None:
        self._names.setdefault(what, {})[name] = None

    def __str__(self) -> str:
        parts = [f"{what} {', '.join(names)}" for what, names in self._names.items()]
        if self._bodies:
            ids = sorted(self._bodies)
            more = f" and {len(ids) - 8} more" if len(ids) > 8 else ""
            parts.append(f"body ids {', '.join(map(str, ids[:8]))}{more}")
        return printable("; ".join(parts))


def _describe_recording(path: Path) -> Iterator[str]:
    with RecordingReader(path) as recording:
        contents = {topic: _Contents() for topic in recording.topics}
        for topic, stamp_ns, message in recording:
            contents[topic].add(message, stamp_ns / 1e9)
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        start = datetime.fromtimestamp(recording.start_ns / 1e9, timezone.utc)
        size = sum(file.stat().st_size for file in files) / 1e6
        yield f"{path}: {recording.duration_s:.2f} s, {size:.2f} MB"
        yield f"from {start:%Y-%m-%d %H:%M:%S.%f} UTC, stamp {recording.start_ns}"
        if not recording.complete:
            yield "cut short: the writer was killed or the file truncated; what follows could be read"
        if recording.lost_bytes:
            where = plural(recording.gaps, "place")
            yield f"damaged: {recording.lost_bytes} bytes in {where} cannot be read; `steadypose repair` saves the rest"
        for topic in recording.topics:
            yield f"{topic}: {wire_type(TOPICS[topic])}"
            yield f"    {plural(contents[topic].messages, 'message')}{Rate(contents[topic].times).brief}"
            yield f"    {contents[topic]}"
        for topic, count in recording.refused.items():
            yield f"{topic}: {plural(count, 'message')} that cannot be decoded"


def _listen(subscriber: Subscriber) -> _Contents:
    contents = _Contents()
    until = time.monotonic() + INFO_S
    while (left := until - time.monotonic()) > 0:
        if received := subscriber.receive(min(left, POLL_S)):
            contents.add(received[1], time.monotonic())
    return contents


def describe_file(path: Path) -> Iterator[str]:
    """Lines with the content of a file of poses, and its probable faults. Raises as `open_recording`."""
    size = f"{path.stat().st_size / 1e6:.2f} MB"
    if path.suffix == ".npz":
        arrays = read_arrays(path)
        output = is_output(arrays)
        yield f"{path}: {'an output of clean, complete or fit' if output else 'joints'}, {size}"
        for name, array in arrays.items():
            yield f"    {name} {array.shape} {array.dtype}"
        if output:
            state = arrays["state"]
            shares = ", ".join(f"{kind.name.lower()} {(state == kind).mean():.1%}" for kind in JointState)
            yield f"joints: {shares}; poses flagged as anomalies: {arrays['anomaly_flag'].mean():.1%}"
    source = open_recording(path)
    if path.suffix != ".npz":
        yield f"{path}: joints, {size}"
    diagnosis = Diagnosis(PriorSettings())
    stamps, seen, skeletons, ids = [], [], set(), set()
    for _, message in source:
        if isinstance(message, PoseRaw):
            diagnosis.see(message)
            if diagnosis.frames % CHECKED == 0:
                diagnosis.look()
            stamps.append(message.stamp_ns / 1e9)
            skeletons.add(message.skeleton)
            for body in message.bodies:
                # in an output, imputed joints have a confidence of 0
                if (there := np.isfinite(observed(body)[:, 0])).any():
                    ids.add(body.id)
                    seen.append(there.mean())
    rate = Rate(stamps)
    share = f"{np.mean(seen):.0%} of their joints observed" if seen else "nobody in any frame"
    yield f"{plural(rate.count, 'frame')}{rate.brief}, {stamps[-1] - stamps[0]:.2f} s; skeleton {', '.join(skeletons)}"
    yield f"body ids {', '.join(map(str, sorted(ids))) or 'none'}; {share}"
    for cause, number in source.refused.items():
        yield f"refused, {cause}: {number}"
    diagnosis.end()
    yield from diagnosis.texts
