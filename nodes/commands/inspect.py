"""``steadypose echo``, ``hz`` and ``info``: look at a topic while it is published, or at a recording.

A topic is looked for where this machine's nodes publish it; ``--launch`` takes the addresses (and keys) of a launch
file in place of these, ``--endpoint`` an address of one's own. Nothing here holds the nodes up.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from datetime import datetime, timezone
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from steadypose.msgs.codec import wire_type
from steadypose.msgs.keys import load_keys
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import JOINTS, Diagnostics, JointState, Message, PoseClean, PoseRaw, WorldBody
from steadypose.nodes.graph.launch import LISTENS, Launch, TransportSettings, nearest

TURN_S = 0.1
HZ_EVERY_S = 1.0
PATIENCE_S = 3.0
"""after which silence is remarked on"""
INFO_S = 2.0
"""for which `info` listens to a topic that is published"""

Topics = Annotated[tuple[str, ...], tyro.conf.arg(name="topic", metavar="TOPIC")]
Count = Annotated[int | None, tyro.conf.arg(metavar="N")]
LaunchFile = Annotated[str | None, tyro.conf.arg(metavar="FILE")]
Address = Annotated[tuple[str, ...], tyro.conf.arg(name="endpoint", metavar="ADDRESS")]


class InspectError(ValueError):
    """What was asked for is not there. The text says what is."""


def echo(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    count: Count = None,
    full: bool = False,
    topics: Topics = (),
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> None:
    """Print messages, a line for each and one for each body.

    Try:
      steadypose echo pose/world
      steadypose echo diagnostics --full --count 3
      steadypose echo RECORDING --topic pose/clean

    Args:
        target: a topic, such as pose/clean, or a recording.
        count: stop after so many messages.
        full: print every field instead, as YAML.
        topics: of a recording, this topic alone. May be given again.
        launch: the launch file, or the name of one of the project's own, whose addresses to look at.
        endpoints: the address to look at. May be given again.
    """
    left = sys.maxsize if count is None else count
    for topic, message in _messages(target, topics, launch, endpoints, newest=True):
        print(_yaml(topic, message) if full else "\n".join(_lines(topic, message)), flush=target in TOPICS)
        left -= 1
        if left <= 0:
            return


def hz(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    window: float = 10.0,
    count: Count = None,
    topics: Topics = (),
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> None:
    """Measure how often messages come: of a topic by the time they arrive, of a recording by their stamps.

    Try:
      steadypose hz pose/world
      steadypose hz pose/raw --launch kiosk

    Args:
        target: a topic, such as pose/clean, or a recording.
        window: seconds to look back; a recording is measured as a whole.
        count: stop after so many messages.
        topics: of a recording, this topic alone. May be given again.
        launch: the launch file, or the name of one of the project's own, whose addresses to look at.
        endpoints: the address to look at. May be given again.
    """
    if target not in TOPICS:
        stamps: dict[str, list[float]] = {}
        for topic, message in _messages(target, topics, launch, endpoints):
            stamps.setdefault(topic, []).append(message.stamp_ns / 1e9)
        for topic, found in stamps.items():
            print(f"{topic}: {Rate.of(found[:count])}")
        return
    with _subscribe(target, launch, endpoints) as subscriber:
        arrivals = (time.monotonic() for _ in _receive(subscriber, target))
        lost = 0
        for rate in measure(arrivals, window, count):
            missed = subscriber.dropped[target] - lost
            lost = subscriber.dropped[target]
            print(f"{rate}" + (f" lost: {missed}" if missed else ""), flush=True)


def info(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> int:
    """Tell what is in a recording, or who publishes a topic.

    Try:
      steadypose info RECORDING
      steadypose info pose/world

    Args:
        target: a topic, such as pose/clean, or a recording.
        launch: the launch file, or the name of one of the project's own, whose addresses to look at.
        endpoints: the address to look at. May be given again.

    Returns:
        0, or 1 if nobody publishes the topic.
    """
    if target not in TOPICS:
        for line in _describe_recording(_recording(target)):
            print(line)
        return 0
    print(f"{target}: {wire_type(TOPICS[target])}")
    heard = False
    for endpoint in _endpoints(target, launch, endpoints):
        with _subscribe(target, launch, (endpoint,)) as subscriber:
            arrivals, contents = _listen(subscriber)
        heard |= bool(arrivals)
        print(f"  {endpoint}: {_plural(len(arrivals), 'message', 'messages')} in {INFO_S:g} s{Rate.of(arrivals).brief}")
        if arrivals:
            print(f"    {contents}")
    if not heard:
        print("nobody publishes it there: is `steadypose run` running?")
    return 0 if heard else 1


@dataclass(frozen=True)
class Rate:
    """How often something came: mean rate in Hz, and the intervals between in seconds."""

    mean_hz: float
    shortest_s: float
    longest_s: float
    deviation_s: float
    count: int
    """things that came"""

    @classmethod
    def of(cls, times: list[float] | deque[float]) -> Rate:
        """Of times in seconds, in the order they came; NaN for fewer than two."""
        steps = np.diff(np.array(times))
        if not len(steps):
            return cls(np.nan, np.nan, np.nan, np.nan, len(times))
        span = float(steps.sum())
        mean = len(steps) / span if span > 0 else np.nan
        return cls(mean, float(steps.min()), float(steps.max()), float(steps.std()), len(times))

    @property
    def brief(self) -> str:
        """In a few words, to follow the number of messages."""
        return f", {self.mean_hz:.2f} Hz, longest gap {self.longest_s * 1e3:.0f} ms" if self.count > 1 else ""

    def __str__(self) -> str:
        return (
            f"average rate: {self.mean_hz:.3f} Hz  min: {self.shortest_s:.4f} s  max: {self.longest_s:.4f} s  "
            f"std dev: {self.deviation_s:.5f} s  window: {self.count}"
        )


def measure(arrivals: Iterator[float], window_s: float, count: int | None = None) -> Iterator[Rate]:
    """The rate over the last ``window_s`` seconds, once a second while something arrives, and at the end.

    Args:
        arrivals: times of arrival in seconds, rising, given as they come.
        window_s: seconds to look back.
        count: arrivals after which to end.
    """
    recent: deque[float] = deque()
    told = None
    for number, now in enumerate(arrivals, start=1):
        recent.append(now)
        while now - recent[0] > window_s:
            recent.popleft()
        told = now if told is None else told
        if number == count:
            break
        if now - told >= HZ_EVERY_S:
            told = now
            yield Rate.of(recent)
    if recent and recent[-1] != told:
        yield Rate.of(recent)


class _Contents:
    """What messages speak of, gathered."""

    def __init__(self) -> None:
        self._names: dict[str, Counter[str]] = {}
        self._bodies: set[int] = set()

    def add(self, message: Message) -> None:
        if isinstance(message, Diagnostics):
            self._note("nodes", message.node)
            return
        self._note("source", message.source)
        self._note("frame", message.frame_id)
        if isinstance(message, PoseRaw):
            self._note("skeleton", message.skeleton)
        if isinstance(message, PoseClean):
            self._note("delay", f"{message.delay_frames} frames")
        self._bodies.update(body.id for body in message.bodies)

    def _note(self, what: str, name: str) -> None:
        self._names.setdefault(what, Counter())[name] += 1

    def __str__(self) -> str:
        told = [f"{what} {', '.join(names)}" for what, names in self._names.items()]
        return "; ".join([*told, f"bodies {_enumerate(sorted(self._bodies))}"] if self._bodies else told)


def _enumerate(ids: list[int], most: int = 8) -> str:
    return ", ".join(map(str, ids[:most])) + (f" and {len(ids) - most} more" if len(ids) > most else "")


def _describe_recording(path: Path) -> Iterator[str]:
    with RecordingReader(path) as recording:
        contents = {topic: _Contents() for topic in recording.topics}
        stamps: dict[str, list[float]] = {topic: [] for topic in recording.topics}
        for topic, stamp_ns, message in recording:
            contents[topic].add(message)
            stamps[topic].append(stamp_ns / 1e9)
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        start = datetime.fromtimestamp(recording.start_ns / 1e9, timezone.utc)
        size = sum(file.stat().st_size for file in files) / 1e6
        yield f"{path}: {recording.duration_s:.2f} s, {size:.2f} MB"
        yield f"from {start:%Y-%m-%d %H:%M:%S.%f} UTC, stamp {recording.start_ns}"
        if not recording.complete:
            yield (
                f"cut short: the writer was killed or the file truncated, {recording.lost_bytes} bytes at its end "
                "cannot be read; what follows can"
            )
        for topic in recording.topics:
            rate = Rate.of(stamps[topic])
            yield f"{topic}: {wire_type(TOPICS[topic])}"
            yield f"    {_plural(rate.count, 'message', 'messages')}{rate.brief}"
            yield f"    {contents[topic]}"
        for topic, count in recording.refused.items():
            yield f"{topic}: {_plural(count, 'message', 'messages')} that cannot be decoded"


def _messages(
    target: str, topics: tuple[str, ...], launch: str | None, endpoints: tuple[str, ...], *, newest: bool = False
) -> Iterator[tuple[str, Message]]:
    """What comes on a topic until Ctrl-C, or what is in a recording.

    Args:
        newest: of a topic, skip what could not be taken in time.
    """
    if target in TOPICS:
        if topics:
            raise InspectError(f"--topic chooses from a recording; {target} is a topic itself")
        with _subscribe(target, launch, endpoints, conflate=newest) as subscriber:
            yield from _receive(subscriber, target)
        return
    for topic in topics:
        if topic not in TOPICS:
            raise InspectError(f"no topic {topic!r}{nearest(topic, TOPICS)}; there are {', '.join(TOPICS)}")
    with RecordingReader(_recording(target)) as recording:
        for topic, _, message in recording.messages(topics or None):
            yield topic, message


def _recording(target: str) -> Path:
    path = Path(target)
    if not path.exists():
        raise InspectError(f"no topic or recording {target!r}{nearest(target, TOPICS)}; topics are {', '.join(TOPICS)}")
    return path


def _transport(launch: str | None) -> TransportSettings:
    return TransportSettings() if launch is None else Launch.read(launch).transport


def _endpoints(topic: str, launch: str | None, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Where a topic may be published."""
    # a recorder hears every topic, so its entry says who publishes what
    publishers = [node for node, published in LISTENS["recorder"].items() if topic in published]
    return endpoints or tuple(_transport(launch).endpoint(node) for node in publishers)


