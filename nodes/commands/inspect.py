"""``steadypose echo`` and ``steadypose hz``: the messages of a topic or a recording, and their rate.

A topic is looked for where this machine's nodes publish it; ``--launch`` takes the addresses (and keys) of a launch
file in place of these, ``--endpoint`` an address of one's own. Nothing here holds the nodes up.
"""

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import JOINTS, Diagnostics, JointState, Message, PoseClean, PoseEvents, PoseRaw, WorldBody
from steadypose.nodes.commands.output import plural
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import TransportSettings, publishers
from steadypose.nodes.settings import STREAMS, LaunchError, located, printable
from steadypose.prior.settings import nearest

PATIENCE_S = 3.0  # without a message, after which a hint is printed
Topics = Annotated[tuple[str, ...], tyro.conf.arg(name="topic", metavar="TOPIC")]
Count = Annotated[int | None, tyro.conf.arg(metavar="N")]
LaunchFile = Annotated[str | None, tyro.conf.arg(metavar="FILE")]
Address = Annotated[tuple[str, ...], tyro.conf.arg(name="endpoint", metavar="ADDRESS")]


def messages_of(
    target: str, topics: tuple[str, ...], launch: str | None, endpoints: tuple[str, ...]
) -> Iterator[tuple[str, Message]]:
    """What comes on a topic until Ctrl-C, without what could not be taken in time; or a recording's."""
    if target in TOPICS:
        if topics:
            raise LaunchError(f"--topic chooses from a recording; {target} is a topic itself")
        with subscribe(target, launch, endpoints, conflate=True) as subscriber:
            yield from receive(subscriber, target)
        return
    for topic in topics:
        if topic not in TOPICS:
            raise LaunchError(f"no topic {topic!r}{nearest(topic, TOPICS)}; there are {', '.join(TOPICS)}")
    with RecordingReader(recording_at(target)) as recording:
        for topic, _, message in recording.messages(topics or None):
            yield topic, message


def recording_at(target: str) -> Path:
    path = located(target, Path(), STREAMS)
    if not path.exists():
        raise LaunchError(f"no topic or recording {target!r}{nearest(target, TOPICS)}; topics are {', '.join(TOPICS)}")
    return path


def _transport(launch: str | None) -> TransportSettings:
    return TransportSettings() if launch is None else Launch.read(launch).transport


