import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from types import SimpleNamespace as Made
from typing import Any

import pytest
from conftest import VirtualClock
from rich.console import Console

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.commands.run import STALL_NS, _Run, lines, table
from steadypose.nodes.graph import supervisor
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import RUN
from steadypose.nodes.graph.supervisor import BACKOFF_S, HUNG_S, STALE_S, STEADY_S, TRIES, Child, Supervisor

pytestmark = pytest.mark.slow

FOREVER = "import signal; signal.pause()"
Start = Callable[[str], Child]


@pytest.fixture
def log() -> list[str]:
    return []


@pytest.fixture
def start(clock: VirtualClock, log: list[str]) -> Iterator[Start]:
    with ExitStack() as children:

        def start(code: str) -> Child:
            child = Child("prior", [sys.executable, "-c", code], clock, log.append)
            children.callback(child.stop)
            return child

        yield start


def ended(child: Child) -> None:
    child._process.wait(30)
    child.poll()


def later(child: Child, clock: VirtualClock, seconds: float) -> None:
    clock.time_ns += round(seconds * 1e9)
    child.poll()


@pytest.mark.parametrize(("status", "state"), [(0, "ended"), (2, "failed")])
def test_a_node_that_has_nothing_more_to_do_is_not_started_again(start: Start, status: int, state: str) -> None:
    child = start(f"raise SystemExit({status})")
    ended(child)
    assert (child.state, child.restarts) == (state, 0)


def test_a_node_that_crashes_starts_again_a_little_later_each_time(start: Start, clock: VirtualClock, log: list[str]):
    child = start("raise SystemExit(7)")
    child.heard()
    for restarts, pause_s in enumerate([*BACKOFF_S, BACKOFF_S[-1], BACKOFF_S[-1]]):
        ended(child)
        if pause_s:  # else it runs by now
            assert child.state == "crashed"
            later(child, clock, pause_s - 0.01)
            assert (child.state, child.restarts) == ("crashed", restarts)
            later(child, clock, 0.02)
        assert (child.state, child.restarts) == ("running", restarts + 1)
    ended(child)
    assert child.state == "crashed", "there is no last time"
    assert log[:2] == [f"prior: ended with status 7; starting it again in {pause} s" for pause in ("0", "0.5")]


def test_a_node_never_heard_has_failed_at_last_and_one_that_ran_gets_new_chances(start: Start, clock: VirtualClock):
    child, heard = start("raise SystemExit(7)"), start("raise SystemExit(7)")
    for crashes in range(1, TRIES):
        ended(child)
        assert child.state == ("running" if crashes == 1 else "crashed")
        later(child, clock, BACKOFF_S[-1])
    ended(child)
    assert child.state == "failed"
    heard.heard()
    for _ in range(2 * len(BACKOFF_S)):
        clock.time_ns += round((STEADY_S + 1) * 1e9)
        ended(heard)
        assert heard.state == "running", "again, and at once"


def test_a_node_that_falls_silent_is_killed_and_started_again(start: Start, clock: VirtualClock, log: list[str]):
    child = start(FOREVER)
    later(child, clock, 2 * HUNG_S)
    assert child.state == "running", "the first start may take long"
    child.heard()
    later(child, clock, STALE_S + 0.1)
    assert child.state == "stale"
    child.heard()
    assert child.state == "running"
    later(child, clock, HUNG_S + 0.1)
    assert "killing it" in log[0]
    assert (child.state, child.restarts, child.silent_s) == ("running", 1, 0.0)


def test_a_supervisor_that_was_away_blames_nobody(clock: VirtualClock, log: list[str], monkeypatch) -> None:
    monkeypatch.setattr(supervisor, "COMMAND", (sys.executable, "-c", FOREVER))
    with Supervisor(["prior"], [], clock, log.append) as processes:
        child = processes.children["prior"]
        child.heard()
        clock.time_ns += round(HUNG_S * 2e9)
        processes.poll()
        assert child.state == "running"


class Processes:
    """In a supervisor's place: children that are in whatever state the test says."""

    def __init__(self, *names: str) -> None:
        self.children = {n: Made(restarts=0, state="running", reports=True, heard=lambda: None) for n in names}
        self.failed: list[str] = []


def news(node: str, ended: str = "", level: Level = Level.OK, **values: str) -> tuple[str, Diagnostics]:
    named = {key.replace("__", ".", 1).replace("__", "/"): value for key, value in values.items()}
    return "diagnostics", Diagnostics(1, node, level, "", {"state": "running", "ended": ended, **named})


@pytest.fixture
def watched(clock: VirtualClock, make_launch: Callable[..., Launch]) -> tuple[_Run, Any]:
    launch = make_launch(nodes=str(NODES).replace("'", '"'))
    return _Run(launch, [], Console(quiet=True), clock, "", True), Processes(*NODES)


NODES = ["pose_input", "prior", "trajectory", "recorder"]


def test_a_run_is_over_when_its_end_is_recorded_also_by_a_recorder_that_was_killed(watched: tuple[_Run, Any]) -> None:
    run, processes = watched
    assert run._exit_status(processes) is None
    processes.children["pose_input"].state = "ended"
    for name in NODES:
        assert run._exit_status(processes) is None, f"{name} has not heard it yet"
        run._receive(news(name, f"{POSE_CLEAN} {POSE_RAW} {POSE_WORLD}"), processes)
    recorder = processes.children["recorder"]
    recorder.restarts, recorder.reports = 1, False
    assert run._exit_status(processes) is None, "another one is to complete the file"
    recorder.reports = True
    run._receive(news("recorder"), processes)
    assert run._exit_status(processes) == 0