def _subscribe(topic: str, launch: str | None, endpoints: tuple[str, ...], *, conflate: bool = False) -> Subscriber:
    directory = _transport(launch).keys
    keys = load_keys(directory) if directory else None
    return Subscriber(_endpoints(topic, launch, endpoints), topic, keys=keys, conflate=conflate)


def _receive(subscriber: Subscriber, topic: str) -> Iterator[tuple[str, Message]]:
    """What comes, for ever; a silence at the start is remarked on."""
    started: float | None = time.monotonic()
    while True:
        received = subscriber.receive(TURN_S)
        if received is not None:
            started = None
            yield received
        elif started is not None and time.monotonic() - started > PATIENCE_S:
            started = None
            print(f"nothing on {topic} yet: is `steadypose run` running?", file=sys.stderr)


def _listen(subscriber: Subscriber) -> tuple[list[float], _Contents]:
    """Times of arrival and contents of what comes in a short while."""
    arrivals: list[float] = []
    contents = _Contents()
    until = time.monotonic() + INFO_S
    while (left := until - time.monotonic()) > 0:
        received = subscriber.receive(min(left, TURN_S))
        if received is not None:
            arrivals.append(time.monotonic())
            contents.add(received[1])
    return arrivals, contents


def _lines(topic: str, message: Message) -> Iterator[str]:
    """A message in a line, and a line for each body."""
    stamp = f"{topic:<11} {message.stamp_ns / 1e9:.3f}"
    if isinstance(message, Diagnostics):
        yield f"{stamp}  {message.node}: {message.level.name} {message.message}"
        return
    end = "  end of stream" if message.end_of_stream else ""
    kind = f"  {message.skeleton}" if isinstance(message, PoseRaw) else ""
    delay = f"  delay {message.delay_frames}" if isinstance(message, PoseClean) else ""
    yield f"{stamp}  {message.source}{kind}{delay}  {_plural(len(message.bodies), 'body', 'bodies')}{end}"
    if isinstance(message, PoseRaw):
        for raw in message.bodies:
            given = np.isfinite(raw.positions).all(axis=1)
            centre = raw.positions[given].mean(axis=0) if given.any() else np.full(3, np.nan)
            seen = f"{given.sum()} of {len(raw.positions)} joints"
            yield f"  {raw.id}: {seen}, their centre {_vector(centre)} in the sensor's frame"
        return
    for body in message.bodies:
        states = ", ".join(
            f"{(body.state == state).sum()} {state.name.lower()}" for state in JointState if (body.state == state).any()
        )
        spread = f"sigma up to {body.sigma.max() * 100:.1f} cm"
        if isinstance(body, WorldBody):
            speed = float(np.linalg.norm(body.root_velocity))
            tracking = body.tracking.name.lower()
            yield f"  {body.id}: root {_vector(body.root_position)}, {speed:.2f} m/s, {tracking}; {states}; {spread}"
        else:
            flag = " FLAGGED" if body.anomaly_flag else ""
            anomaly = f"; anomaly {body.anomaly:.2f}{flag}" if np.isfinite(body.anomaly) or flag else ""
            yield f"  {body.id}: root {_vector(body.positions[0])} in the sensor's frame; {states}; {spread}{anomaly}"


