"""``steadypose run``: a launch file's nodes as processes, and a live table of how they do."""

import dataclasses
import json
import secrets
import signal
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.live import Live

from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics
from steadypose.nodes.checks.problem import from_values
from steadypose.nodes.commands.run_table import lines, table
from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.graph.launch import Launch, in_launch_file
from steadypose.nodes.graph.loops import COMPILED, compile_missing
from steadypose.nodes.graph.node import RUN, WATCHER
from steadypose.nodes.graph.process import ALIVE, READY, STOPPING, notify, stop_on_signals
from steadypose.nodes.graph.run_state import HEALTH_FILE, LOSSES, Ledger, losses, run_lock, write_health
from steadypose.nodes.graph.supervisor import Supervisor
from steadypose.nodes.graph.topology import NODES, POSE_NODES, Delivery, load
from steadypose.nodes.settings import STREAMS, located, printable
from steadypose.nodes.sinks.recorder import RecorderSettings, free_directory
from steadypose.nodes.sources.recording import DAMAGE, VIDEOS

LINE_NS, LINE_LATER_NS = 5_000_000_000, 60_000_000_000
"""Between lines where there is no terminal for a table, in the first minute and later."""
REPORT_NS = 1_000_000_000  # between writes of the health file
REPLAY = "replay"
STALL_NS = 15_000_000_000
"""without progress after the source has ended, until the run is given up: a message was lost on the way"""


def run(
    launch: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[LAUNCH]")] = REPLAY,
    input: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None,
    rate: Annotated[float | None, tyro.conf.arg(metavar="X")] = None,
    loop: bool = False,
    record: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    view: bool = False,
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="SECTION.KEY=VALUE")] = (),
) -> int:
    """Clean poses live: start the nodes of a launch file, and show their state until the stream ends or Ctrl-C.

    The launch file names the source: a camera, a tracker or a recording. The clean poses go to whoever subscribes (try
    `steadypose echo pose/world`), to the recording and to the 3D view. A node that crashes or hangs is restarted. On a
    terminal, the 3D view stays open after the stream has ended.

    Try:
      steadypose run --view                           a bundled recording
      steadypose run --input take.npz --record take   your own
      steadypose run oak                              an OAK camera

    Args:
        launch: a launch file, or the name of a bundled one, such as replay, oak, ros2 or server.
        input: a recording, .npz or .csv to play instead of the launch file's input; or a video, in which MediaPipe
            detects people.
        rate: speed of playback, 1 for real time; 0 is as fast as possible.
        loop: repeat the input until Ctrl-C.
        record: record all topics to this folder.
        view: serve a 3D view for a browser, and print its address.
        settings: override a setting of the launch file. A unique end of its name is enough: delay=2. Repeatable.
    """
    overrides = in_launch_file(launch, settings)
    if input is not None and input.suffix.lower() in VIDEOS:
        launch = "webcam" if launch == REPLAY else launch
        overrides += ['input.source="webcam"', f"input.webcam.video={_toml(input.resolve())}"]
        overrides.append("transport.lossless=true")  # a video can wait
    elif input is not None:
        recording = located(str(input), Path.cwd(), STREAMS).resolve()
        overrides += ['input.source="recording"', f"input.recording={_toml(recording)}"]
    if rate is not None:
        overrides.append(f"input.rate={rate}")
    if loop:
        overrides.append("input.loop=true")
    if record is not None:
        overrides.append(f"recorder.directory={_toml(record.resolve())}")
    nodes = [*Launch.read(launch, overrides).nodes]
    nodes += [name for name, wanted in (("recorder", record), ("viewer", view)) if wanted and name not in nodes]
    overrides.append(f"nodes={json.dumps(nodes)}")
    settled = Launch.read(launch, overrides)
    # a log file has no width, and a table cut to 80 columns says little
    console = Console(width=None if sys.stdout.isatty() else 140)
    if "recorder" in nodes and (changed := free_directory(settled)):
        taken = Path(settled.settings(RecorderSettings).directory).name
        overrides.append(f"recorder.directory={_toml(changed)}")
        settled = Launch.read(launch, overrides)
        console.print(f"recording to {printable(f'{changed}: {taken}')} is there already", soft_wrap=True)
    _check(settled)
    arguments = ["--launch", launch]
    for override in overrides:
        arguments += ["--set", override]
    stop_on_signals(signal.default_int_handler)
    with run_lock(settled) as writes_health:
        if COMPILED & {*nodes}:
            compile_missing(lambda line: console.print(printable(line), markup=False, highlight=False, soft_wrap=True))
        return _Run(settled, arguments, console, Clock(), secrets.token_hex(8), writes_health).watch()


