"""Nodes as processes: started, watched, started again when they crash or fall silent, stopped in order."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence

from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.node import RUN, SUPERVISOR
from steadypose.nodes.graph.process import own_command, own_environment
from steadypose.nodes.graph.topology import NODES

BACKOFF_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
"""pauses before successive restarts; the last one repeats"""
STEADY_S = 10.0
"""after running for so long, a node's next restart waits for the first pause again"""
TRIES = 6
"""of a node that was not heard once: then it has failed"""
STARTING_S = 600.0
"""until a node must be heard; the first start on a small machine compiles for minutes"""
STALE_S = 3.0
"""silence of a node, which reports once a second, after which its last report no longer counts"""
HUNG_S = 10.0
"""silence after which a node is killed and restarted"""
STOP_S = 5.0
"""between SIGTERM and SIGKILL"""
USAGE_ERROR = 2
"""exit status of a node that cannot do what its launch file says: if it never could, it never will"""
COMMAND = (*own_command("steadypose.nodes.cli:main"), "node")


class Child:
    """One node's process.

    Attributes:
        state: ``running``, ``stale`` (runs, but does not report), ``crashed`` (waiting for its restart), ``ended``, or
            ``failed``.
        restarts: their number.
    """

    def __init__(
        self, name: str, command: Sequence[str], clock: Clock, log: Callable[[str], None], run: str = ""
    ) -> None:
        self.name = name
        self.state = "ended"
        self.restarts = 0
        self._command = command
        self._run = run
        self._clock = clock
        self._log = log
        self._crashes = 0
        self._was_heard = False
        self._start()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def silent_s(self) -> float:
        """Since when it was not heard; 0 for one that does not run, or that is only starting."""
        if self.state not in ("running", "stale") or self._heard_ns is None:
            return 0.0
        return (self._clock.monotonic_ns() - self._heard_ns) / 1e9

    @property
    def reports(self) -> bool:
        """Whether it runs, and was heard since it was started."""
        return self.state == "running" and self._heard_ns is not None

    def heard(self) -> None:
        """Note a report of the node."""
        if self.state in ("running", "stale"):
            self._heard_ns = self._clock.monotonic_ns()
            self._was_heard = True
            self.state = "running"

    def excuse(self) -> None:
        """Who listens was away: silence begins to count from now."""
        if self._heard_ns is not None:
            self._heard_ns = self._clock.monotonic_ns()

    def poll(self) -> None:
        """Check the process, and restart it when that is due."""
        if self.state in ("running", "stale"):
            self._check()
        if self.state == "crashed" and self._clock.monotonic_ns() >= self._due_ns:
            self.restarts += 1
            self._start()

    def _check(self) -> None:
        now = self._clock.monotonic_ns()
        if (status := self._process.poll()) is not None:
            self._note_exit(status)
        elif self.silent_s > HUNG_S or (self._heard_ns is None and now - self._started_ns > STARTING_S * 1e9):
            self._log(f"{self.name}: was not heard for {HUNG_S if self._heard_ns else STARTING_S:g} s; killing it")
            self._process.kill()
            self._process.wait()
            self._note_exit(-signal.SIGKILL)
        elif self.silent_s > STALE_S:
            self.state = "stale"

    def _note_exit(self, status: int) -> None:
        if self._clock.monotonic_ns() - self._started_ns > STEADY_S * 1e9:
            self._crashes = 0
        self._crashes += 1
        if status == 0:
            self.state = "ended"
        elif not self._was_heard and (status == USAGE_ERROR or self._crashes >= TRIES):
            self.state = "failed"
        else:
            self.state = "crashed"
            pause_s = BACKOFF_S[min(self._crashes, len(BACKOFF_S)) - 1]
            self._due_ns = self._clock.monotonic_ns() + round(pause_s * 1e9)
            cause = signal.Signals(-status).name if status < 0 else f"status {status}"
            self._log(f"{self.name}: ended with {cause}; starting it again in {pause_s:g} s")

    def stop(self) -> None:
        """End the process, with SIGTERM first; returns when it is gone."""
        if self.state in ("running", "stale"):
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
            env=_environment(self._run),
            # Ctrl-C is for the supervisor, which stops its nodes in order
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()
        self._started_ns = self._clock.monotonic_ns()
        self._heard_ns: int | None = None
        self.state = "running"

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                self._log(line.rstrip())


def _environment(run: str) -> dict[str, str]:
    """Of a node: that of this process, which is its supervisor, less what systemd says to this process alone."""
    kept = own_environment()
    for said in ("NOTIFY_SOCKET", "WATCHDOG_USEC"):
        kept.pop(said, None)
    return kept | {SUPERVISOR: str(os.getpid()), RUN: run}


class Supervisor:
    """The nodes of a launch, each in a process. A context manager; leaving it stops them all."""

    def __init__(
        self,
        nodes: Sequence[str],
        arguments: Sequence[str],
        clock: Clock,
        log: Callable[[str], None],
        run: str = "",
    ) -> None:
        """Start the nodes.

        Args:
            nodes: their names.
            arguments: of ``steadypose node NAME``, the same for all.
            log: where a line from a node, or about it, goes; called from several threads.
            run: what tells this run's nodes from others', in their diagnostics.
        """
        self._clock = clock
        self._polled_ns = clock.monotonic_ns()
        self.children = {
            name: Child(name, [*COMMAND, name, *arguments], clock, log, run)
            for name in sorted(nodes, key=list(NODES).index, reverse=True)
        }

    def poll(self) -> None:
        """Check all nodes; to be called several times a second, after their reports are read."""
        before, self._polled_ns = self._polled_ns, self._clock.monotonic_ns()
        away = self._polled_ns - before > STALE_S * 1e9
        for child in self.children.values():
            if away:  # suspended, or starved: nobody listened
                child.excuse()
            child.poll()

    @property
    def failed(self) -> list[str]:
        """The nodes that will not run."""
        return [name for name, child in self.children.items() if child.state == "failed"]

    def stop(self) -> None:
        """Stop all nodes, the first of the stream first."""
        for name in sorted(self.children, key=list(NODES).index):
            self.children[name].stop()

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