def _plural(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"


def _vector(values: NDArray[np.floating]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ") m"


def _yaml(topic: str, message: Message) -> str:
    return "\n".join(["---", f"topic: {topic}", *_fields(message, "")])


def _fields(record: Any, indent: str) -> Iterator[str]:
    """The fields of a message as lines of YAML; arrays of the canonical joints with the joints' names."""
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, list) and value:
            yield f"{indent}{field.name}:"
            for item in value:
                first, *others = _fields(item, indent + "    ")
                yield f"{indent}  - {first.strip()}"
                yield from others
        elif is_dataclass(value):
            yield f"{indent}{field.name}:"
            yield from _fields(value, indent + "  ")
        elif isinstance(value, np.ndarray) and value.shape[:1] == (len(JOINTS),):
            yield f"{indent}{field.name}:"
            for joint, row in zip(JOINTS, value, strict=True):
                yield f"{indent}  {joint}: {_scalar(row, JointState if field.name == 'state' else None)}"
        elif isinstance(value, np.ndarray) and value.ndim == 2:
            yield f"{indent}{field.name}:"
            yield from (f"{indent}  - {_scalar(row)}" for row in value)
        elif isinstance(value, dict):
            yield f"{indent}{field.name}:" + ("" if value else " {}")
            yield from (f"{indent}  {key}: {_scalar(text)}" for key, text in value.items())
        else:
            yield f"{indent}{field.name}: {_scalar(value)}"


def _scalar(value: Any, names: Callable[[int], IntEnum] | None = None) -> str:
    if names is not None:
        return names(int(value)).name
    if isinstance(value, np.ndarray):
        return "[" + ", ".join(_scalar(item) for item in value.tolist()) + "]"
    if isinstance(value, IntEnum):
        return value.name
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, float | np.floating):
        return f"{float(value):.5g}" if np.isfinite(value) else f".{float(value)}".replace(".-", "-.")
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return str(value)
