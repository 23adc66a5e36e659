import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import runs
from conftest import record, running, until, walk
from runs import INPUT_ALONE, Run
from tests.prior.clean.test_pipeline import loops

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics
from steadypose.nodes.graph import loops as loops_module
from steadypose.nodes.graph import trajectory_node
from steadypose.nodes.graph.loops import _locked, compile_from_the_beginning, compile_from_the_end
from steadypose.nodes.graph.node import SUPERVISOR, WATCHER
from steadypose.nodes.graph.process import own_command, own_environment, stop_on_signals
from steadypose.nodes.graph.run_state import HEALTH_FILE, run_lock
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.recorder import free_directory
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.prior import loop_cache

pytestmark = pytest.mark.slow
start, recording = runs.start, runs.recording


def test_nohup_is_obeyed() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        stop_on_signals(signal.default_int_handler)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_loops_that_are_loaded_are_not_said_to_be_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    program = "import os, sys; os.write(int(sys.argv[1]), b'one\\ntwo\\nthree\\n')"
    monkeypatch.setattr(loops_module, "own_command", lambda _, part, pipe: [sys.executable, "-c", program, pipe])
    (folder,) = loop_cache.folders()
    folder.mkdir(parents=True)
    monkeypatch.setattr(loop_cache, "writable", lambda: folder)  # which is cached
    for name, loaded in (("", "3 loops"), ("two", "2 loops, loaded 1")):
        if name:
            (folder / name).touch()
        (folder / loop_cache.COMPLETE).unlink(missing_ok=True)
        lines: list[str] = []
        loops_module.compile_missing(lines.append)
        assert ("has changed" in lines[0]) == bool(name)
        assert lines[-1].startswith(f"compiled {loaded} in ")


def test_a_second_run_is_refused_and_the_first_is_left_alone(start: Any, recording: Path, folder: Path) -> None:
    first: Run = start("--input", str(recording), "--loop", *INPUT_ALONE)
    first.until_running("pose_input")
    second: Run = start("--input", str(recording), *INPUT_ALONE, beside=True)
    status, output = second.wait()
    assert status == 2
    assert f"pose_input runs already at ipc://{folder}" in output.replace("/beside", "")
    assert f"(process {first.process.pid})" in output
    assert len(output.strip().splitlines()) == 1, "one sentence, and nothing was started"
    assert json.loads((folder / "steadypose" / HEALTH_FILE).read_text())["pid"] == first.process.pid
    assert first.end()[0] == 0
    assert not (folder / "steadypose" / HEALTH_FILE).exists()


def test_locks_are_of_addresses_and_go_with_their_holder(folder: Path, make_launch, monkeypatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder / "runtime"))
    tcp = '{prior="tcp://127.0.0.1:7199"}'
    source = make_launch(nodes='["pose_input"]')
    prior = make_launch(nodes='["prior"]', transport__endpoints=tcp)
    elsewhere = make_launch(nodes='["prior"]', transport__endpoints=tcp, transport__directory=folder / "other")
    with run_lock(source) as first:
        assert first
        with run_lock(prior) as beside:
            assert not beside, "another run writes it"
            with (
                pytest.raises(LaunchError, match=r"prior runs already at tcp://127\.0\.0\.1:7199"),
                run_lock(elsewhere),
            ):
                pass
        with pytest.raises(LaunchError, match="pose_input runs already"), run_lock(source):
            pass
        with run_lock(elsewhere):
            pass
    with run_lock(source):
        pass


def test_a_damaged_recording_is_played_and_the_exit_status_says_so(start: Any, recording: Path) -> None:
    (file,) = recording.glob("*.mcap")
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    file.write_bytes(data)
    run: Run = start("--input", str(recording), *INPUT_ALONE)
    status, output = run.wait()
    assert status == 1, output
    assert "the readable part of the input was played" in output.splitlines()[-1]


