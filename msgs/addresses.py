"""Addresses that messages travel by, and which of them may be used."""

from __future__ import annotations

import ipaddress
import os
import socket
import stat
import tempfile
from pathlib import Path


class TransportError(ValueError):
    """An address that cannot, or must not, be used. The text says what to do."""


def parse(endpoint: str) -> tuple[str, str]:
    """Transport and path or host of an address.

    Raises:
        TransportError: it is malformed.
    """
    transport, _, address = endpoint.partition("://")
    host, _, port = address.rpartition(":")
    if transport == "ipc" and address:
        return transport, address
    if transport == "tcp" and host and (port.isdecimal() or port == "*"):
        return transport, host.strip("[]")
    raise TransportError(f"address: expected ipc://PATH or tcp://HOST:PORT, got {endpoint!r}")


def is_local(endpoint: str) -> bool:
    """Whether only this machine is at the other end."""
    transport, host = parse(endpoint)
    return transport == "ipc" or _is_loopback(host)


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refuse_used(path: Path) -> None:
    """Raises:
    TransportError: a publisher is at this path, or something that is no socket. ZeroMQ would take the path from the
        one without either noticing, and delete the other.
    """
    try:
        kind = path.lstat().st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(kind):
        raise TransportError(f"cannot publish at ipc://{path}: expected no file there, or an old socket; remove it")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return
    raise TransportError(f"cannot publish at ipc://{path}: another publisher is there; stop it or choose another path")


def check_private(directory: Path) -> None:
    """Raises:
    TransportError: others own the directory, or may write to it, and so could publish in this user's name.
    """
    try:
        status = directory.lstat()
    except FileNotFoundError:
        return
    except OSError as error:
        raise TransportError(f"{directory}: {error.strerror}") from error
    if stat.S_ISLNK(status.st_mode) and status.st_uid in (0, os.getuid()):
        status = directory.stat()
    if not stat.S_ISDIR(status.st_mode):
        raise TransportError(f"{directory}: expected a directory for sockets, got something else")
    if status.st_uid not in (0, os.getuid()):
        raise TransportError(
            f"{directory} belongs to user {status.st_uid}: expected a directory of one's own for sockets; "
            "set XDG_RUNTIME_DIR, or [transport] directory"
        )
    sticky = status.st_uid == 0 and status.st_mode & stat.S_ISVTX  # /tmp, for an address that somebody chose there
    others = stat.S_IWOTH if status.st_gid == os.getgid() else stat.S_IWOTH | stat.S_IWGRP
    if status.st_mode & others and not sticky:
        raise TransportError(f"{directory} can be written to by others: run `chmod 700 {directory}`, or choose another")


def make_private(directory: Path) -> None:
    """Make a directory for sockets, accessible to this user only, unless it exists.

    Raises:
        TransportError: it exists with other owners or permissions, or cannot be made.
    """
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise TransportError(f"cannot make {directory}: {error.strerror}") from error
    check_private(directory)


def local_directory() -> Path:
    """Where ipc sockets live unless a launch file says otherwise: private to the user, gone after a reboot.

    Raises:
        TransportError: it is there, and others may write to it.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    directory = Path(runtime) / "steadypose" if runtime else Path(tempfile.gettempdir()) / f"steadypose-{os.getuid()}"
    check_private(directory)
    return directory


def local_address(node: str) -> str:
    """Where ``node`` (``pose_input``, ``prior``, ``trajectory``) publishes unless a launch file says otherwise.

    Raises:
        TransportError: others may write to the directory.
    """
    return f"ipc://{local_directory() / node}"
