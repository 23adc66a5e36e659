"""The programs of docs/subscribe.md and docs/other_languages.md run as they are printed; the latter without anything of
steadypose."""

import os
import re
import select
import shutil
import subprocess
import time
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
from tests.helpers.msg_strategies import raw, world
from tests.helpers.processes import another_python

from steadypose.msgs.codec import encode
from steadypose.msgs.delivery import PREFIX, VERSION
from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import PoseRaw

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"
SOON_S = 30.0


def programs(page: str, language: str = "python") -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)


SUBSCRIBER, PUBLISHER, READER = programs("subscribe.md")
FOREIGN_SUBSCRIBER, FOREIGN_PUBLISHER = (
    "import sys; sys.modules['steadypose'] = sys.modules['numpy'] = None\n" + code
    for code in programs("other_languages.md")
)


def running(code: str, tmp_path: Path, *arguments: str) -> AbstractContextManager[subprocess.Popen[str]]:
    environment = os.environ | {"XDG_RUNTIME_DIR": str(tmp_path)}
    return another_python(code, tmp_path, *arguments, environment=environment)


@pytest.mark.parametrize("code", [SUBSCRIBER, PUBLISHER, READER])
def test_they_are_short(code: str):
    assert len([line for line in code.splitlines() if line.strip()]) <= 12


@pytest.mark.parametrize(
    ("code", "printed"), [(SUBSCRIBER, "7 [63. 64. 65.] IMPUTED"), (FOREIGN_SUBSCRIBER, " 7 (63.0, 64.0, 65.0) 3")]
)
def test_a_subscriber_prints_a_wrist(code: str, printed: str, tmp_path: Path):
    address = f"ipc://{tmp_path}/steadypose/trajectory"
    with Publisher(address) as publisher, running(code, tmp_path, address) as process:
        assert process.stdout
        deadline = time.monotonic() + SOON_S
        while not select.select([process.stdout], [], [], 0.01)[0]:
            assert time.monotonic() < deadline, "it printed nothing"
            publisher.publish(POSE_WORLD, world())
        assert process.stdout.readline().endswith(f"{printed}\n")


def test_the_reader_reads(tmp_path: Path):
    with RecordingWriter(tmp_path / "recording") as writer:
        for second in range(3):
            writer.write(POSE_WORLD, world(second * 10**9), second * 10**9)
            writer.write(POSE_RAW, raw(second * 10**9), second * 10**9)
    with running(READER, tmp_path, str(tmp_path / "recording")) as process:
        printed, _ = process.communicate(timeout=SOON_S)
    assert printed.splitlines() == ["2.0 s of pose/raw pose/world", "1000000000 [0. 1. 2.]", "2000000000 [0. 1. 2.]"]


def test_the_publishers_frames_arrive(tmp_path: Path):
    address = f"ipc://{tmp_path}/pose_input"
    with Subscriber(address, POSE_RAW) as subscriber, running(FOREIGN_PUBLISHER, tmp_path, address):
        received, again = subscriber.receive(SOON_S), subscriber.receive(SOON_S)
    assert received
    assert again
    message = received[1]
    assert isinstance(message, PoseRaw)
    assert (message.source, message.skeleton, message.frame_id) == ("my tracker", "smpl22", "camera")
    (body,) = message.bodies
    assert (body.id, body.positions.shape, body.confidence.sum()) == (7, (22, 3), 22)
    assert not subscriber.refused
    assert not subscriber.dropped


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++: install a C++ compiler")
def test_the_cpp_program_reads_what_the_python_program_does(tmp_path: Path):
    (code,) = programs("other_languages.md", "cpp")
    (tmp_path / "program.cpp").write_text(code)
    strict = ("-std=c++17", "-Wall", "-Werror", "-Wno-unused-variable", "-Wno-unused-but-set-variable")
    subprocess.run(["g++", *strict, "program.cpp"], cwd=tmp_path, check=True)
    frame = b"pose/world\0" + PREFIX.pack(VERSION, 5, 12, 0) + encode(world())
    printed = subprocess.run(["./a.out"], cwd=tmp_path, input=frame, capture_output=True, check=True)
    assert printed.stdout == b"12 7 (63, 64, 65) 3\n"
