"""``health.json``: the state of a run, for monitoring a machine without a screen.

It lies in the directory of the sockets and is rewritten atomically once a second. Check its age first: a file older
than a few seconds is no longer written.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.graph.supervisor import Supervisor
from steadypose.nodes.graph.topology import NODES

NAME = "health.json"


def write_health(
    directory: Path,
    required: Sequence[str],
    supervisor: Supervisor,
    diagnostics: Mapping[str, Diagnostics],
) -> None:
    """Write the file. A full disk, like any other OSError, is ignored.

    Args:
        directory: of the sockets.
        required: nodes that ``ok`` demands to be running.
        supervisor: of the run.
        diagnostics: the latest of each node, by its name.
    """
    nodes = {name: _node(name, supervisor, diagnostics.get(name)) for name in supervisor.children}
    health = {
        "time": time.time(),
        "pid": os.getpid(),
        "ok": all(nodes[name]["state"] == "running" for name in required),
        "nodes": nodes,
    }
    unfinished = directory / f".{NAME}.{os.getpid()}"
    with suppress(OSError):
        unfinished.write_text(json.dumps(health, indent=1) + "\n")
        unfinished.replace(directory / NAME)


def _node(name: str, supervisor: Supervisor, latest: Diagnostics | None) -> dict[str, Any]:
    child = supervisor.children[name]
    known = child.state == "running" and latest is not None
    status: dict[str, Any] = {"state": child.state, "restarts": child.restarts, "silent_s": round(child.silent_s, 1)}
    if known and latest:
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