def _toml(path: Path) -> str:
    """A path as a TOML string: JSON's, but for what it escapes as two halves of one character."""
    return json.dumps(str(path), ensure_ascii=False).replace("\x7f", "\\u007f")


def _check(launch: Launch) -> None:
    """Find before any process starts what would stop one of them."""
    for name in launch.nodes:
        if extra := NODES[name].extra:
            require_extra(extra)
        if preflight := NODES[name].preflight:
            load(preflight)(launch)


class _Run:
    """One run: the processes, their diagnostics, and when it is over."""

    def __init__(
        self, launch: Launch, arguments: list[str], console: Console, clock: Clock, identity: str, writes_health: bool
    ) -> None:
        self._launch, self._arguments, self._console, self._clock = launch, arguments, console, clock
        self._id, self._writes_health = identity, writes_health
        self._diagnostics: dict[str, Diagnostics] = {}
        self._ledger = Ledger(launch)
        self._problems: dict[str, set[str]] = {}
        self._over = False
        waited_for = frozenset[str]().union(*map(launch.reliable_subscribers, POSE_NODES))
        self._required = {name for name in launch.nodes if not NODES[name].optional or name in waited_for}
        self._without: list[str] = []
        self._progress_ns = self._printed_ns = self._started_ns = clock.monotonic_ns()
        self._reported_ns = 0
        self._ready = False

    def watch(self) -> int:
        """Start the nodes and show their diagnostics until the stream has ended or Ctrl-C; returns the exit status."""
        transport = self._launch.transport
        transport.make_ipc_directory()
        keys = transport.curve_keys()
        if keys:  # the nodes are this machine's own, whoever else is subscribed to
            keys = dataclasses.replace(keys, server=keys.public)
        endpoints = [transport.endpoint(name) for name in self._launch.nodes]
        terminal = self._console.is_terminal
        with (
            Supervisor(self._launch.nodes, self._arguments, self._clock, self._print, self._id) as supervisor,
            Subscriber(endpoints, DIAGNOSTICS, keys=keys, clear_text=transport.clear_text, name=WATCHER) as subscriber,
            Live(console=self._console, auto_refresh=False, transient=True) if terminal else nullcontext() as live,
        ):
            status, interrupted = None, False
            try:
                while status is None:
                    received = subscriber.receive(POLL_S)
                    while received:
                        self._receive(received, supervisor)
                        received = subscriber.receive(0)
                    supervisor.poll()
                    self._show(supervisor, live)
                    self._report(supervisor)
                    status = self._exit_status(supervisor)
            except KeyboardInterrupt:
                status, interrupted = 0, True
            notify(STOPPING)
            supervisor.close()
            if self._writes_health:
                (transport.ipc_directory / HEALTH_FILE).unlink(missing_ok=True)
            while received := subscriber.receive(0):
                self._receive(received, supervisor)
        for name, diagnostics in self._diagnostics.items():
            values = diagnostics.values | self._ledger.away(name, self._diagnostics)
            self._diagnostics[name] = dataclasses.replace(diagnostics, values=values)
        with suppress(OSError):
            width = self._console.width
            self._console.print(table(self._launch.nodes, self._diagnostics, supervisor, width, summary=True))
        if unread := self._not_read():
            self._print(f"{unread}: the readable part of the input was played")
            status = status or 1
        if status == 0 and not interrupted and (lost := self._not_through()):
            self._print(f"not every frame went through: {lost}")
            status = 1
        if lost := self._not_recorded(supervisor):
            self._print(f"the recording is not complete: {lost}")
            status = status or 1
        return status

    def _report(self, supervisor: Supervisor) -> None:
        """Report the state once a second, to a file and to systemd."""
        if self._clock.monotonic_ns() - self._reported_ns < REPORT_NS:
            return
        self._reported_ns = self._clock.monotonic_ns()
        if self._writes_health:
            write_health(self._launch.transport.ipc_directory, sorted(self._required), supervisor, self._diagnostics)
        if not self._ready and all(name in self._diagnostics for name in self._required):
            self._ready = True
            notify(READY)
        notify(ALIVE)

    def _print(self, line: str) -> None:
        """Print a line. Where it cannot be written, because the disk is full or the terminal gone, poses go on."""
        try:
            self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)
        except BrokenPipeError:  # who read it wants no more
            raise
        except OSError:
            return

    def _receive(self, received: tuple[str, object], supervisor: Supervisor) -> None:
        diagnostics = received[1]
        if not isinstance(diagnostics, Diagnostics) or diagnostics.node not in supervisor.children:
            return
        if diagnostics.values.get(RUN, "") != self._id:  # of another run, or a node by itself, at the same address
            return
        supervisor.children[diagnostics.node].heard()
        last = self._diagnostics.get(diagnostics.node)
        if last is None or _counts(last) != _counts(diagnostics):
            self._progress_ns = self._clock.monotonic_ns()
        restarts = supervisor.children[diagnostics.node].restarts
        self._diagnostics[diagnostics.node] = self._ledger.note(diagnostics, restarts)
        self._print_problems(diagnostics)

    def _print_problems(self, diagnostics: Diagnostics) -> None:
        """Print what is newly wrong, and what no longer is."""
        problems = from_values(diagnostics.values)
        known = self._problems.get(diagnostics.node, set())
        for cause in sorted(problems.keys() - known):
            self._print(f"{diagnostics.node}: {diagnostics.level.name}: {problems[cause]} [{cause}]")
        for cause in sorted(known - problems.keys()):
            self._print(f"{diagnostics.node}: no longer: {cause}")
        self._problems[diagnostics.node] = set(problems)

    def _show(self, supervisor: Supervisor, live: Live | None) -> None:
        if live:
            with suppress(OSError):
                live.update(table(self._launch.nodes, self._diagnostics, supervisor, self._console.width), refresh=True)
            return
        now_ns = self._clock.monotonic_ns()
        if now_ns - self._printed_ns >= (LINE_NS if now_ns - self._started_ns < LINE_LATER_NS else LINE_LATER_NS):
            self._printed_ns = now_ns
            for text in lines(self._launch.nodes, self._diagnostics, supervisor):
                self._print(text)

    def _exit_status(self, supervisor: Supervisor) -> int | None:
        """The exit status, or None while there is something to wait for."""
        if required := [name for name in supervisor.failed if name in self._required]:
            self._print(f"{', '.join(required)} cannot run; stopping")
            return 1
        if without := [name for name in supervisor.failed if name not in self._without]:
            self._without += without
            self._print(f"{', '.join(without)} cannot run; going on without")
        source = supervisor.children.get("pose_input")
        if source is None or source.state != "ended":
            self._progress_ns = self._progress_ns if source else self._clock.monotonic_ns()
            return None
        if self._drained(supervisor):
            if not {"viewer", "web"} & {*self._launch.nodes} or not self._console.is_terminal:
                return 0
            if not self._over:
                self._over = True
                self._print("the stream has ended; the view stays open until Ctrl-C")
            return None
        if self._clock.monotonic_ns() - self._progress_ns > STALL_NS:
            self._print("the stream ended, but its end did not come through all nodes; see dropped and restarts")
            return 1
        return None

    def _not_recorded(self, supervisor: Supervisor) -> str:
        """What the recorder could not write; empty if it wrote all, or there is none."""
        if "recorder" not in supervisor.children:
            return ""
        if "recorder" in supervisor.failed:
            return "the recorder could not run"
        return losses(self._diagnostics["recorder"], *LOSSES) if "recorder" in self._diagnostics else ""

    def _not_through(self) -> str:
        """The losses of a launch that is to lose nothing, also of what could not be read; empty if none."""
        if not self._launch.transport.lossless:
            return ""
        found = {
            name: losses(diagnostics, *(LOSSES if name == "pose_input" else ("dropped.",)))
            for name, diagnostics in self._diagnostics.items()
            if NODES[name].delivery is not Delivery.BEST_EFFORT
        }
        return "; ".join(f"{name}: {lost}" for name, lost in found.items() if lost)

    def _not_read(self) -> str:
        """What of a recording could not be read, because it is damaged; empty if all could."""
        values = self._diagnostics["pose_input"].values if "pose_input" in self._diagnostics else {}
        unread = {key.removeprefix("refused."): n for key, n in values.items() if key.startswith("refused.")}
        return ", ".join(f"{cause}: {n}" for cause, n in unread.items() if cause.startswith(DAMAGE))

    def _drained(self, supervisor: Supervisor) -> bool:
        """Whether the end of the stream has come through every node, and the recorder is there to complete its file."""
        streams = {NODES[name].stream for name in self._launch.nodes}
        recorded = set(self._launch.settings(RecorderSettings).topics)
        for name in self._launch.nodes:
            declared = NODES[name]
            if declared.delivery is Delivery.BEST_EFFORT or name in self._without:
                continue
            seen = {*declared.topics, declared.stream}
            wanted = streams & (seen if name != "recorder" else seen & recorded) - {None}
            diagnostics = self._diagnostics.get(name)
            if name == "recorder" and not supervisor.children[name].reports:
                return False
            if diagnostics is None or not wanted <= set(diagnostics.values.get("ended", "").split()):
                return False
        return True


def _counts(diagnostics: Diagnostics) -> list[str]:
    return [value for key, value in diagnostics.values.items() if key.startswith("count.") or key == "ended"]
