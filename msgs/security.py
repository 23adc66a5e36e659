"""Addresses and access control: which addresses may be used, and which CurveZMQ keys may subscribe.

An ipc address on this machine is private to its user by the permissions of its directory. A local tcp address is not,
so a pair of keys that only this user can read (`loopback_keys`) keeps other users out. If messages leave the machine, a
directory of keys defines who may subscribe. It contains:

- `own.key_secret`, readable only by its owner, and `own.key`, the public key to hand out;
- `clients/*.key`: public keys that may subscribe here. A client whose key is removed is disconnected within a second or
  two, without a restart, and no longer accepted;
- `server.key`: public key of the publishers to subscribe to. Without it, publishers are expected to use `own.key`;
- `servers/HOST.key`: public keys of publishers with individual keys, by host as in their addresses. Publishers on other
  hosts are then not subscribed to.
"""

import ipaddress
import os
import socket
import stat
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path


class TransportError(ValueError):
    """An address or a key that cannot or must not be used. The text says what to do."""


MAX_PORT = 65535  # ZeroMQ takes a larger one modulo 65536


def parse(endpoint: str) -> tuple[str, str]:
    """The transport, and the path or host, of an address. Raises TransportError if the address is malformed."""
    transport, _, address = endpoint.partition("://")
    host, _, port = address.rpartition(":")
    if transport == "ipc" and address:
        return transport, address
    if transport == "tcp" and host and (port == "*" or (port.isdecimal() and int(port) <= MAX_PORT)):
        return transport, host.strip("[]")
    raise TransportError(f"address: expected ipc://PATH or tcp://HOST:PORT, got {endpoint!r}")


def is_local(endpoint: str) -> bool:
    """Whether an address can be reached from this machine only."""
    transport, host = parse(endpoint)
    try:
        return transport == "ipc" or host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refuse_used(path: Path) -> None:
    """Raise TransportError if a publisher uses a socket's path, or the path is not a socket.

    ZeroMQ would take the path from another publisher, and delete a file that is not a socket.
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
    """Raise TransportError if another user owns a directory or may write to it, and so publish in this user's name."""
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
        remedy = "expected a directory of one's own for sockets; set XDG_RUNTIME_DIR, or [transport] directory"
        raise TransportError(f"{directory} belongs to user {status.st_uid}: {remedy}")
    sticky = status.st_uid == 0 and status.st_mode & stat.S_ISVTX  # /tmp, for an address chosen explicitly
    if _is_open(status) and not sticky:
        raise TransportError(f"{directory} can be written to by others: run `chmod 700 {directory}`, or choose another")


def _is_open(status: os.stat_result) -> bool:
    """Whether other users may write there."""
    others = stat.S_IWOTH if status.st_gid == os.getgid() else stat.S_IWOTH | stat.S_IWGRP
    return bool(status.st_mode & others)


def make_private(directory: Path) -> None:
    """Create a directory for sockets, for this user only, unless it exists. Raises as `check_private`."""
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise TransportError(f"cannot make {directory}: {error.strerror}") from error
    check_private(directory)


