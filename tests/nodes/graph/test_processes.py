"""Real processes, broken on purpose: what is killed, stopped or in the way comes back, and nothing else stops."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import record, until, walk

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_RAW
from steadypose.nodes.graph.run_state import HEALTH_FILE
from steadypose.nodes.sources.pose_input import LOOP_PAUSE_NS

pytestmark = pytest.mark.slow


class Run:
    """`steadypose run` in a process, and what it says of itself.

    Args:
        folder: of its sockets.
        arguments: of the command.
        where: the working directory.
    """

    def __init__(self, folder: Path, *arguments: str, where: Path | None = None) -> None:
        self._health = folder / "steadypose" / HEALTH_FILE
        self._output = (folder / "output").open("w+")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "steadypose.nodes.cli", "run", *arguments],
            stdout=self._output,
            stderr=subprocess.STDOUT,
            # the command itself is started by a script of the environment, which does not look there either
            env=os.environ | {"XDG_RUNTIME_DIR": str(folder), "PYTHONSAFEPATH": "1"},
            cwd=where,
        )

    def nodes(self) -> dict[str, Any]:
        try:
            return json.loads(self._health.read_text())["nodes"]
        except FileNotFoundError:
            return {}

    def node(self, name: str) -> dict[str, Any]:
        return self.nodes().get(name, {"state": "unknown", "restarts": -1})

    def until_running(self, *names: str, timeout_s: float = 240.0) -> None:
        until(lambda: all(self.node(name)["state"] == "running" for name in names), timeout_s=timeout_s)

    def pid(self, name: str) -> int:
        for child in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split():
            if f"\0node\0{name}\0" in Path(f"/proc/{child}/cmdline").read_text():
                return int(child)
        raise AssertionError(f"{name} does not run")

    def kill(self, name: str, with_: signal.Signals = signal.SIGKILL) -> None:
        before = self.node(name)["restarts"]
        os.kill(self.pid(name), with_)
        until(lambda: self.node(name)["restarts"] > before, timeout_s=60)

    def end(self) -> tuple[int, str]:
        self.process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self, timeout_s: float = 240.0) -> tuple[int, str]:
        status = self.process.wait(timeout_s)
        self._output.seek(0)
        return status, self._output.read()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._output.close()


@pytest.fixture
def start(folder: Path) -> Iterator[Any]:
    runs: list[Run] = []

    def start(*arguments: str, where: Path | None = None) -> Run:
        runs.append(Run(folder, *arguments, where=where))
        return runs[-1]

    yield start
    for run in runs:
        run.close()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return record(tmp_path / "in", walk(90))


def test_the_recorder_is_killed_and_goes_on_in_the_next_part(start: Any, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run: Run = start(
        "--input", str(recording), "--record", str(out), "--loop", "--set", 'nodes=["pose_input"]',
        "--set", "recorder.free_mb=0",
    )  # fmt: skip
    for part in range(3):
        run.until_running("recorder")
        until(lambda: len(list(out.glob("*.mcap"))) == part + 1, timeout_s=30)  # noqa: B023
        file = out / f"out_{part}.mcap"
        until(lambda: file.stat().st_size > 20_000, timeout_s=30)  # noqa: B023
        if part < 2:
            run.kill("recorder")
    status, output = run.end()
    assert status == 0, output
    with RecordingReader(out) as reader:
        stamps = [message.stamp_ns for _, _, message in reader.messages([POSE_RAW])]
    assert stamps == sorted(set(stamps)), "none twice"
    within = [b - a for a, b in itertools.pairwise(stamps) if b - a < LOOP_PAUSE_NS]
    assert max(within) < 50_000_000, "none lost"
    assert all((out / f"out_{part}.mcap").stat().st_size > 20_000 for part in range(3))


def test_a_run_outlives_its_nodes_however_often_they_are_killed(start: Any, recording: Path) -> None:
    run: Run = start("--input", str(recording), "--loop", "--set", 'nodes=["pose_input", "trajectory"]')
    run.until_running("pose_input")
    until(lambda: run.node("trajectory")["state"] in ("running", "waiting"), timeout_s=120)
    for _ in range(7):
        run.kill("trajectory")
    until(lambda: run.node("trajectory")["state"] == "running", timeout_s=60)
    assert run.node("trajectory")["restarts"] == 7
    assert run.node("pose_input")["restarts"] == 0
    assert run.end()[0] == 0


def test_a_node_that_hangs_is_noticed_and_started_again(start: Any, recording: Path) -> None:
    run: Run = start("--input", str(recording), "--loop", "--set", 'nodes=["pose_input"]')
    run.until_running("pose_input")
    os.kill(run.pid("pose_input"), signal.SIGSTOP)
    until(lambda: run.node("pose_input")["state"] == "stale", timeout_s=30)
    assert "rate_hz" not in run.node("pose_input"), "what it said before does not hold"
    until(lambda: run.node("pose_input")["restarts"] == 1, timeout_s=30)
    run.until_running("pose_input")
    assert run.end()[0] == 0


def test_an_input_that_is_killed_goes_on_where_it_was(start: Any, tmp_path: Path) -> None:
    frames = walk(150)
    record(tmp_path / "in", frames)
    out = tmp_path / "out"
    run: Run = start(
        "--input", str(tmp_path / "in"), "--record", str(out), "--set", 'nodes=["pose_input"]',
        "--set", "recorder.free_mb=0",
    )  # fmt: skip
    run.until_running("recorder")
    until(lambda: sum(file.stat().st_size for file in out.glob("*.mcap")) > 30_000, timeout_s=30)
    run.kill("pose_input")
    status, output = run.wait()
    assert status == 0, output
    with RecordingReader(out) as reader:
        stamps = [message.stamp_ns for _, _, message in reader.messages([POSE_RAW])]
    assert stamps == sorted(set(stamps[:-1])) + stamps[-1:], "none twice, none back, but for the mark of the end"
    assert len(stamps) == 151, "not one went with the process"
    assert stamps[-1] == frames[-1].stamp_ns


def test_modules_in_the_working_directory_are_nobodys_business(start: Any, recording: Path, tmp_path: Path) -> None:
    where = tmp_path / "where"
    where.mkdir()
    for name in ("zmq", "numpy", "socket"):
        (where / f"{name}.py").write_text(f"open({str(tmp_path / 'was run')!r}, 'w')\nraise SystemExit(3)\n")
    run: Run = start("--input", str(recording), "--set", 'nodes=["pose_input"]', where=where)
    status, output = run.wait()
    assert status == 0, output
    assert not (tmp_path / "was run").exists()


def test_systemd_is_told_when_all_are_ready_and_that_they_live(
    folder: Path, recording: Path, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(folder / "notify"))
        systemd.settimeout(120)
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))
        run: Run = start("--input", str(recording), "--loop", "--set", 'nodes=["pose_input"]')
        told: list[str] = []
        while "READY=1" not in told[:-3]:
            told.append(systemd.recv(64).decode())
        assert run.end()[0] == 0
    assert told.count("READY=1") == 1, "once, by the run and not by its nodes"
    assert told[-1] == "WATCHDOG=1"
