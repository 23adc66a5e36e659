import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from steadypose.msgs import security
from steadypose.msgs.security import Keys, TransportError, create_keys, load_keys, loopback_keys, make_private
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber


def test_a_directory_that_others_may_write_to_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    directory = security.local_directory()
    assert directory == tmp_path / f"steadypose-{os.getuid()}"
    make_private(directory)
    assert directory.stat().st_mode & 0o777 == 0o700
    security.local_address("prior")
    directory.chmod(0o777)
    for use in (
        lambda: security.local_address("prior"),
        lambda: make_private(directory),
        lambda: Subscriber(f"ipc://{directory}/prior", POSE_RAW),
    ):
        with pytest.raises(TransportError, match="can be written to by others"):
            use()
    directory.rmdir()
    directory.write_text("")
    with pytest.raises(TransportError, match="expected a directory for sockets"):
        security.local_address("prior")


@pytest.mark.parametrize(
    ("use", "text"),
    [(make_private, "expected a directory of one's own"), (load_keys, "belongs to user .*: expected keys")],
)
def test_a_directory_of_somebody_else_is_refused(tmp_path: Path, monkeypatch, use: Callable[[Path], object], text: str):
    create_keys(tmp_path)
    mine = os.getuid()
    if mine == 0:  # whose directories are trusted
        os.chown(tmp_path, 1, -1)
    else:
        monkeypatch.setattr(os, "getuid", lambda: mine + 1)
    with pytest.raises(TransportError, match=text):
        use(tmp_path)


def test_the_secret_key_is_for_its_owner_alone(tmp_path: Path):
    keys = create_keys(tmp_path / "keys")
    secret_file = tmp_path / "keys" / "own.key_secret"
    assert secret_file.stat().st_mode & 0o777 == 0o600
    assert keys.secret.decode() in secret_file.read_text()
    assert keys.secret.decode() not in repr(keys)
    assert load_keys(tmp_path / "keys") == keys
    assert keys == Keys(keys.public, keys.secret, server=keys.public, servers={}, directory=tmp_path / "keys")
    with pytest.raises(TransportError, match="exists already"):
        create_keys(tmp_path / "keys")
    secret_file.chmod(0o640)
    with pytest.raises(TransportError, match="chmod 600"):
        load_keys(tmp_path / "keys")


def test_a_full_disk_is_an_error_that_names_the_folder_and_leaves_no_empty_keys(tmp_path: Path, monkeypatch):
    def write(directory: Path, name: str) -> None:
        (directory / f"{name}.key").touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with monkeypatch.context() as full:
        full.setattr("zmq.auth.create_certificates", write)
        with pytest.raises(OSError, match="No space left"):
            create_keys(tmp_path)
        with pytest.raises(TransportError, match=r"loopback: .*No space left"):
            loopback_keys()
    assert create_keys(tmp_path).secret
    assert loopback_keys().secret


def test_keys_that_are_none_are_refused(tmp_path: Path):
    with pytest.raises(TransportError, match="no such file; make keys with `steadypose keys"):
        load_keys(tmp_path)
    create_keys(tmp_path)
    (tmp_path / "clients" / "short.key").write_text('curve\n    public-key = "short"\n')
    with pytest.raises(TransportError, match="expected keys of 40 characters, got one of 5"):
        load_keys(tmp_path)
    (tmp_path / "clients" / "short.key").write_text("not found\n")
    with pytest.raises(TransportError, match=r"short.key: expected a key, found none; make new keys"):
        load_keys(tmp_path)
    (tmp_path / "own.key_secret").write_text((tmp_path / "own.key").read_text())
    with pytest.raises(TransportError, match="expected a secret key, found none"):
        load_keys(tmp_path)


def test_two_that_make_the_keys_at_once_have_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with ThreadPoolExecutor(8) as threads:
        made = [one.result() for one in [threads.submit(loopback_keys) for _ in range(8)]]
    assert len({keys.secret for keys in made}) == 1


@pytest.mark.parametrize("part", [".", "clients", "servers"])
@pytest.mark.parametrize("mode", [0o777, 0o702])
def test_keys_in_a_folder_that_others_may_write_to_are_refused(tmp_path: Path, part: str, mode: int):
    keys = tmp_path / "keys"
    create_keys(keys)
    (keys / "servers").mkdir()
    load_keys(keys)
    (keys / part).chmod(mode)
    with pytest.raises(TransportError, match=r"can be written to by others.*chmod go-w"):
        load_keys(keys)
