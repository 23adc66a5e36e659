import dataclasses
import importlib.metadata
import itertools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace as Made
from unittest.mock import Mock

import pytest
from conftest import running, walk
from rich.console import Console

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import PoseRaw
from steadypose.nodes import extras
from steadypose.nodes.commands import doctor as command
from steadypose.nodes.commands import doctor_checks as checks
from steadypose.nodes.commands.doctor import doctor
from steadypose.nodes.commands.doctor_checks import INSTALL, Finding, Verdict
from steadypose.nodes.extras import install_command
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import LaunchError


def verdicts(check) -> dict[str, Verdict]:
    return {finding.what: finding.verdict for finding in command._examine(check)}


def only(check) -> Finding:
    (finding,) = command._examine(check)
    return finding


def check_broken() -> Iterator[Finding]:
    raise ImportError("libusb is gone")
    yield


@pytest.mark.parametrize("bad", [False, True])
def test_exit_status_says_whether_the_main_job_can_run(bad: bool, monkeypatch, capsys) -> None:
    note = Finding("extra view", Verdict.NOTE, "not [all] there", "install [this]")
    monkeypatch.setattr(command, "CHECKS", (*([check_broken] if bad else []), lambda: iter([note])))
    assert doctor() == bad
    out = capsys.readouterr().out
    assert "install [this]" in out
    assert out.count("not [all] there") == 2  # in the table, and above the remedy
    assert "\nnote extra view: not [all] there\n" in out, "no markup of styles"
    assert ("cannot work yet: broken" in out) == ("ImportError: libusb is gone" in out) == bad


def test_a_missing_package_and_a_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(name: str) -> str:
        if name in ("pyzmq", "rerun-sdk"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "0.0.1" if name == "numpy" else importlib.metadata.version(name)

    monkeypatch.setattr(command, "version", lacking)
    findings = {finding.what: finding for finding in command.check_packages()}
    extra = findings["extra view"]
    assert extra.verdict is Verdict.NOTE
    assert extra.found.startswith("not installed, for the 3D view (run --view) and steadypose plot: ")
    assert extra.found.endswith(install_command("view"))
    assert not extra.fix, "one line an extra"
    packages = findings["packages"]
    assert packages.verdict is Verdict.BAD
    assert "pyzmq not installed, expected >=27" in packages.found
    assert "numpy 0.0.1, expected >=1.26" in packages.found
    assert packages.fix == INSTALL


def test_what_a_pull_brought_is_missed_though_nothing_was_installed_anew(monkeypatch, tmp_path: Path) -> None:
    assert set(command.required()[1]) == set(command.EXTRAS), "every extra has its purpose"
    pulled = command.PROJECT.read_text().replace("dependencies = [", 'dependencies = [\n  "brandnew>=1",', 1)
    monkeypatch.setattr(command, "PROJECT", tmp_path / "pyproject.toml")
    command.PROJECT.write_text(pulled)
    finding = next(iter(command.check_packages()))
    assert (finding.verdict, finding.found) == (Verdict.BAD, "brandnew not installed, expected >=1")


def test_an_installed_wheel_is_asked_what_it_requires(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given = ["numpy>=1.26", "tomli>=2; python_version < '3.0'", "rerun-sdk>=0.30; extra == 'view'"]
    given.append("ros-rclpy>=9.1; sys_platform == 'nowhere' and extra == 'ros2'")
    monkeypatch.setattr(command, "PROJECT", tmp_path / "pyproject.toml")
    monkeypatch.setattr(command, "requires", lambda name: given)
    needed, extras = command.required()
    assert needed == given[:2]
    assert extras == {"view": given[2:3], "ros2": given[3:]}
    assert verdicts(command.check_packages)["packages"] is Verdict.GOOD
    assert "extra ros2" not in verdicts(command.check_packages)


def test_another_python_and_a_busy_processor_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for version, expected in (((3, 10, 0), Verdict.GOOD), ((3, 13, 1), Verdict.GOOD), ((3, 14, 0), Verdict.BAD)):
        with monkeypatch.context() as patch:
            patch.setattr(command.sys, "version_info", version)
            finding = only(command.check_python)
        assert (finding.verdict, finding.found) == (expected, ".".join(map(str, version)))
    monkeypatch.setattr(checks.os, "sched_getaffinity", lambda _: {0, 1})
    for load, expected in ((64.0, Verdict.NOTE), (0.2, Verdict.GOOD)):
        monkeypatch.setattr(checks.os, "getloadavg", lambda load=load: (load, 0.0, 0.0))
        assert verdicts(checks.check_processor)["processor"] is expected


@pytest.mark.parametrize(
    ("runtime", "verdict", "found"),
    [(".", Verdict.GOOD, "latency"), ("file", Verdict.BAD, "Not a directory"), ("x" * 100, Verdict.BAD, "too long")],
)
def test_a_message_arrives_where_sockets_can_be(runtime: str, verdict: Verdict, found: str, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / runtime))
    finding = only(checks.check_messages)
    assert finding.verdict is verdict
    assert found in finding.found
    assert not list(tmp_path.glob("steadypose/*")), "nothing is left behind"


@pytest.mark.parametrize("content", [None, b"\x08\0\0\0\0\0\0\0garbage!"])
def test_missing_or_damaged_weights_are_told_and_nothing_is_timed(content: bytes | None, monkeypatch, tmp_path: Path):
    for model in checks.MODELS if content else ():
        (tmp_path / f"{model}-default.safetensors").write_bytes(content or b"")
    monkeypatch.setattr("steadypose.prior.models.weights.WEIGHTS", tmp_path)
    findings = command._examine(checks.check_models)
    assert [finding.verdict for finding in findings] == [Verdict.BAD] * len(checks.MODELS)
    assert [finding.fix.split("steadypose train ")[1] for finding in findings] == list(checks.MODELS)


def test_the_prior_is_timed_on_a_body_that_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "FRAMES", 40)
    for target_ms, expected in ((1e9, Verdict.GOOD), (0.0, Verdict.NOTE)):
        monkeypatch.setattr(checks, "TARGET_MS", target_ms)
        monkeypatch.setattr(checks, "BUDGET_MS", max(target_ms, 1e6))
        finding = checks._self_test()
        assert finding.verdict is expected
        assert "ms a frame" in finding.found


