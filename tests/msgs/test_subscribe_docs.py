"""What the programs of docs/subscribe.md print; that the page runs as a whole, tests/test_docs.py says."""

import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.helpers.msg_strategies import raw, world

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, local_address

PAGE = Path(__file__).parents[2] / "docs" / "subscribe.md"
SUBSCRIBER, PUBLISHER, READER = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
SOON_S = 30.0


@contextmanager
def running(code: str, tmp_path: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    program = tmp_path / "program.py"
    program.write_text(code)
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    command = [sys.executable, program, *arguments]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("code", [SUBSCRIBER, PUBLISHER, READER])
def test_they_are_short(code: str):
    assert len([line for line in code.splitlines() if line.strip()]) <= 12


def test_the_subscriber_prints_a_wrist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Publisher(local_address("trajectory")) as publisher, running(SUBSCRIBER, tmp_path) as process:
        assert process.stdout
        deadline = time.monotonic() + SOON_S
        while not select.select([process.stdout], [], [], 0.01)[0]:
            assert time.monotonic() < deadline, "it printed nothing"
            publisher.publish(POSE_WORLD, world())
        assert process.stdout.readline() == "7 [63. 64. 65.] IMPUTED\n"


def test_the_reader_reads(tmp_path: Path):
    with RecordingWriter(tmp_path / "recording") as writer:
        for second in range(3):
            writer.write(POSE_WORLD, world(second * 10**9), second * 10**9)
            writer.write(POSE_RAW, raw(second * 10**9), second * 10**9)
    with running(READER, tmp_path, str(tmp_path / "recording")) as process:
        printed, _ = process.communicate(timeout=SOON_S)
    assert printed.splitlines() == [
        "2.0 s of pose/raw pose/world",
        "1000000000 [0. 1. 2.]",
        "2000000000 [0. 1. 2.]",
    ]