def local_directory() -> Path:
    """The default directory of ipc sockets, private to the user, and removed at a reboot. Raises as `check_private`."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    directory = Path(runtime) / "steadypose" if runtime else Path(tempfile.gettempdir()) / f"steadypose-{os.getuid()}"
    check_private(directory)
    return directory


def local_address(node: str) -> str:
    """The default address at which ``node`` (``pose_input``, ``prior``, ``trajectory``) publishes. Raises as
    `check_private`.
    """
    return f"ipc://{local_directory() / node}"


MADE_S = 2.0  # longest time to wait for another process that creates this user's keys, seconds
_OWN = "own"


@dataclass(frozen=True)
class Keys:
    """Public and secret keys, each 40 characters of Z85."""

    public: bytes
    secret: bytes = field(repr=False)
    server: bytes  # public key that a subscriber expects from its publishers
    servers: Mapping[str, bytes]  # public keys of publishers with individual keys, by host
    directory: Path  # directory that the keys were read from, and in which the clients' are

    def server_at(self, endpoint: str) -> bytes:
        """The public key of the publisher at an address. Raises TransportError if there is no key for its host."""
        _, host = parse(endpoint)
        if host in self.servers:
            return self.servers[host]
        if self.servers and not is_local(endpoint):
            file = self.directory / "servers" / f"{host}.key"
            raise TransportError(f"{endpoint}: expected its public key in {file}, got none; copy its own.key there")
        return self.server

    def clients(self) -> set[bytes]:
        """The public keys that may subscribe, as listed now, and `public`, for subscribers on the same machine."""
        listed = {self.public}
        for file in (self.directory / "clients").glob("*.key"):
            with suppress(TransportError, OSError):  # a file that is still being written is ignored
                listed.add(_public(file))
        return listed


def _listed(directory: Path) -> dict[str, bytes]:
    """Public keys in a folder, by file name without suffix. Raises TransportError if a file is not a key."""
    return {file.stem: _public(file) for file in sorted(directory.glob("*.key"))}


def _public(file: Path) -> bytes:
    return _certificate(file)[0]


def _certificate(file: Path) -> tuple[bytes, bytes | None]:
    """The public key in a file, and the secret key if the file has one."""
    from zmq.auth import load_certificate  # imported late, because parsing an address needs no ZeroMQ

    try:
        public, secret = load_certificate(file)
    except ValueError as error:
        raise TransportError(f"{file}: expected a key, found none; make new keys, or copy this one again") from error
    for key in (public, secret or public):
        if len(key) != 40:
            raise TransportError(f"{file}: expected keys of 40 characters, got one of {len(key)}")
    return public, secret


def create_keys(directory: str | Path) -> Keys:
    """Create a pair of keys in `directory`, and an empty folder `clients`. Raises OSError if they cannot be written.

    An existing pair is not replaced, because others may rely on it: then it raises TransportError.
    """
    directory = Path(directory)
    (directory / "clients").mkdir(parents=True, exist_ok=True)
    secret = directory / f"{_OWN}.key_secret"
    try:
        # created here with its mode, because pyzmq would create it readable by all
        os.close(os.open(secret, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except FileExistsError as error:
        raise TransportError(f"{secret} exists already: expected a directory without keys, or use these") from error
    from zmq.auth import create_certificates

    try:
        create_certificates(directory, _OWN)
    except OSError:  # the disk is full: an empty file would be taken for a pair of keys
        for half in (secret, secret.with_suffix(".key")):
            half.unlink(missing_ok=True)
        raise
    return load_keys(directory)


def load_keys(directory: str | Path) -> Keys:
    """Read a directory of keys. Raises TransportError if a key is missing, invalid or open to others."""
    directory = Path(directory)
    secret_file = directory / f"{_OWN}.key_secret"
    if not secret_file.is_file():
        raise TransportError(f"{secret_file}: no such file; make keys with `steadypose keys {directory}`")
    if secret_file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise TransportError(f"{secret_file} is open to others: run `chmod 600 {secret_file}`, or make new keys")
    for folder in (directory, directory / "clients", directory / "servers"):
        if folder.is_dir():
            _check_folder(folder)
    public, secret = _certificate(secret_file)
    if secret is None:
        raise TransportError(f"{secret_file}: expected a secret key, found none; make new keys")
    server_file = directory / "server.key"
    server = _public(server_file) if server_file.is_file() else public
    _listed(directory / "clients")  # a file that is no key is an error here, not a client that is refused later
    return Keys(public, secret, server, _listed(directory / "servers"), directory)


def _check_folder(folder: Path) -> None:
    """Raise TransportError if another user owns a folder of keys or may write to it, and so accept other keys."""
    status = folder.stat()
    if status.st_uid not in (0, os.getuid()):
        raise TransportError(f"{folder} belongs to user {status.st_uid}: expected keys of one's own; make new ones")
    if _is_open(status):
        remedy = f"run `chmod go-w {folder}`, and look into it"
        raise TransportError(f"{folder} can be written to by others, who could add keys; {remedy}")


def loopback_keys() -> Keys:
    """This user's keys for local tcp addresses, created on first use. They last as long as the runtime directory.

    Raises TransportError if they cannot be created, or others can read them.
    """
    directory = local_directory()
    make_private(directory)
    folder = directory / "loopback"
    try:
        return create_keys(folder)
    except OSError as error:
        raise TransportError(f"{folder}: expected to write keys there: {error.strerror}") from error
    except TransportError:
        pass  # they exist
    deadline = time.monotonic() + MADE_S
    while True:
        try:
            return load_keys(folder)
        except (TransportError, OSError) as error:
            if time.monotonic() > deadline:
                raise TransportError(f"{folder}: {error}; remove it, and new keys are made") from error
        time.sleep(0.01)
