"""Runs the node processes and observes them from outside."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from steadypose.msgs.topics import DIAGNOSTICS, POSE_WORLD
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import WATCHER
from steadypose.nodes.graph.supervisor import Supervisor
from steadypose.nodes.graph.topology import POSE_NODES

START_S = 60.0  # time allowed for the nodes to start, seconds
SILENCE_S = 30.0  # time without a message after which a node counts as hung, seconds


class Running(NamedTuple):
    messages: Iterator[tuple[str, Message]]
    """what they publish, ``pose/world`` and ``diagnostics``, with its topic, as it arrives; ends when a node fails or
    all fall silent"""
    subscriber: Subscriber
    """source of ``messages``, for callers who do not want to wait for them"""
    supervisor: Supervisor
    """the supervisor of their processes"""
    clock: Clock
    """their clock"""
    endpoints: list[str]
    """where they publish"""


@contextmanager
def running(recording: Path, *settings: str) -> Iterator[Running]:
    """Run the node processes on a recording at camera rate, with live transport."""
    played = [f"input.recording={json.dumps(str(recording))}", "input.rate=1.0", "transport.lossless=false"]
    with running_nodes([*POSE_NODES], [*played, *settings]) as nodes:
        yield nodes


@contextmanager
def running_nodes(nodes: Sequence[str], settings: Sequence[str]) -> Iterator[Running]:
    """Run the processes of these nodes, with these settings over those of ``launch/replay.toml``."""
    console = Console(stderr=True)
    clock = Clock()
    with tempfile.TemporaryDirectory(prefix="steadypose-") as folder:
        settings = [*settings, f"nodes={json.dumps(list(nodes))}", f"transport.directory={json.dumps(folder)}"]
        arguments = ["--launch", "replay", *(word for setting in settings for word in ("--set", setting))]
        transport = Launch.read("replay", settings).transport
        endpoints = [transport.endpoint(name) for name in nodes]
        with (
            Subscriber(endpoints, [POSE_WORLD, DIAGNOSTICS], name=WATCHER) as subscriber,
            Supervisor(nodes, arguments, clock, lambda line: console.print(line, markup=False)) as supervisor,
        ):
            yield Running(_received(subscriber, supervisor), subscriber, supervisor, clock, endpoints)


def _received(subscriber: Subscriber, supervisor: Supervisor) -> Iterator[tuple[str, Message]]:
    left_s = START_S
    while not supervisor.failed and left_s > 0:
        received = subscriber.receive(POLL_S)
        if received is None:
            left_s -= POLL_S
        else:
            left_s = SILENCE_S
            if isinstance(message := received[1], Diagnostics) and message.node in supervisor.children:
                supervisor.children[message.node].heard()
        supervisor.poll()
        if received:
            yield received