def test_poses_go_on_where_the_log_cannot_be_written(recording: Path, tmp_path: Path, folder: Path) -> None:
    out = tmp_path / "out"
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    arguments = ["run", "--input", recording, "--record", out, *INPUT_ALONE]
    command = [sys.executable, "-m", "steadypose.nodes.cli", *arguments]
    with open("/dev/full", "w") as full:
        assert subprocess.run(command, stdout=full, stderr=full, env=environment, timeout=240).returncode == 0
    with RecordingReader(out) as reader:
        assert reader.count(POSE_RAW) == 91


def test_a_path_may_hold_any_character_and_beside_a_file_in_its_place_a_recording_is_made(start: Any, tmp_path: Path):
    strange = tmp_path / 'a 😀 "b\x7f'
    strange.mkdir()
    source = record(strange / "in", walk(30))
    (strange / "mine.npz").touch()
    run: Run = start("--input", str(source), "--record", str(strange / "mine.npz"), "--rate", "0", *INPUT_ALONE)
    status, output = run.wait()
    assert status == 0, output
    assert "mine.npz-2: mine.npz is there already" in output
    with RecordingReader(strange / "mine.npz-2") as reader:
        assert reader.count(POSE_RAW) == 31


def test_who_watches_hears_the_end_of_a_stream_that_was_over_before(recording: Path, make_launch, monkeypatch) -> None:
    monkeypatch.setenv(SUPERVISOR, str(os.getppid()))
    launch = make_launch(nodes='["pose_input"]', input__recording=recording, input__rate=0)
    node, heard = PoseInputNode(launch), set()
    with running(node):
        until(lambda: bool(node.health.ended))
        with Subscriber(launch.transport.endpoint("pose_input"), DIAGNOSTICS, name=WATCHER) as watcher:
            while received := watcher.receive(10.0):
                assert isinstance(received[1], Diagnostics)
                heard.add((received[1].values["state"], received[1].values["ended"]))
                if ("stopped", POSE_RAW) in heard:
                    return
    raise AssertionError(f"heard only {heard}")


@pytest.mark.parametrize("lossless", ["true", "false"])
def test_a_recording_launch_started_again_records_on(tmp_path: Path, make_launch, recording: Path, lossless: str):
    out = tmp_path / "out"
    made = partial(make_launch, recorder__directory=out, transport__lossless=lossless)
    live = made(nodes='["recorder"]')
    replay = made(nodes='["pose_input", "recorder"]', input__recording=recording)
    assert free_directory(live) is None
    record(out, walk(3))
    assert free_directory(live) is None, "the next part of the same"
    assert free_directory(replay) == tmp_path / "out-2", "its stamps are the same again"
    (tmp_path / "out-2").mkdir()
    assert free_directory(replay) == tmp_path / "out-3"
    (out / "notes.txt").write_text("somebody's own")
    assert free_directory(live) == tmp_path / "out-3"


