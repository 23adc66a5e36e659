"""Nodes as processes: started, watched, started again when they crash, stopped in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence

from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.node import SUPERVISOR
from steadypose.nodes.graph.topology import NODES

BACKOFF_S = (0.5, 1.0, 2.0, 4.0, 8.0)
"""before each restart in a row; a node that crashes once more has failed"""
STEADY_S = 30.0
"""a node that ran for so long begins with the first pause again"""
STOP_S = 5.0
"""between SIGTERM and SIGKILL"""
USAGE_ERROR = 2
"""exit status of a node that cannot do what its launch file says: it will not the next time either"""
ORDER = tuple(NODES)
"""of stopping"""


class Child:
    """One node's process.

    Attributes:
        state: ``running``, ``crashed`` (and about to start again), ``ended``, or ``failed``.
        restarts: how often it was started again.
    """

    def __init__(self, name: str, command: Sequence[str], clock: Clock, log: Callable[[str], None]) -> None:
        self.name = name
        self.state = "ended"
        self.restarts = 0
        self._command = command
        self._clock = clock
        self._log = log
        self._crashes = 0
        self._start()

    def poll(self) -> None:
        """See whether the process is still there, and start it again when that is due."""
        if self.state == "crashed" and self._clock.now_ns() >= self._due_ns:
            self.restarts += 1
            self._start()
            return
        if self.state != "running" or (status := self._process.poll()) is None:
            return
        if self._clock.now_ns() - self._started_ns > STEADY_S * 1e9:
            self._crashes = 0
        self._crashes += 1
        if status == 0:
            self.state = "ended"
        elif status == USAGE_ERROR or self._crashes > len(BACKOFF_S):
            self.state = "failed"
        else:
            self.state = "crashed"
            pause_s = BACKOFF_S[self._crashes - 1]
            self._due_ns = self._clock.now_ns() + round(pause_s * 1e9)
            cause = signal.Signals(-status).name if status < 0 else f"status {status}"
            self._log(f"{self.name}: ended with {cause}; starting it again in {pause_s:g} s")

    def stop(self) -> None:
        """End the process, with SIGTERM first; returns when it is gone."""
        if self.state == "running":
            self._process.terminate()
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._log(f"{self.name}: did not stop within {STOP_S:g} s; killed")
                self._process.kill()
                self._process.wait()
        if self.state != "failed":
            self.state = "ended"
        self._reader.join(STOP_S)  # what the node left behind may still hold its output open

    def _start(self) -> None:
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=os.environ | {SUPERVISOR: str(os.getpid())},
            # Ctrl-C is for the supervisor, which stops its nodes in order
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()
        self._started_ns = self._clock.now_ns()
        self.state = "running"

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                self._log(line.rstrip())


class Supervisor:
    """The nodes of a launch, each in a process. A context manager; leaving it stops them all."""

    def __init__(
        self, nodes: Sequence[str], arguments: Sequence[str], clock: Clock, log: Callable[[str], None]
    ) -> None:
        """Start the nodes.

        Args:
            nodes: their names.
            arguments: of ``steadypose node NAME``, the same for all.
            log: where a line from a node, or about it, goes; called from several threads.
        """
        command = [sys.executable, "-m", "steadypose.nodes.cli", "node"]
        self.children = {
            name: Child(name, [*command, name, *arguments], clock, log)
            for name in sorted(nodes, key=ORDER.index, reverse=True)
        }

    def poll(self) -> None:
        for child in self.children.values():
            child.poll()

    @property
    def failed(self) -> list[str]:
        """The nodes that will not run."""
        return [name for name, child in self.children.items() if child.state == "failed"]

    def stop(self) -> None:
        """Stop all nodes, the first of the stream first."""
        for name in sorted(self.children, key=ORDER.index):
            self.children[name].stop()

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