def test_missing_streams_say_what_to_play_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = Mock(side_effect=LaunchError("it does not exist"))
    monkeypatch.setattr("steadypose.nodes.sources.recording.open_recording", gone)
    finding = only(checks.check_streams)
    assert finding.verdict is Verdict.BAD
    assert "--input" in finding.fix


def test_an_oak_without_usb_rights_gets_its_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    import depthai

    assert only(checks.check_camera).verdict is Verdict.GOOD, "no camera is fine"
    monkeypatch.setattr(depthai.Device, "getAllAvailableDevices", staticmethod(list))
    monkeypatch.setattr(checks, "Path", lambda _: Made(glob=lambda _: [Made(read_text=lambda: "03e7\n")]))
    finding = only(checks.check_camera)
    assert finding.verdict is Verdict.NOTE
    assert finding.found == "1 plugged in that cannot be opened"
    assert "/etc/udev/rules.d" in finding.fix
    monkeypatch.setattr(depthai.Device, "getAllAvailableDevices", lambda: [Made(getDeviceId=lambda: "14442C")])
    assert only(checks.check_camera).found == "14442C"


def test_webcams_that_may_not_be_used_name_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checks, "DEVICES", tmp_path)
    assert only(checks.check_webcam).found == "none"
    (tmp_path / "video0").write_text("")
    assert (only(checks.check_webcam).verdict, only(checks.check_webcam).found) == (Verdict.GOOD, "video0")
    monkeypatch.setattr(checks.os, "access", lambda *_: False)
    finding = only(checks.check_webcam)
    assert finding.verdict is Verdict.NOTE
    assert "usermod -aG video" in finding.fix


def test_a_launch_file_that_it_would_not_read_is_refused() -> None:
    with pytest.raises(LaunchError, match=r"--launch: expected --live with it; .* `steadypose run my\.toml`"):
        doctor(launch="my.toml")