HOSTILE = (
    "asyncio ctypes json logging numba numpy pickle pip rich scipy signal socket steadypose struct subprocess tempfile "
    "threading tyro venv zmq"
)


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder of modules that leave a trace when they are run."""
    where = tmp_path / "hostile"
    where.mkdir()
    for name in HOSTILE.split():
        code = f"open({str(tmp_path / 'was run')!r}, 'a').write({name!r})\nraise SystemExit(3)\n"
        (where / f"{name}.py").write_text(code)
    return where


@pytest.mark.parametrize("arguments", [
    ("run", "--input", "{in}/a", *INPUT_ALONE),
    ("clean", "{in}/a", "{out}/a.npz"),
    ("clean", "{in}", "{out}/all", "--jobs", "2"),
    ("info", "{in}/a"),
    ("echo", "{in}/a"),
    ("hz", "{in}/a"),
    ("repair", "{in}/a", "{out}/repaired"),
    ("plot", "{in}/a", "-o", "{out}/a.png"),
    ("keys", "{out}/keys"),
    ("doctor",),
    ("install-service", "replay", "--dry-run", "--user", "root"),
    *(
        (name, "--help")
        for name in ("fit", "complete", "prepare", "train", "evaluate", "simulate", "calibrate", "node")
    ),
], ids=" ".join)  # fmt: skip
def test_no_command_runs_code_of_the_working_folder(arguments: tuple[str, ...], hostile: Path, tmp_path: Path, folder):
    (tmp_path / "recordings").mkdir()
    (tmp_path / "out").mkdir()
    record(tmp_path / "recordings" / "a", walk(40))
    given = [
        part.format_map({"in": tmp_path / "recordings", "out": tmp_path / "out"}) if "{" in part else part
        for part in arguments
    ]
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    done = subprocess.run(
        [Path(sys.executable).with_name("steadypose"), *given], cwd=hostile,
        env=environment | {"XDG_RUNTIME_DIR": str(folder)}, capture_output=True, text=True, timeout=400,
    )  # fmt: skip
    assert not (tmp_path / "was run").exists(), (tmp_path / "was run").read_text()
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_process_of_our_own_does_not_even_where_python_knows_no_safe_path(hostile: Path, tmp_path: Path, monkeypatch):
    old = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    command = own_command("socket:gethostname")
    assert subprocess.run(command, cwd=hostile, env=old, capture_output=True).returncode != 3
    assert not (tmp_path / "was run").exists()
    monkeypatch.setenv("PYTHONPATH", os.pathsep + "/somewhere")
    assert own_environment()["PYTHONPATH"] == "/somewhere"


def test_the_installer_starts_python_in_isolation(hostile: Path, tmp_path: Path) -> None:
    script = Path(__file__).parents[3] / "setup-environment.sh"
    done = subprocess.run(["sh", "-c", f'. "{script}"; find_python'], cwd=hostile, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "was run").exists()
    starts = [line for line in script.read_text().splitlines() if " -m " in line]
    assert starts
    assert all(" -I -m " in line for line in starts)


SPARED = ("asyncio", "scipy.linalg", "scipy.sparse", "scipy.spatial", "torch", "tyro", "rich", "mcap")
SCRIPT = """
import gc, sys
from steadypose.nodes.commands import node
from steadypose.nodes.graph.node import Node

def run(self):
    print(gc.isenabled(), gc.get_freeze_count() > 50_000, *(m for m in sys.argv[2:] if m in sys.modules))

Node.run = run
node.node([sys.argv[1]])
"""


@pytest.mark.parametrize("name", ["prior", "trajectory"])
def test_a_node_loads_nothing_that_its_work_does_without_and_counts_no_garbage_of_its_start(name: str) -> None:
    command = [sys.executable, "-c", SCRIPT, name, *SPARED]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True True\n"


def test_who_has_compiled_starts_anew_once_with_what_is_now_on_disk() -> None:
    script = """
print("starts")
from steadypose.nodes.graph.process import startup
from steadypose.prior import loop_cache
with startup():
    loop_cache.saved.add("a loop")
print("works")
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout == "starts\nstarts\nworks\n"


def test_the_second_process_compiles_nothing_that_the_first_would_not() -> None:
    assert trajectory_node.TrajectoryNode.name == "trajectory"  # its loops are loaded with it
    compile_from_the_beginning()
    loaded = loops()
    compile_from_the_end()
    assert {name: number for name, number in loops().items() if number != loaded.get(name)} == {}


def test_one_that_compiles_for_ever_is_not_waited_for(tmp_path: Path) -> None:
    with open(tmp_path / "lock", "w") as theirs, open(tmp_path / "lock", "w") as ours:
        assert _locked(theirs, 0.2)
        assert not _locked(ours, 0.2)
    with open(tmp_path / "lock", "w") as ours:
        assert _locked(ours, 0.2)
