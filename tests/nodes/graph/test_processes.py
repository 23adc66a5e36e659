import itertools
import os
import re
import signal
import socket
from pathlib import Path
from typing import Any

import pytest
import runs
from conftest import record, until, walk
from runs import INPUT_ALONE, Run

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.sources.pose_input import LOOP_PAUSE_NS

pytestmark = pytest.mark.slow
start, recording = runs.start, runs.recording


def poses_recorded(directory: Path) -> bool:
    """Whether a recording in the making has grown beyond its header."""
    files = list(directory.glob("*.mcap"))
    return bool(files) and files[0].stat().st_size > 50_000


def test_from_a_recording_to_a_recording_though_the_prior_is_killed_on_the_way(start: Any, tmp_path: Path) -> None:
    record(tmp_path / "in", walk(150))
    run: Run = start("--input", str(tmp_path / "in"), "--record", str(tmp_path / "out"))
    until(lambda: poses_recorded(tmp_path / "out"), timeout_s=240)
    os.kill(run.pid("prior"), signal.SIGKILL)
    status, output = run.wait()
    assert status == 0, output
    assert "prior: ended with SIGKILL; starting it again" in output
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.complete
        assert reader.count(POSE_RAW) == 151, "the recorder heard every frame"
        assert reader.count(POSE_CLEAN) == reader.count(POSE_WORLD) == 151, "each once"
        for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD):
            *_, last = reader.messages([topic])
            assert isinstance(last.message, PoseRaw | PoseClean | PoseWorld)
            assert last.message.end_of_stream


@pytest.fixture
def recorded(start: Any, recording: Path, tmp_path: Path) -> tuple[Run, list[int]]:
    """A run without end of an input and a recorder, which has poses by now, and the ids of their processes."""
    where = ("--input", str(recording), "--record", str(tmp_path / "out"), "--loop")
    run: Run = start(*where, *INPUT_ALONE)
    until(lambda: poses_recorded(tmp_path / "out"), timeout_s=120)
    return run, [run.pid(name) for name in ("pose_input", "recorder")]


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_a_signal_ends_all_and_completes_the_recording(recorded: tuple[Run, list[int]], tmp_path: Path, asked: int):
    run, nodes = recorded
    run.process.send_signal(asked)
    status, output = run.wait()
    assert status == (-asked if asked == signal.SIGKILL else 0), output
    if asked != signal.SIGKILL:
        assert not [pid for pid in nodes if Path(f"/proc/{pid}").exists()]
        assert (tmp_path / "out/metadata.yaml").exists(), "the recorder was stopped, not killed"
    until(lambda: not any(works(pid) for pid in nodes))
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.complete


def works(pid: int) -> bool:
    """Whether a process works still; one that ended and that nobody has asked about does not."""
    try:
        return ") Z" not in Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False


def test_a_node_that_cannot_start_ends_the_run(start: Any, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    taken = ("--set", f"transport.endpoints.pose_input=ipc://{tmp_path}/file")
    run: Run = start("--input", str(recording), *INPUT_ALONE, *taken)
    status, output = run.wait()
    assert status == 1
    assert "expected no file there" in output
    assert "Traceback" not in output


def test_the_recorder_is_killed_and_goes_on_in_the_next_part(start: Any, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run: Run = start("--input", str(recording), "--record", str(out), "--loop", *INPUT_ALONE)
    for part in range(3):
        run.until_running("recorder")
        file = out / f"out_{part}.mcap"
        until(lambda: file.exists() and file.stat().st_size > 20_000, timeout_s=30)  # noqa: B023
        if part < 2:
            run.kill("recorder")
    status, output = run.end()
    assert status == 0, output
    with RecordingReader(out) as reader:
        stamps = [message.stamp_ns for _, _, message in reader.messages([POSE_RAW])]
    assert stamps == sorted(set(stamps)), "none twice"
    within = [b - a for a, b in itertools.pairwise(stamps) if b - a < LOOP_PAUSE_NS]
    assert max(within) < 50_000_000, "none lost"


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
    run: Run = start("--input", str(recording), "--loop", *INPUT_ALONE)
    run.until_running("pose_input")
    os.kill(run.pid("pose_input"), signal.SIGSTOP)
    until(lambda: run.node("pose_input")["state"] == "stale", timeout_s=30)
    assert "rate_hz" not in run.node("pose_input"), "what it reported before does not hold"
    until(lambda: run.node("pose_input")["restarts"] == 1, timeout_s=30)
    run.until_running("pose_input")
    assert run.end()[0] == 0


def test_an_input_that_is_killed_goes_on_where_it_was(start: Any, tmp_path: Path) -> None:
    frames = walk(150)
    record(tmp_path / "in", frames)
    out = tmp_path / "out"
    run: Run = start("--input", str(tmp_path / "in"), "--record", str(out), *INPUT_ALONE)
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


CAMERA = """
import itertools, os
import numpy as np
from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.nodes.sources.source import LiveSource

class Camera(LiveSource):
    def __init__(self, clock):
        super().__init__()
        self.clock = clock

    def frames(self):  # of which each says whose it is, and its number
        for number in itertools.count():
            self.clock.sleep(10**9 // 100)
            body = RawBody(number, np.zeros((22, 3)), np.ones(22))
            yield PoseRaw(self.clock.now_ns(), str(os.getpid()), "camera", "smpl22", Pose.identity(), True, [body])

    def status(self):
        return {}

def open_camera(options, context):
    return Camera(context.clock)
"""


def test_a_camera_whose_process_is_killed(start: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "acme.py").write_text(CAMERA)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    out = tmp_path / "out/out_0.mcap"
    live = ("--set", "transport.lossless=false", "--set", "input.source=acme:open_camera")
    run: Run = start("--record", str(tmp_path / "out"), *INPUT_ALONE, *live)
    until(lambda: poses_recorded(tmp_path / "out"), timeout_s=60)
    run.kill("pose_input")
    size = out.stat().st_size
    until(lambda: out.stat().st_size > 2 * size, timeout_s=60)
    _, output = run.end()
    with RecordingReader(tmp_path / "out") as reader:
        frames = [m for _, _, m in reader.messages([POSE_RAW]) if isinstance(m, PoseRaw) and m.bodies]
    first, second = ([m.bodies[0].id for m in of] for _, of in itertools.groupby(frames, lambda m: m.frame_id))
    assert second[0] < first[-1] / 2, "heard at once, not after as many frames as before"
    row = re.search(r"pose_input +ended +(\d+) +([\d.]+)", output)
    assert row, output
    assert len(frames) <= int(row[1]) <= len(frames) + first[-1] / 2, "each frame is counted once"
    assert 20.0 < float(row[2]) <= 100.0, "the rate is of its own frames in its own time"


def test_systemd_is_told_when_all_are_ready_and_that_they_live(folder: Path, recording: Path, start: Any, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(folder / "notify"))
        systemd.settimeout(120)
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))
        run: Run = start("--input", str(recording), "--loop", *INPUT_ALONE)
        states: list[str] = []
        while "READY=1" not in states[:-3]:
            states.append(systemd.recv(64).decode())
        assert run.end()[0] == 0
    assert states.count("READY=1") == 1, "once, by the run and not by its nodes"
    assert states[-1] == "WATCHDOG=1"
