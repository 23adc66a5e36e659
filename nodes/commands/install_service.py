"""``steadypose install-service``: a launch file at every boot, under systemd; and how to undo it."""

import grp
import os
import pwd
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from steadypose.nodes.graph.launch import Launch, find
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.settings import LaunchError, paths_in
from steadypose.nodes.sinks.recorder import RecorderSettings

MARK = "# made by `steadypose install-service`; `steadypose install-service --uninstall` removes it"
HOMES = ("/home", "/root", "/run/user")  # what ``ProtectHome`` hides
TEMPORARY = ("/tmp", "/var/tmp")  # what ``PrivateTmp`` hides
UNIT = """\
{mark}
[Unit]
Description=steadypose: {launch}
After=network.target
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={command} run {launch}
Restart=always
RestartSec=2
# the first start compiles for half a minute, on a small machine for minutes
TimeoutStartSec=900
WatchdogSec=30
# only the run is told to stop: it stops its nodes in order
KillMode=mixed
TimeoutStopSec=60
# a node that outgrows this is killed alone, and started again
MemoryMax=2G
OOMPolicy=continue

User={user}
{groups}RuntimeDirectory={name}
RuntimeDirectoryMode=0700
# what subscribes or has the page open knows keys and a token there
RuntimeDirectoryPreserve=restart
CacheDirectory={name}
StateDirectory={name}
StateDirectoryMode=0750
WorkingDirectory=%S/{name}
UMask=0027
# sockets and health.json are in /run/{name}/steadypose
Environment=XDG_RUNTIME_DIR=%t/{name} XDG_CACHE_HOME=%C/{name} HOME=%S/{name} PYTHONSAFEPATH=1

NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
ProtectHome={homes}
PrivateTmp=yes
ProtectProc=invisible
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
LockPersonality=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
# cameras, and no other device; memory that is written and run (MemoryDenyWriteExecute) is what compiles loops
DevicePolicy=closed
DeviceAllow=char-usb_device rw
DeviceAllow=char-video4linux rw

[Install]
WantedBy=multi-user.target
"""


@dataclass(frozen=True)
class Service:
    """What is to run as a service, and as whom."""

    name: str
    user: str
    is_new_user: bool  # whether the user is the service's own
    command: Path  # the ``steadypose`` of an installation
    launch: str  # a file, or the name of one of the project's own
    groups: tuple[str, ...]  # besides the user's own, of those that this machine has

    def unit(self) -> str:
        return UNIT.format(
            mark=MARK,
            launch=quoted(self.launch),
            command=quoted(str(self.command)),
            user=self.user,
            groups=f"SupplementaryGroups={' '.join(self.groups)}\n" if self.groups else "",
            name=self.name,
            homes="yes" if self.is_new_user else "read-only",
        )

    def check(self, launch: Launch, *python: Path) -> None:
        """Raise LaunchError for what a service could not read, or write: it would fail at every boot.

        ``launch`` is the launch file as it is read; ``python`` are folders that the command needs besides its own.
        """
        if not re.fullmatch(r"[a-z_][a-z0-9_-]{0,30}", self.name):
            raise LaunchError(f"--name: expected small letters, digits, - and _, got {self.name!r}")
        for path in (self.command, *python) if self.is_new_user else ():
            if _is_in(path, HOMES):
                raise LaunchError(
                    f"{path} is in a home, which a service's own user cannot read: install steadypose elsewhere "
                    "(/usr/bin/python3 -m venv /opt/steadypose, then /opt/steadypose/bin/pip install PATH/TO/CHECKOUT),"
                    " or give the user whose home it is with --user"
                )
        recording = launch.settings(RecorderSettings).directory if "recorder" in launch.nodes else ""
        state, run, sockets = _state(self.name), f"/run/{self.name}", launch.transport.directory
        if recording and not _is_in(Path(recording), (str(state),)):
            raise LaunchError(f"[recorder] directory: expected one in {state}, as for all it writes, got {recording}")
        if sockets and not _is_in(Path(sockets), (run,)):
            raise LaunchError(f"[transport] directory: expected none, or one in {run}, got {sockets}")
        sections = [launch, *(section for section in launch.sections.values() if is_dataclass(section))]
        for path in (Path(self.launch), *(path for section in sections for path in paths_in(section))):
            for folders, where in ((HOMES, "a home"), (TEMPORARY, "a folder of temporary files")):
                if (folders is TEMPORARY or self.is_new_user) and _is_in(path, folders):
                    remedy = f"copy the launch file, and what it names, to /etc/{self.name}"
                    raise LaunchError(f"{path} is in {where}, which the service does not see: {remedy}")


def _is_in(path: Path, folders: tuple[str, ...]) -> bool:
    return path.is_absolute() and any(path.is_relative_to(folder) for folder in folders)


def quoted(text: str) -> str:
    """As a word of systemd's command lines."""
    plain = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return plain if re.fullmatch(r"[\w@+=:,./%$-]+", plain) else f'"{plain}"'


UNITS = Path("/etc/systemd/system")
BOOTED = Path("/run/systemd/system")  # there where systemd runs this machine (sd_booted(3))
Step = tuple[str, Callable[[], object]]  # one thing that is done: how it is printed, and a function that does it


def _command(*words: str) -> Step:
    return shlex.join(words), partial(subprocess.run, words, check=True)