def test_it_needs_nothing_that_it_looks_for() -> None:
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('torch', 'zmq', 'numpy', 'rosbags', 'depthai')));"
        "from steadypose.nodes.commands.doctor import CHECKS, _examine; "
        "print([f.verdict.name for c in CHECKS for f in _examine(c)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("BAD") >= 3


@pytest.mark.parametrize(("checkout", "prefix", "command"), [
    (True, ".venv", "./steadypose add view"),
    (True, "elsewhere", "pip install 'CHECKOUT[view]'"),
    (False, "elsewhere", "pip install 'PATH/TO/CHECKOUT[view]'"),
])  # fmt: skip
def test_what_to_type_can_be_typed_here(checkout: bool, prefix: str, command: str, tmp_path: Path, monkeypatch) -> None:
    if checkout:
        (tmp_path / "pyproject.toml").touch()
    monkeypatch.setattr(extras, "PACKAGE", tmp_path / "src" / "steadypose")
    monkeypatch.setattr(extras.sys, "prefix", str(tmp_path / prefix))
    assert install_command("view") == command.replace("'CHECKOUT", f"'{tmp_path}")


class Tracker(Node):
    name = "pose_input"
    frames: tuple[PoseRaw, ...] = ()

    def handle(self, topic: str, message: object) -> None: ...

    def work(self) -> None:
        frames = itertools.cycle(self.frames)
        while not self.stopping:
            self.publish(POSE_RAW, dataclasses.replace(next(frames), stamp_ns=self.clock.now_ns()))
            self.clock.sleep(10_000_000)


@pytest.fixture
def file(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    path = tmp_path / "launch.toml"
    path.write_text(f'[transport]\ndirectory = "{folder}"\nlossless = false\n')
    monkeypatch.setattr(command, "LISTEN_NS", 800_000_000)
    return str(path)


def heard(file: str, frames: list[PoseRaw]) -> tuple[int, str]:
    """Status and text of a doctor who listens to a tracker with these frames; to nobody without."""
    console = Console(record=True, width=200)
    node = Tracker(Launch.read(file), Clock())
    node.frames = tuple(frames)
    with running(*[node] if frames else []):
        return command.listen(file, console), console.export_text()


@pytest.mark.parametrize(("frames", "status", "problem"), [
    ([dataclasses.replace(raw, calibrated=False) for raw in walk(120)], 0, "no problems found"),
    ([dataclasses.replace(raw, skeleton="smpl") for raw in walk(30)], 1, "most like 'smpl22'"),
    ([], 1, "start the tracker"),
], ids=["good", "bad", "none"])  # fmt: skip
def test_what_is_wrong_with_a_tracker_is_told(file: str, frames: list[PoseRaw], status: int, problem: str) -> None:
    found, text = heard(file, frames)
    assert (found, problem in text) == (status, True), text


@pytest.mark.parametrize("bad", [False, True])
def test_each_client_of_a_server_is_examined_by_itself_and_all_are(bad: bool, file: str, folder: Path) -> None:
    clients = [f"ipc://{folder}/pose_input", *(f"tcp://127.0.0.1:{port}" for port in range(1, 6 if bad else 2))]
    Path(file).write_text(f'nodes = ["prior"]\n[server]\nclients = {clients}\n{Path(file).read_text()}')
    frames, skeleton = [], "octopus" if bad else "smpl22"
    for raw in walk(30 if bad else 120):
        for k in range(len(clients)):  # each elsewhere: as one stream they would jump
            away = [dataclasses.replace(body, positions=body.positions + 3.0 * k) for body in raw.bodies]
            of = {"source": f"client {k}", "skeleton": skeleton, "calibrated": False, "bodies": away}
            frames.append(dataclasses.replace(raw, **of))
    found, text = heard(file, frames)
    named = (f"client {k}.unknown_skeleton" if bad else f"'client {k}': " for k in range(len(clients)))
    assert (found, [name in text for name in named]) == (bad, [True] * len(clients)), text
