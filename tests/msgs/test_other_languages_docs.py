"""The programs of docs/other_languages.md run as they are printed, without anything of steadypose."""

import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.helpers.msg_strategies import world

from steadypose.msgs.codec import encode
from steadypose.msgs.delivery import PREFIX, VERSION
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import PoseRaw

PAGE = Path(__file__).parents[2] / "docs" / "other_languages.md"
SUBSCRIBER, PUBLISHER = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
CPP = re.search(r"^```cpp\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
SOON_S = 30.0


@contextmanager
def running(code: str, address: str, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    program = tmp_path / "program.py"
    program.write_text("import sys; sys.modules['steadypose'] = sys.modules['numpy'] = None\n" + code)
    with subprocess.Popen([sys.executable, program, address], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def test_the_subscriber_reads_every_field_up_to_a_wrist(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/trajectory"
    with Publisher(address) as publisher, running(SUBSCRIBER, address, tmp_path) as process:
        assert process.stdout
        deadline = time.monotonic() + SOON_S
        while not select.select([process.stdout], [], [], 0.01)[0]:
            assert time.monotonic() < deadline, "it printed nothing"
            publisher.publish(POSE_WORLD, world())
        assert process.stdout.readline().split(" ", 1)[1] == "7 (63.0, 64.0, 65.0) 3\n"


def test_the_publishers_frames_arrive(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/pose_input"
    with Subscriber(address, POSE_RAW) as subscriber, running(PUBLISHER, address, tmp_path):
        received = subscriber.receive(SOON_S)
        again = subscriber.receive(SOON_S)
    assert received
    assert again
    message = received[1]
    assert isinstance(message, PoseRaw)
    assert (message.source, message.skeleton, message.frame_id) == ("my tracker", "smpl22", "camera")
    (body,) = message.bodies
    assert (body.id, body.positions.shape, body.confidence.sum()) == (7, (22, 3), 22)
    assert not subscriber.refused
    assert not subscriber.dropped


@pytest.mark.skipif(
    shutil.which("g++") is None, reason="needs g++, which no Python package brings: install a C++ compiler"
)
def test_the_cpp_program_reads_what_the_python_program_does(tmp_path: Path) -> None:
    assert CPP
    (tmp_path / "program.cpp").write_text(CPP[1])
    strict = ("-std=c++17", "-Wall", "-Werror", "-Wno-unused-variable", "-Wno-unused-but-set-variable")
    subprocess.run(["g++", *strict, "program.cpp"], cwd=tmp_path, check=True)
    frame = b"pose/world\0" + PREFIX.pack(VERSION, 5, 12, 0) + encode(world())
    printed = subprocess.run(["./a.out"], cwd=tmp_path, input=frame, capture_output=True, check=True)
    assert printed.stdout == b"12 7 (63, 64, 65) 3\n"
