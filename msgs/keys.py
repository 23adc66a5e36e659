"""CurveZMQ keys: who may listen when messages leave the machine.

A directory of keys holds

- `own.key_secret`, readable by its owner alone, and `own.key`, the public half to hand out;
- `clients/*.key`: public keys of those who may subscribe here. Who is taken off the list is not let in any more, and is
  disconnected within a second or two, without a restart;
- `server.key`: public key of the publishers to subscribe to; without it they are this machine's own;
- `servers/HOST.key`: public keys of publishers that each have their own, by host as in their addresses; then those on
  other hosts are not subscribed to.

On this machine an ipc address is private to its user by its directory. A tcp address is not: there a pair of keys that
only this user can read (`loopback_keys`) keeps other users out.
"""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from steadypose.msgs.addresses import TransportError, is_local, local_directory, make_private, parse

MADE_S = 2.0
"""that another process may take to make the keys of this user"""
_OWN = "own"


@dataclass(frozen=True)
class Keys:
    """Public and secret keys, each 40 characters of Z85."""

    public: bytes
    secret: bytes = field(repr=False)
    server: bytes
    """public key that a subscriber expects of its publishers"""
    clients: frozenset[bytes]
    """public keys that a publisher serves; always with `public`, for the subscribers of the same machine"""
    servers: Mapping[str, bytes] = field(default_factory=dict)
    """public keys of publishers that have their own, by host"""
    directory: Path | None = None
    """where they were read from"""

    def server_at(self, endpoint: str) -> bytes:
        """The public key of the publisher at an address.

        Raises:
            ValueError: there is none for it.
        """
        _, host = parse(endpoint)
        if host in self.servers:
            return self.servers[host]
        if self.servers and not is_local(endpoint):
            raise ValueError(f"{endpoint}: expected its public key in {self.directory}/servers/{host}.key, found none")
        return self.server


class ClientList:
    """Who may subscribe, as the directory of keys says now."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._served = self._read()

    def allows(self, key: bytes) -> bool:
        """Whether the holder of this public key is let in."""
        return key in self._read()

    def revoked(self) -> bool:
        """Whether keys were taken off the list since the last call."""
        before, self._served = self._served, self._read()
        return not before <= self._served

    def _read(self) -> frozenset[bytes]:
        if self._keys.directory is None:
            return self._keys.clients
        listed = {self._keys.public}
        for file in (self._keys.directory / "clients").glob("*.key"):
            with suppress(ValueError, OSError):  # one that is not yet whole is none
                listed.add(_public(file))
        return frozenset(listed)


def _listed(directory: Path) -> dict[str, bytes]:
    """Public keys in a folder, by the names of their files.

    Raises:
        ValueError: one is no key.
    """
    return {file.stem: _public(file) for file in sorted(directory.glob("*.key"))}


def _public(file: Path) -> bytes:
    public, _ = load_certificate(file)
    if len(public) != 40:
        raise ValueError(f"{file}: expected keys of 40 characters, got one of {len(public)}")
    return public


def create_keys(directory: str | Path) -> Keys:
    """Make a pair of keys in `directory`, and the empty list `clients` beside it.

    Raises:
        ValueError: if there is a pair already; it is not replaced, for others may rely on it.
    """
    directory = Path(directory)
    (directory / "clients").mkdir(parents=True, exist_ok=True)
    secret = directory / f"{_OWN}.key_secret"
    try:
        # made first with its mode, for pyzmq would make it readable by all
        os.close(os.open(secret, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except FileExistsError as error:
        raise ValueError(f"{secret} exists already: expected a directory without keys, or use these") from error
    create_certificates(directory, _OWN)
    return load_keys(directory)


def load_keys(directory: str | Path) -> Keys:
    """Read a directory of keys.

    Raises:
        ValueError: if a file is missing or holds no key, or if the secret can be read by others.
    """
    directory = Path(directory)
    secret_file = directory / f"{_OWN}.key_secret"
    if not secret_file.is_file():
        raise ValueError(f"{secret_file}: no such file; make keys with `steadypose keys {directory}`")
    if secret_file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ValueError(f"{secret_file} is open to others: run `chmod 600 {secret_file}`, or make new keys")
    for folder in (directory, directory / "clients", directory / "servers"):
        if folder.is_dir():
            _check_folder(folder)
    public, secret = load_certificate(secret_file)
    if secret is None:
        raise ValueError(f"{secret_file}: expected a secret key, found none; make new keys")
    server_file = directory / "server.key"
    server = load_certificate(server_file)[0] if server_file.is_file() else public
    for key in (public, secret, server):
        if len(key) != 40:
            raise ValueError(f"{directory}: expected keys of 40 characters, got one of {len(key)}")
    clients = _listed(directory / "clients").values()
    return Keys(public, secret, server, frozenset({public, *clients}), _listed(directory / "servers"), directory)


def _check_folder(folder: Path) -> None:
    """Raises:
    ValueError: others may write to it, and so say who may listen, and whose poses are accepted.
    """
    status = folder.stat()
    others = stat.S_IWOTH if status.st_gid == os.getgid() else stat.S_IWOTH | stat.S_IWGRP
    if status.st_uid not in (0, os.getuid()):
        raise ValueError(f"{folder} belongs to user {status.st_uid}: expected keys of one's own; make new ones")
    if status.st_mode & others:
        raise ValueError(
            f"{folder} can be written to by others, who could add keys; run `chmod go-w {folder}`, and look into it"
        )


def loopback_keys() -> Keys:
    """This user's keys for tcp addresses of this machine, made at first; they last as long as the runtime directory.

    Raises:
        TransportError: they cannot be made, or others can read them.
    """
    directory = local_directory()
    make_private(directory)
    folder = directory / "loopback"
    with suppress(ValueError):  # they are there
        return create_keys(folder)
    deadline = time.monotonic() + MADE_S
    while True:
        try:
            return load_keys(folder)
        except (ValueError, OSError) as error:
            if time.monotonic() > deadline:
                raise TransportError(f"{folder}: {error}; remove it, and others are made") from error
        time.sleep(0.01)
