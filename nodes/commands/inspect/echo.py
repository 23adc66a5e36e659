"""``steadypose echo``: messages as lines, or in full as YAML."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from enum import IntEnum
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from steadypose.msgs.topics import TOPICS
from steadypose.msgs.types import JOINTS, Diagnostics, JointState, Message, PoseClean, PoseEvents, PoseRaw, WorldBody
from steadypose.nodes.commands.inspect.topic import (
    Address,
    Count,
    LaunchFile,
    Topics,
    messages_of,
    plural,
)
from steadypose.nodes.commands.printable import printable


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
    for topic, message in messages_of(target, topics, launch, endpoints, newest=True):
        lines = _yaml(topic, message).split("\n") if full else _lines(topic, message)
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
        yield f"{stamp}  {message.source}  {plural(len(message.events), 'event', 'events')}{end}"
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
