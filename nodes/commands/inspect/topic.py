"""What `echo`, `hz` and `info` look at: a topic while it is published, or a recording.

A topic is looked for where this machine's nodes publish it; ``--launch`` takes the addresses (and keys) of a launch
file in place of these, ``--endpoint`` an address of one's own. Nothing here holds the nodes up.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import tyro

from steadypose.msgs.keys import load_keys
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Message
from steadypose.nodes.graph.access import TransportSettings
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import publishers
from steadypose.prior.settings import nearest

PATIENCE_S = 3.0
"""without a message, after which a hint is printed"""
Topics = Annotated[tuple[str, ...], tyro.conf.arg(name="topic", metavar="TOPIC")]
Count = Annotated[int | None, tyro.conf.arg(metavar="N")]
LaunchFile = Annotated[str | None, tyro.conf.arg(metavar="FILE")]
Address = Annotated[tuple[str, ...], tyro.conf.arg(name="endpoint", metavar="ADDRESS")]


class InspectError(ValueError):
    """No such topic or recording. The text says what there is."""


def messages_of(
    target: str, topics: tuple[str, ...], launch: str | None, endpoints: tuple[str, ...], *, newest: bool = False
) -> Iterator[tuple[str, Message]]:
    """What comes on a topic until Ctrl-C, or what is in a recording.

    Args:
        newest: of a topic, skip what could not be taken in time.
    """
    if target in TOPICS:
        if topics:
            raise InspectError(f"--topic chooses from a recording; {target} is a topic itself")
        with subscribe(target, launch, endpoints, conflate=newest) as subscriber:
            yield from receive(subscriber, target)
        return
    for topic in topics:
        if topic not in TOPICS:
            raise InspectError(f"no topic {topic!r}{nearest(topic, TOPICS)}; there are {', '.join(TOPICS)}")
    with RecordingReader(recording_at(target)) as recording:
        for topic, _, message in recording.messages(topics or None):
            yield topic, message


def recording_at(target: str) -> Path:
    path = Path(target)
    if not path.exists():
        raise InspectError(f"no topic or recording {target!r}{nearest(target, TOPICS)}; topics are {', '.join(TOPICS)}")
    return path


def _transport(launch: str | None) -> TransportSettings:
    return TransportSettings() if launch is None else Launch.read(launch).transport


def endpoints_of(topic: str, launch: str | None, endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Where a topic may be published."""
    return endpoints or tuple(_transport(launch).endpoint(node) for node in publishers(topic))


def subscribe(topic: str, launch: str | None, endpoints: tuple[str, ...], *, conflate: bool = False) -> Subscriber:
    transport = _transport(launch)
    keys = load_keys(transport.keys) if transport.keys else None
    addresses = endpoints_of(topic, launch, endpoints)
    return Subscriber(addresses, topic, keys=keys, clear_text=transport.clear_text, conflate=conflate)


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


def plural(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"
