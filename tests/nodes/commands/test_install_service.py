import shutil
import subprocess
from pathlib import Path

import pytest

from steadypose import PACKAGE
from steadypose.nodes.commands import install_service as command
from steadypose.nodes.commands.install_service import Service, install_service, quoted
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import LaunchError


def service(**changed: object) -> Service:
    of = {"name": "poses", "user": "poses", "is_new_user": True, "command": Path("/opt/sp/bin/steadypose"),
          "launch": "/etc/poses/my launch.toml", "groups": ("video",)}  # fmt: skip
    return Service(**(of | changed))  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checkout, whose recording the launch file names, may itself lie in a home or in /tmp."""
    for folders, inside in (("HOMES", "/home/a"), ("TEMPORARY", "/tmp/a")):
        kept = [folder for folder in getattr(command, folders) if not PACKAGE.is_relative_to(folder)]
        monkeypatch.setattr(command, folders, (*kept, inside))


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What would be done to this machine, in place of doing it; units go to a folder of the test's own."""
    called: list[str] = []
    monkeypatch.setattr(command, "UNITS", tmp_path)
    monkeypatch.setattr(command, "BOOTED", tmp_path)
    monkeypatch.setattr(command, "compile_missing", lambda say: None)
    monkeypatch.setattr(command.os, "geteuid", lambda: 0)
    monkeypatch.setattr(command.subprocess, "run", lambda words, check: called.append(" ".join(words)))
    return called


def test_the_unit_is_one_that_systemd_understands(tmp_path: Path) -> None:
    assert (quoted("/a b"), quoted('100%$"')) == ('"/a b"', '"100%%$$\\""')
    text = service(user="daemon", command=Path("/bin/true")).unit()
    assert 'ExecStart=/bin/true run "/etc/poses/my launch.toml"' in text
    for line in (
        "StateDirectory=poses",
        "RuntimeDirectoryPreserve=restart",
        "SupplementaryGroups=video",
        "ProtectHome=yes",
        "OOMPolicy=continue",
    ):
        assert line in text
    if shutil.which("systemd-analyze"):
        unit = tmp_path / "poses.service"
        unit.write_text(text)
        checked = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
        assert "poses.service" not in checked.stderr, checked.stderr


@pytest.mark.parametrize(("changed", "settings", "match"), [
    ({"command": Path("/home/a/bin/steadypose")}, {}, "in a home.*/usr/bin/python3 -m venv /opt.*pip install PATH"),
    ({"launch": "/home/a/my.toml"}, {}, "in a home.*copy the launch file"),
    ({"launch": "/tmp/a/my.toml", "is_new_user": False}, {}, "in a folder of temporary files"),
    ({}, {"transport.keys": "/home/a/keys"}, "/home/a/keys is in a home"),
    ({}, {"input.webcam.video": "/home/a/in.mp4"}, "/home/a/in.mp4 is in a home"),
    ({"name": "../x"}, {}, "--name: expected small letters"),
    ({}, {"nodes": '["recorder"]', "recorder.directory": "/data/out"}, r"\[recorder\] directory: .*/var/lib/poses"),
    ({}, {"transport.directory": "/srv/sockets"}, r"\[transport\] directory: .*/run/poses"),
])  # fmt: skip
def test_what_a_service_could_not_do_is_said(changed: dict[str, object], settings: dict[str, str], match: str) -> None:
    launch = Launch.read("replay", [f"{key}={value}" for key, value in settings.items()])
    with pytest.raises(LaunchError, match=match):
        service(**changed).check(launch)


def test_a_user_may_run_what_lies_in_his_home() -> None:
    own = service(is_new_user=False, user="a", command=Path("/home/a/bin/steadypose"), launch="/home/a/my.toml")
    own.check(Launch.read("replay", ["transport.keys=/home/a/keys"]))
    assert "ProtectHome=read-only" in own.unit()


def test_a_dry_run_does_nothing_and_what_is_installed_is_removed(done: list[str], tmp_path: Path, capsys) -> None:
    assert install_service("replay", name="poses-test", user="root", dry_run=True) == 0
    printed = capsys.readouterr().out
    assert "[Service]" in printed
    assert "+ systemctl enable poses-test.service" in printed
    assert not [*done, *tmp_path.iterdir()]
    assert install_service("replay", name="poses-test", user="root") == 0
    unit = tmp_path / "poses-test.service"
    assert "User=root" in unit.read_text()
    started = ("daemon-reload", f"enable {unit.name}", f"restart --no-block {unit.name}")
    assert done == [f"systemctl {words}" for words in started]
    assert f"+ write {unit}" in capsys.readouterr().out
    done.clear()
    assert install_service(name="poses-test", uninstall=True) == 0
    assert done[:2] == [f"systemctl disable --now {unit.name}", f"rm -f {unit}"]
    assert "rm -rf /var/cache/poses-test" in done
    assert not any("userdel" in line for line in done), "it was not made for the service"


def test_a_unit_of_somebody_elses_is_left_alone(done: list[str], tmp_path: Path) -> None:
    (tmp_path / "nginx.service").write_text("[Service]\n")
    for name, uninstall, match in (
        ("nginx", False, "not made by this command"),
        ("nginx", True, "not made by this command"),
        ("none", True, "nothing to remove"),
    ):
        with pytest.raises(LaunchError, match=match):
            install_service("replay", name=name, user="root", uninstall=uninstall)
    assert not done
