"""`steadypose run` in a process of its own."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import record, until, walk

from steadypose.nodes.graph.run_state import HEALTH_FILE

INPUT_ALONE = ("--set", 'nodes=["pose_input"]', "--set", "recorder.free_mb=0")


class Run:
    def __init__(self, folder: Path, *arguments: str) -> None:
        self._health = folder / "steadypose" / HEALTH_FILE
        self._output = (folder / "output").open("w+")
        self.process = subprocess.Popen(
            [sys.executable, "-m", "steadypose.nodes.cli", "run", *arguments], stdout=self._output,
            stderr=subprocess.STDOUT, env=os.environ | {"XDG_RUNTIME_DIR": str(folder)},
        )  # fmt: skip

    def node(self, name: str) -> dict[str, Any]:
        nodes = json.loads(self._health.read_text())["nodes"] if self._health.exists() else {}
        return nodes.get(name, {"state": "unknown", "restarts": -1})

    def until_running(self, name: str) -> None:
        until(lambda: self.node(name)["state"] == "running", timeout_s=240)

    def pid(self, name: str) -> int:
        for child in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split():
            if f"\0node\0{name}\0" in Path(f"/proc/{child}/cmdline").read_text():
                return int(child)
        raise AssertionError(f"{name} does not run")

    def kill(self, name: str) -> None:
        before = self.node(name)["restarts"]
        os.kill(self.pid(name), signal.SIGKILL)
        until(lambda: self.node(name)["restarts"] > before, timeout_s=60)

    def end(self) -> tuple[int, str]:
        self.process.send_signal(signal.SIGINT)
        return self.wait()

    def wait(self) -> tuple[int, str]:
        status = self.process.wait(240)
        self._output.seek(0)
        return status, self._output.read()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._output.close()


@pytest.fixture
def start(folder: Path) -> Iterator[Callable[..., Run]]:
    """A function that starts a run, which ends with the test at the latest."""
    begun: list[Run] = []

    def start(*arguments: str, beside: bool = False) -> Run:
        where = folder
        if beside:  # its output goes elsewhere, its sockets to the same directory
            where = folder / "beside"
            where.mkdir()
            (where / "steadypose").symlink_to(folder / "steadypose")
        begun.append(Run(where, *arguments))
        return begun[-1]

    yield start
    for run in begun:
        run.close()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return record(tmp_path / "in", walk(90))