def test_a_run_whose_end_got_lost_does_not_wait_forever(watched: tuple[_Run, Any], clock: VirtualClock) -> None:
    run, processes = watched
    processes.children["pose_input"].state = "ended"
    for _ in range(3):
        clock.time_ns += STALL_NS
        run._receive(news("prior", count__pose=str(clock.time_ns)), processes)
        assert run._exit_status(processes) is None, "it is still at work"
    clock.time_ns += STALL_NS + 1
    run._receive(news("prior", count__pose=run._diagnostics["prior"].values["count.pose"]), processes)
    assert run._exit_status(processes) == 1


def test_what_was_lost_on_the_way_is_no_success(watched: tuple[_Run, Any]) -> None:
    run, processes = watched
    for restarts, lost in enumerate("030"):
        processes.children["prior"].restarts = restarts // 2
        values: Any = {"dropped.lost pose/raw": lost}
        run._receive(news("prior", **values), processes)
        assert run._not_through() == ("prior: dropped.lost pose/raw 3" if restarts else "")


def test_what_another_runs_nodes_say_is_not_believed(clock: VirtualClock, make_launch: Callable[..., Launch]) -> None:
    run = _Run(make_launch(nodes='["prior"]'), [], Console(quiet=True), clock, "this", True)
    processes: Any = Processes("prior")
    for identity in ("another", ""):
        topic, message = news("prior")
        message.values[RUN] = identity
        run._receive((topic, message), processes)
    assert not run._diagnostics
    message.values[RUN] = "this"
    run._receive((topic, message), processes)
    assert run._diagnostics["prior"].values[RUN] == "this"


def shown(diagnostics: dict[str, Diagnostics], width: int) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table(NODES, diagnostics, Processes(*NODES), width))  # type: ignore[arg-type]
    return capture.get()


def test_the_table_and_the_line_show_what_there_is_to_see() -> None:
    messages = [
        news("pose_input", rate__pose__raw="30.04", count__pose__raw="300"),
        news(
            "prior", level=Level.WARN, bodies="2", anomalies="1", delay_frames="4", refused__unknown_skeleton="5",
            latency_ms__p50="3.14", latency_ms__p99="9.87", rate__pose__clean="29.98",
        ),
    ]  # fmt: skip
    latest = {message.node: message for _, message in messages}
    for text in ("30.0", "3.1/9.9", "133", "unknown_skeleton 5", "flagged", "starting"):
        assert text in shown(latest, 140)
    assert "restarts" not in shown(latest, 140), "nothing to say there"
    printed = lines(NODES, latest, Processes(*NODES))  # type: ignore[arg-type]
    assert any("pose/clean 30.0 Hz, latency p50/p99 3.1/9.9 ms, 0 dropped, 5 refused" in line for line in printed)
    assert len(printed) > 1
    assert max(map(len, printed)) <= 80
    assert all(line.startswith("  ") for line in printed[1:])


def test_the_table_leaves_out_what_does_not_fit_into_a_terminal() -> None:
    keys = ("latency_ms__p50", "latency_ms__p99", "compute_ms__p50", "compute_ms__p99", "delay_frames", "bodies")
    values: Any = dict.fromkeys((*keys, "queue", "memory_mb", "rate__pose__clean", "count__pose__clean"), "123456.7")
    values |= {"in__pose__raw": "7654321", "dropped__late": "321", "refused__units": "123", "delay_frames": "4"}
    latest = {message.node: message for _, message in [news("prior", **values)]}
    for width, left_out in ((200, ()), (80, ("in", "queue", "MB"))):
        words = shown(latest, width)
        assert "\u2026" not in words, "nothing is cut"
        for column in ("in", "queue", "MB", "latency", "dropped", "refused"):
            assert (column in words.split()) == (column not in left_out)


def test_what_goes_wrong_is_printed_when_it_does(make_launch: Callable[..., Launch], clock: VirtualClock) -> None:
    console = Console(width=140, record=True)
    run = _Run(make_launch(nodes='["prior"]'), [], console, clock, "", True)
    processes: Any = Processes("prior")
    for _ in range(2):
        run._receive(news("prior", level=Level.ERROR, problem__stamps_zero="stamp is 0: expected more"), processes)
    assert "stamps_zero" in lines(["prior"], run._diagnostics, processes)[0]
    run._receive(news("prior"), processes)
    assert console.export_text().splitlines() == [
        "prior: ERROR: stamp is 0: expected more [stamps_zero]",
        "prior: no longer: stamps_zero",
    ]


def test_without_a_terminal_lines_come_every_five_seconds_and_after_a_minute_every_minute(
    make_launch: Callable[..., Launch], clock: VirtualClock
) -> None:
    console = Console(width=140, record=True)
    run = _Run(make_launch(nodes='["prior"]'), [], console, clock, "", True)
    run._receive(news("prior"), Processes("prior"))  # type: ignore[arg-type]
    printed = []
    for second in range(1, 301):
        clock.time_ns += 10**9
        run._show(Processes("prior"), None)  # type: ignore[arg-type]
        if console.export_text():
            printed.append(second)
    assert printed == [*range(5, 60, 5), 115, 175, 235, 295]
