"""The systemd unit of a launch file: what it may touch, and how it is watched."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.recorder import RecorderSettings

MARK = "# made by `steadypose install-service`; `steadypose install-service --uninstall` removes it"
HOMES = ("/home", "/root", "/run/user")
"""what ``ProtectHome`` hides"""
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
    is_new_user: bool
    """whether the user is the service's own"""
    command: Path
    """the ``steadypose`` of an installation"""
    launch: str
    """a file, or the name of one of the project's own"""
    groups: tuple[str, ...]
    """besides the user's own, of those that this machine has"""

    @property
    def state(self) -> Path:
        return Path("/var/lib", self.name)

    def unit(self) -> str:
        """The text of the unit."""
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
        """Find what a service could not read, or write, before it fails at every boot.

        Args:
            launch: as it is read from ``launch``.
            python: folders that the command needs besides its own.

        Raises:
            LaunchError: names it, and what to do.
        """
        if not re.fullmatch(r"[a-z_][a-z0-9_-]{0,30}", self.name):
            raise LaunchError(f"--name: expected small letters, digits, - and _, got {self.name!r}")
        for path in (self.command, *python) if self.is_new_user else ():
            if _is_in(path, HOMES):
                raise LaunchError(
                    f"{path} is in a home, which a service's own user cannot read: install steadypose elsewhere "
                    "(python3 -m venv /opt/steadypose, then /opt/steadypose/bin/pip install steadypose), or give the "
                    "user whose home it is with --user"
                )
        if self.is_new_user and _is_in(Path(self.launch), HOMES):
            raise LaunchError(
                f"{self.launch} is in a home, which a service's own user cannot read: copy it, and what it names, to "
                f"/etc/{self.name}"
            )
        recording = launch.settings(RecorderSettings).directory if "recorder" in launch.nodes else ""
        if recording and not _is_in(Path(recording), (str(self.state),)):
            raise LaunchError(
                f"[recorder] directory is {recording}: expected one in {self.state}, for a service writes nowhere else"
            )
        if launch.transport.directory and not _is_in(Path(launch.transport.directory), (f"/run/{self.name}",)):
            raise LaunchError(
                f"[transport] directory is {launch.transport.directory}: expected none, or one in /run/{self.name}"
            )


def _is_in(path: Path, folders: tuple[str, ...]) -> bool:
    return path.is_absolute() and any(path.is_relative_to(folder) for folder in folders)


def quoted(text: str) -> str:
    """As a word of systemd's command lines."""
    plain = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return plain if re.fullmatch(r"[\w@+=:,./%$-]+", plain) else f'"{plain}"'
