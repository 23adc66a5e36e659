"""Runs nodes as processes: starts and monitors them, restarts them when they crash or hang, stops them in order."""

import os
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence

from steadypose.msgs import Closing
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.node import RUN, SUPERVISOR
from steadypose.nodes.graph.process import own_command, own_environment
from steadypose.nodes.graph.topology import NODES

BACKOFF_S = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)  # pauses before successive restarts, seconds; the last one repeats
STEADY_S = 10.0  # uptime after which the pauses start from the first again, seconds
TRIES = 6  # number of successive crashes after which a node that has never reported counts as failed
STARTING_S = 600.0
"""Longest time until a node's first report, seconds. The first start on a small machine compiles for minutes."""
STALE_S = 3.0
"""Time without a report after which a node's last report is outdated, seconds. Nodes report once a second."""
HUNG_S = 10.0  # time without a report after which a node is killed and restarted, seconds
STOP_S = 5.0  # time between SIGTERM and SIGKILL, seconds
USAGE_ERROR = 2
"""Exit status of a node whose launch file cannot work. It is not restarted if it has never reported."""
COMMAND = (*own_command("steadypose.nodes.cli:main"), "node")


class Child:
    """One node's process.

    Attributes:
        state: ``running``, ``stale`` (runs, but does not report), ``crashed`` (waiting for its restart), ``ended``, or
            ``failed``.
        restarts: number of restarts.
    """

    def __init__(
        self, name: str, command: Sequence[str], clock: Clock, log: Callable[[str], None], run: str = ""
    ) -> None:
        self.name = name
        self.state = "ended"
        self.restarts = self._crashes = 0
        self._command, self._run, self._clock, self._log = command, run, clock, log
        self._was_heard = False
        self._start()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def silent_s(self) -> float:
        """Time since the last report, seconds; 0 for a node that is not running or that is still starting."""
        if self.state not in ("running", "stale") or self._heard_ns is None:
            return 0.0
        return (self._clock.monotonic_ns() - self._heard_ns) / 1e9

    @property
    def reports(self) -> bool:
        """Whether the node runs and has reported since its last start."""
        return self.state == "running" and self._heard_ns is not None

    def heard(self) -> None:
        if self.state in ("running", "stale"):
            self._heard_ns = self._clock.monotonic_ns()
            self._was_heard = True
            self.state = "running"

    def excuse(self) -> None:
        """Restart the count of silence, because the supervisor itself was not listening."""
        if self._heard_ns is not None:
            self._heard_ns = self._clock.monotonic_ns()

    def poll(self) -> None:
        """Check the process, and restart it when a restart is due."""
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
            self._log(f"{self.name}: sent no report for {HUNG_S if self._heard_ns else STARTING_S:g} s; killing it")
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
        """Stop the process by SIGTERM, then SIGKILL; returns when it has exited."""
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
        self._reader.join(STOP_S)  # a child process that the node left behind may hold its output open

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
    """The environment of a node: this process's, without the variables that systemd addresses to the supervisor."""
    kept = own_environment()
    for variable in ("NOTIFY_SOCKET", "WATCHDOG_USEC"):
        kept.pop(variable, None)
    return kept | {SUPERVISOR: str(os.getpid()), RUN: run}


class Supervisor(Closing):
    """Runs the nodes of a launch, each in its own process. A context manager; leaving it stops all nodes."""

    def __init__(
        self, nodes: Sequence[str], arguments: Sequence[str], clock: Clock, log: Callable[[str], None], run: str = ""
    ) -> None:
        """Start ``steadypose node NAME`` with the same arguments for each of the nodes.

        ``log`` receives each line of a node's output and each message about a node; it is called from several threads.
        ``run`` identifies this run in its nodes' diagnostics.
        """
        self._clock = clock
        self._polled_ns = clock.monotonic_ns()
        self.children = {
            name: Child(name, [*COMMAND, name, *arguments], clock, log, run)
            for name in sorted(nodes, key=list(NODES).index, reverse=True)
        }

    def poll(self) -> None:
        """Check all nodes. Call it several times a second, after reading their reports."""
        before, self._polled_ns = self._polled_ns, self._clock.monotonic_ns()
        away = self._polled_ns - before > STALE_S * 1e9
        for child in self.children.values():
            if away:  # this process was suspended or starved, and read no reports
                child.excuse()
            child.poll()

    @property
    def failed(self) -> list[str]:
        """Names of the nodes that have failed and are not restarted."""
        return [name for name, child in self.children.items() if child.state == "failed"]

    def close(self) -> None:
        """Stop all nodes in the order of the stream, the source first."""
        for name in sorted(self.children, key=list(NODES).index):
            self.children[name].stop()
