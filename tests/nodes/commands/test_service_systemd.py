"""The unit under a systemd of its own, in namespaces: started when poses are, started again when it hangs, and nodes
that outgrow their memory killed alone.

As root, with STEADYPOSE_SYSTEMD=1: it takes two minutes. This systemd knows the unit and nothing else, and has file
systems of its own at /run, /tmp, /var/tmp and /var/log, so that nothing of the machine's is started, or cleaned up.
"""

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import until

from steadypose import PACKAGE
from steadypose.nodes.commands.install_service import Service

pytestmark = [
    pytest.mark.skipif("STEADYPOSE_SYSTEMD" not in os.environ, reason="systemd: asked for by STEADYPOSE_SYSTEMD=1"),
    pytest.mark.timeout(600),
]
BOOT = """
mount --make-rprivate / && for at in /run /tmp /var/tmp /var/log; do mount -t tmpfs tmpfs $at || exit 1; done
mount -t proc proc /proc || exit 1
container=unshare SYSTEMD_UNIT_PATH=$1 exec /lib/systemd/systemd --system --unit=only.target --show-status=no
"""
LAUNCH = """
[input]
recording = "{recording}"
loop = true
[transport]
lossless = false
"""
Control = Callable[..., str]


@pytest.fixture
def folder() -> Iterator[Path]:
    """Not below /tmp, which this systemd does not see."""
    path = Path("/var/lib", f"steadypose-test-{os.getpid()}")
    path.mkdir()
    yield path
    shutil.rmtree(path)


@pytest.fixture
def boot(folder: Path) -> Iterator[Callable[[str], Control]]:
    """Starts systemd with the unit; gives systemctl, with which properties are read as well."""
    started: list[subprocess.Popen[bytes]] = []

    def start(more: str = "") -> Control:
        (folder / "only.target").write_text("[Unit]\nDefaultDependencies=no\n")
        (folder / "run.toml").write_text(LAUNCH.format(recording=PACKAGE.resolve().parents[1] / "sim_data/walk_turn"))
        command = Path(sys.executable).with_name("steadypose")
        unit = Service("poses", "root", False, command, str(folder / "run.toml"), ()).unit()
        unit = unit.replace("[Unit]", "[Unit]\nDefaultDependencies=no")
        log = f"StandardOutput=append:{folder}/log\nStandardError=append:{folder}/log\n"
        (folder / "poses.service").write_text(unit.replace("[Service]", f"[Service]\n{log}") + f"[Service]\n{more}")
        spaces = ("--mount", "--pid", "--fork", "--uts", "--ipc", "--cgroup", "--kill-child")
        systemd = subprocess.Popen(["unshare", *spaces, "sh", "-c", BOOT, "sh", str(folder)], stdin=subprocess.DEVNULL)
        started.append(systemd)
        children = Path(f"/proc/{systemd.pid}/task/{systemd.pid}/children")
        until(lambda: bool(children.read_text()), timeout_s=60)

        def control(*arguments: str, check: bool = True) -> str:
            words = ["nsenter", "-t", children.read_text().split()[0], "-m", "-p", *arguments]
            return subprocess.run(words, capture_output=True, text=True, timeout=120, check=check).stdout.strip()

        until(lambda: "active" in control("systemctl", "is-active", "only.target", check=False), timeout_s=60)
        control("systemctl", "start", "--no-block", "poses")
        return control

    yield start
    for systemd in started:
        systemd.send_signal(signal.SIGKILL)
        systemd.wait()


def shown(control: Control, name: str) -> str:
    threading.Event().wait(0.2)  # it is asked again and again
    return control("systemctl", "show", "poses", "-p", name, "--value")


def test_a_run_that_hangs_is_started_again(boot: Callable[..., Control]) -> None:
    control = boot("WatchdogSec=10\n")
    until(lambda: shown(control, "ActiveState") == "active", timeout_s=200)
    main = shown(control, "MainPID")
    assert int(main) > 1, "0 would be this process's own group"
    control("kill", "-STOP", main)
    until(lambda: shown(control, "NRestarts") == "1", timeout_s=100)
    until(lambda: shown(control, "ActiveState") == "active", timeout_s=200)


def test_a_node_that_outgrows_its_memory_is_killed_alone(boot: Callable[..., Control], folder: Path) -> None:
    control = boot("MemoryMax=220M\n")
    main, log = shown(control, "MainPID"), folder / "log"
    killed = "prior: ended with SIGKILL; starting it again"
    until(lambda: shown(control, "MainPID") == main and log.read_text().count(killed) > 1, timeout_s=200)
    assert (shown(control, "MainPID"), shown(control, "NRestarts")) == (main, "0"), "the run goes on"