def install_service(
    launch: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[LAUNCH]")] = "oak",
    name: Annotated[str, tyro.conf.arg(metavar="NAME")] = "steadypose",
    user: Annotated[str, tyro.conf.arg(metavar="USER", help_behavior_hint="")] = "",
    dry_run: bool = False,
    uninstall: bool = False,
) -> int:
    """Run a launch file at every boot, as a systemd service with its own user.

    The command prints each step. The service writes recordings to /var/lib/NAME, compiled code to /var/cache/NAME,
    sockets and health.json to /run/NAME, and nothing elsewhere. It sees no home folders, and uses no devices but
    cameras.

    Try:
      steadypose install-service oak --dry-run
      sudo steadypose install-service /etc/kitchen.toml

    Args:
        launch: a launch file, or the name of a bundled one. The file must lie outside home folders, such as in /etc.
        name: name of the service and of its folders.
        user: existing user to run it as. Default: a new user with the service's name.
        dry_run: print every step and do nothing.
        uninstall: stop and remove the service and its compiled code. Recordings in /var/lib/NAME are kept; if there
            are none, its user is removed too, if it was created for it.
    """
    console = Console(highlight=False, soft_wrap=True)
    if uninstall:
        steps = list(_undo(name))
    else:
        service = _service(launch, name, user)
        steps = list(_install(service))
        if dry_run:
            console.print(service.unit(), markup=False)
    if not dry_run and os.geteuid() != 0:
        raise LaunchError("expected root: run it with sudo, or with --dry-run to see what it does")
    if not (uninstall or dry_run):
        # as root, so that all users find them beside the package
        compile_missing(lambda line: console.print(line, markup=False))
    for step, act in steps:
        console.print(f"+ {step}", markup=False)
        try:
            if not dry_run:
                act()
        except (OSError, subprocess.CalledProcessError) as error:
            raise LaunchError(f"`{step}` failed ({error}); --uninstall undoes what was done before") from error
    if uninstall and _state(name).exists():
        console.print(f"{_state(name)} is kept: remove it, and user {name}, if you do not need its recordings")
    elif not (uninstall or dry_run or BOOTED.exists()):
        console.print("systemd does not run here: the service starts at the next boot that it runs")
    elif not (uninstall or dry_run):
        where = f"`systemctl status {name}`, `journalctl -fu {name}`, /run/{name}/steadypose/health.json"
        console.print(f"it runs: {where}")
    return 0


def _service(launch: str, name: str, user: str) -> Service:
    if user and not _has_user(user):
        raise LaunchError(f"--user: there is no user {user!r}; leave it out to have one made")
    file = find(launch)
    settled = Launch.read(file)
    command = Path(sys.executable).with_name("steadypose")
    if not command.exists():
        raise LaunchError(f"expected {command}, found none: install steadypose into this Python's environment")
    own = launch if not Path(launch).expanduser().is_file() else str(file)
    groups = tuple(group.gr_name for group in grp.getgrall() if group.gr_name == "video")
    service = Service(name, user or name, not user, command, own, groups)
    service.check(settled, Path(sys.prefix), Path(sys.base_prefix))
    unit = _unit(name)
    if unit.exists() and MARK not in unit.read_text(encoding="utf-8", errors="replace"):
        raise LaunchError(f"{unit} was not made by this command: remove it, or give the service another --name")
    return service


def _install(service: Service) -> Iterator[Step]:
    unit = _unit(service.name)
    if service.is_new_user and not _has_user(service.user):
        home = ("--home-dir", str(_state(service.name)), "--no-create-home", "--shell", "/usr/sbin/nologin")
        yield _command("useradd", "--system", "--user-group", *home, service.user)
    yield f"write {unit}", partial(unit.write_text, service.unit(), encoding="utf-8")
    if BOOTED.exists():
        yield _command("systemctl", "daemon-reload")
    yield _command("systemctl", "enable", unit.name)
    if BOOTED.exists():  # also where an older unit runs
        yield _command("systemctl", "restart", "--no-block", unit.name)


def _undo(name: str) -> Iterator[Step]:
    """Raises LaunchError if there is no such service, or it is somebody else's."""
    unit = _unit(name)
    if not unit.exists():
        raise LaunchError(f"there is no {unit}: nothing to remove")
    text = unit.read_text(encoding="utf-8", errors="replace")
    if MARK not in text:
        raise LaunchError(f"{unit} was not made by this command: expected one that begins with {MARK!r}")
    empty = not (state := _state(name)).exists() or not any(state.iterdir())
    yield _command("systemctl", "disable", *(["--now"] if BOOTED.exists() else []), unit.name)
    yield _command("rm", "-f", str(unit))
    if BOOTED.exists():
        yield _command("systemctl", "daemon-reload")
    yield _command("rm", "-rf", f"/var/cache/{name}")
    if empty and state.exists():
        yield _command("rmdir", str(state))
    if empty and f"\nUser={name}\n" in text and _has_user(name):
        yield _command("userdel", name)


def _unit(name: str) -> Path:
    return UNITS / f"{name}.service"


def _state(name: str) -> Path:
    return Path("/var/lib", name)


def _has_user(name: str) -> bool:
    with suppress(KeyError):
        return bool(pwd.getpwnam(name))
    return False