def endpoints_of(topic: str, launch: str | None, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Where a topic may be published."""
    return endpoints or tuple(_transport(launch).endpoint(node) for node in publishers(topic))


def subscribe(topic: str, launch: str | None, endpoints: tuple[str, ...], *, conflate: bool = False) -> Subscriber:
    transport = _transport(launch)
    addresses = endpoints_of(topic, launch, endpoints)
    return Subscriber(addresses, topic, keys=transport.curve_keys(), clear_text=transport.clear_text, conflate=conflate)


def receive(subscriber: Subscriber, topic: str) -> Iterator[tuple[str, Message]]:
    """What comes, for ever; a silence at the start is remarked on."""
    started: float | None = time.monotonic()
    while True:
        received = subscriber.receive(POLL_S)
        if received is not None:
            started = None
            yield received
        elif started is not None and time.monotonic() - started > PATIENCE_S:
            started = None
            print(f"nothing on {topic} yet: is `steadypose run` running?", file=sys.stderr)


def echo(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    count: Count = None,
    full: bool = False,
    topics: Topics = (),
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> None:
    """Print messages: one line per message and one per body.

    Try:
      steadypose echo pose/world
      steadypose echo diagnostics --full --count 3
      steadypose echo RECORDING --topic pose/clean

    Args:
        target: a topic, such as pose/clean, or a recording.
        count: stop after this many messages.
        full: print every field, as YAML.
        topics: in a recording, only this topic. Repeatable.
        launch: launch file, or name of a bundled one, whose addresses to listen at.
        endpoints: address to listen at. Repeatable.
    """
    left = sys.maxsize if count is None else count
    for topic, message in messages_of(target, topics, launch, endpoints):
        lines = ["---", f"topic: {topic}", *_fields(message, "")] if full else _lines(topic, message)
        print("\n".join(map(printable, lines)), flush=target in TOPICS)
        left -= 1
        if left <= 0:
            return


def _lines(topic: str, message: Message) -> Iterator[str]:
    """A message in a line, and a line for each body."""
    stamp = f"{topic:<11} {message.stamp_ns / 1e9:.3f}"
    if isinstance(message, Diagnostics):
        yield f"{stamp}  {message.node}: {message.level.name} {message.message}"
        return
    end = "  end of stream" if message.end_of_stream else ""
    if isinstance(message, PoseEvents):
        yield f"{stamp}  {message.source}  {plural(len(message.events), 'event')}{end}"
        for event in message.events:
            hand = f"{event.hand.name.lower()} " if event.hand else ""
            what = f"{hand}{event.kind.name.lower()} {event.phase.name.lower()}"
            yield f"  {event.body}: {what}, confidence {event.confidence:.2f}"
        return
    kind = f"  {message.skeleton}" if isinstance(message, PoseRaw) else ""
    delay = f"  delay {message.delay_frames}" if isinstance(message, PoseClean) else ""
    yield f"{stamp}  {message.source}{kind}{delay}  {plural(len(message.bodies), 'body', 'bodies')}{end}"
    if isinstance(message, PoseRaw):
        for raw in message.bodies:
            given = np.isfinite(raw.positions).all(axis=1)
            centre = raw.positions[given].mean(axis=0) if given.any() else np.full(3, np.nan)
            seen = f"{given.sum()} of {len(raw.positions)} joints"
            yield f"  {raw.id}: {seen}, their centre {_vector(centre)} in the sensor's frame"
        return
    for body in message.bodies:
        counts = {state.name.lower(): (body.state == state).sum() for state in JointState}
        states = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
        spread = f"sigma up to {body.sigma.max() * 100:.1f} cm"
        if isinstance(body, WorldBody):
            speed = float(np.linalg.norm(body.root_velocity))
            tracking = body.tracking.name.lower()
            yield f"  {body.id}: root {_vector(body.root_position)}, {speed:.2f} m/s, {tracking}; {states}; {spread}"
        else:
            flag = " FLAGGED" if body.anomaly_flag else ""
            anomaly = f"; anomaly {body.anomaly:.2f}{flag}" if np.isfinite(body.anomaly) or flag else ""
            yield f"  {body.id}: root {_vector(body.positions[0])} in the sensor's frame; {states}; {spread}{anomaly}"


def _vector(values: NDArray[np.floating]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ") m"


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


HZ_EVERY_S = 1.0


def hz(
    target: Annotated[str, tyro.conf.arg(metavar="TOPIC|RECORDING")],
    window: float = 10.0,
    count: Count = None,
    topics: Topics = (),
    launch: LaunchFile = None,
    endpoints: Address = (),
) -> None:
    """Measure the rate of messages: on a topic by arrival times, in a recording by stamps.

    Try:
      steadypose hz pose/world
      steadypose hz pose/raw --launch kiosk

    Args:
        target: a topic, such as pose/clean, or a recording.
        window: seconds over which to average; a recording is measured as a whole.
        count: stop after this many messages.
        topics: in a recording, only this topic. Repeatable.
        launch: launch file, or name of a bundled one, whose addresses to listen at.
        endpoints: address to listen at. Repeatable.
    """
    if target not in TOPICS:
        stamps: dict[str, list[float]] = {}
        for topic, message in messages_of(target, topics, launch, endpoints):
            if isinstance(message, Diagnostics) or not message.end_of_stream:  # the end repeats the last stamp
                stamps.setdefault(topic, []).append(message.stamp_ns / 1e9)
        for topic, found in stamps.items():
            print(f"{topic}: {Rate(found[:count])}")
        return
    with subscribe(target, launch, endpoints) as subscriber:
        arrivals = (time.monotonic() for _ in receive(subscriber, target))
        lost = 0
        for rate in measure(arrivals, window, count):
            missed = subscriber.dropped[target] - lost
            lost = subscriber.dropped[target]
            print(f"{rate}" + (f" lost: {missed}" if missed else ""), flush=True)


class Rate:
    """The rate of something that came at ``times``, seconds, in order: mean in Hz, intervals in seconds; NaN for fewer
    than two.
    """

    def __init__(self, times: Sequence[float]) -> None:
        steps = np.diff(np.array(times)) if len(times) > 1 else np.array([np.nan])
        span = float(steps.sum())
        self.count = len(times)
        self.mean_hz = len(steps) / span if span > 0 else np.nan
        self.shortest_s, self.longest_s = float(steps.min()), float(steps.max())
        self.deviation_s = float(steps.std())

    @property
    def brief(self) -> str:
        """In a few words, to follow the number of messages."""
        if np.isnan(self.mean_hz):  # fewer than two, or all of one stamp
            return ""
        return f", {self.mean_hz:.2f} Hz, longest gap {self.longest_s * 1e3:.0f} ms"

    def __str__(self) -> str:
        if np.isnan(self.mean_hz):
            return f"no rate, window: {self.count}"
        return (
            f"average rate: {self.mean_hz:.3f} Hz  min: {self.shortest_s:.4f} s  max: {self.longest_s:.4f} s  "
            f"std dev: {self.deviation_s:.5f} s  window: {self.count}"
        )


def measure(arrivals: Iterator[float], window_s: float, count: int | None = None) -> Iterator[Rate]:
    """The rate over the last ``window_s`` seconds, once a second while something arrives, and at the end.

    ``arrivals`` are rising times in seconds, given as they come. The measurement ends after ``count`` of them.
    """
    recent: deque[float] = deque()
    reported_at = None
    for number, now in enumerate(arrivals, start=1):
        recent.append(now)
        while now - recent[0] > window_s:
            recent.popleft()
        reported_at = now if reported_at is None else reported_at
        if number == count:
            break
        if now - reported_at >= HZ_EVERY_S:
            reported_at = now
            yield Rate(recent)
    if recent and recent[-1] != reported_at:
        yield Rate(recent)
