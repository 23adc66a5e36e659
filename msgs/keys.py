"""CurveZMQ keys: who may listen when messages leave the machine.

A directory of keys holds

- `own.key_secret`, readable by its owner alone, and `own.key`, the public half to hand out;
- `clients/*.key`: public keys of those who may subscribe here;
- `server.key`: public key of the publishers to subscribe to; without it they are this machine's own.
"""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from pathlib import Path

from zmq.auth import create_certificates, load_certificate, load_certificates

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
    public, secret = load_certificate(secret_file)
    if secret is None:
        raise ValueError(f"{secret_file}: expected a secret key, found none; make new keys")
    server_file = directory / "server.key"
    server = load_certificate(server_file)[0] if server_file.is_file() else public
    clients = load_certificates(directory / "clients") if (directory / "clients").is_dir() else {}
    for key in (public, secret, server, *clients):
        if len(key) != 40:
            raise ValueError(f"{directory}: expected keys of 40 characters, got one of {len(key)}")
    return Keys(public, secret, server, frozenset({public, *clients}))
