"""State that ``steadypose run`` keeps: locks of the nodes' addresses, message counts, ``health.json``."""

import dataclasses
import fcntl
import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from steadypose.msgs.security import local_directory, make_private
from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.supervisor import Supervisor
from steadypose.nodes.graph.topology import NODES, Delivery
from steadypose.nodes.settings import LaunchError

HEALTH_FILE = "health.json"


@contextmanager
def run_lock(launch: Launch) -> Iterator[bool]:
    """Lock the addresses of a run's nodes. Yields whether this run, and no other, writes ``health.json``.

    Raises LaunchError if another run uses one of the addresses.
    """
    directory = launch.transport.make_ipc_directory()
    with ExitStack() as stack:
        for name in launch.nodes:
            endpoint = launch.transport.endpoint(name)
            if endpoint.startswith("ipc://"):
                holder = _take(stack, endpoint.removeprefix("ipc://") + ".lock")
            else:  # a fixed directory, because launches with different socket directories share tcp ports
                make_private(local_directory())
                holder = _take(stack, f"{local_directory()}/{endpoint.replace('/', '')}.lock")
            if holder is not None:
                remedy = "stop that one, or give this one a [transport] directory or [transport.endpoints] of its own"
                raise LaunchError(f"{name} runs already at {endpoint}, in another `steadypose run`{holder}: {remedy}")
        yield _take(stack, f"{directory}/health.lock") is None


def _take(stack: ExitStack, path: str) -> str | None:
    """Take a lock. Returns None on success, or a text that names the process that holds it (empty if unknown)."""
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise LaunchError(f"cannot make {path}: {error.strerror}") from error
    stack.callback(os.close, file)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        pid = os.read(file, 16).decode("ascii", "replace").strip()
        return f" (process {pid})" if pid else ""
    os.ftruncate(file, 0)
    with suppress(OSError):  # on a full disk the lock holds all the same
        os.write(file, str(os.getpid()).encode())
    return None


LOSSES = ("dropped.", "refused.")  # prefixes of the counts of messages that a node did not process


class Ledger:
    """Accumulates the counts of a run's nodes over restarts, because a restarted node counts from 0."""

    def __init__(self, launch: Launch) -> None:
        self._launch = launch
        self._before: dict[str, Counter[str]] = {}
        self._latest: dict[str, Diagnostics] = {}
        self._restarts: Counter[str] = Counter()
        self._ended: dict[str, set[str]] = {}

    def note(self, diagnostics: Diagnostics, restarts: int) -> Diagnostics:
        """Add a node's report, given its number of restarts. Returns the report with sums over all its processes."""
        node = diagnostics.node
        before = self._before.setdefault(node, Counter())
        if restarts != self._restarts[node] and node in self._latest:
            before.update(self._counts(self._latest[node]))
        self._restarts[node], self._latest[node] = restarts, diagnostics
        total = {key: str(n) for key, n in (before + self._counts(diagnostics)).items()}
        if self._launch.transport.lossless:  # a node killed after the end of a stream does not receive the end again
            ended = self._ended.setdefault(node, set())
            ended.update(diagnostics.values.get("ended", "").split())
            total["ended"] = " ".join(sorted(ended))
        return dataclasses.replace(diagnostics, values=diagnostics.values | total)

    def _counts(self, diagnostics: Diagnostics) -> Counter[str]:
        # a source, and a lossless node, itself continues its predecessor's counts of received and published messages
        goes_on = self._launch.transport.lossless or not NODES[diagnostics.node].subscribes
        restarted = LOSSES if goes_on else (*LOSSES, "in.", "count.")
        return Counter({k: int(n) for k, n in diagnostics.values.items() if k.startswith(restarted)})

    def away(self, node: str, reports: dict[str, Diagnostics]) -> dict[str, str]:
        """Number of messages per topic that a node missed while it was down, from the last reports of all nodes.

        The last report of a killed node is up to a second old, which limits the accuracy.
        """
        declared = NODES[node]
        if self._launch.transport.lossless or declared.delivery is Delivery.BEST_EFFORT or node not in reports:
            return {}
        values = {key: int(n) for key, n in reports[node].values.items() if key.startswith((*LOSSES, "in."))}
        found = {}
        for publisher, topics in declared.subscribes.items():
            if publisher not in reports or not self._restarts[node] + self._restarts[publisher]:
                continue
            for topic in set(topics) - {DIAGNOSTICS}:
                causes = (f"in.{topic}", f"dropped.lost {topic}", f"dropped.expired {topic}", "dropped.late")
                accounted = sum(values.get(cause, 0) for cause in causes)
                missing = int(reports[publisher].values.get(f"count.{topic}", 0)) - accounted
                if missing > 0:
                    found[f"dropped.away {topic}"] = str(missing)
        return found


def losses(diagnostics: Diagnostics, *kinds: str) -> str:
    """The nonzero counts of a node whose names begin with ``kinds``, as a text; empty if there are none."""
    values = diagnostics.values.items()
    return ", ".join(f"{key} {n}" for key, n in values if key.startswith(kinds) and n != "0")


def write_health(
    directory: Path, required: Sequence[str], supervisor: Supervisor, diagnostics: Mapping[str, Diagnostics]
) -> None:
    """Write ``health.json``, the state of a run, for monitoring a machine without a screen.

    The file is in the directory of the sockets and is replaced atomically once a second. Readers check its age first: a
    file older than a few seconds is no longer written. It is ``ok`` if all ``required`` nodes are running. A full disk,
    like any other OSError, is ignored.
    """
    nodes = {name: _node(name, supervisor, diagnostics.get(name)) for name in supervisor.children}
    health = {
        "time": time.time(),
        "pid": os.getpid(),
        "ok": all(nodes[name]["state"] == "running" for name in required),
        "nodes": nodes,
    }
    unfinished = directory / f".{HEALTH_FILE}.{os.getpid()}"
    with suppress(OSError):
        unfinished.write_text(json.dumps(health, indent=1) + "\n")
        unfinished.replace(directory / HEALTH_FILE)


def _node(name: str, supervisor: Supervisor, latest: Diagnostics | None) -> dict[str, Any]:
    child = supervisor.children[name]
    status: dict[str, Any] = {"state": child.state, "restarts": child.restarts, "silent_s": round(child.silent_s, 1)}
    if child.state == "running" and latest is not None:
        values, stream = latest.values, NODES[name].stream
        status |= {
            "state": values.get("state", child.state).partition(" ")[0],
            "level": Level(latest.level).name,
            "message": latest.message,
            "memory_mb": float(values.get("memory_mb", 0)),
        }
        if stream and f"rate.{stream}" in values:
            status["rate_hz"] = float(values[f"rate.{stream}"])
        if "latency_ms.p99" in values:
            status["latency_p99_ms"] = float(values["latency_ms.p99"])
    elif child.state == "running":
        status["state"] = "starting"
    return status
