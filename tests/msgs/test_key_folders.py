"""A folder of keys that others may write to says nothing: they could let themselves in."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from steadypose.msgs.security import create_keys, load_keys


@pytest.mark.parametrize("part", [".", "clients", "servers"])
@pytest.mark.parametrize("mode", [0o777, 0o702])
def test_it_is_refused(tmp_path: Path, part: str, mode: int) -> None:
    keys = tmp_path / "keys"
    create_keys(keys)
    (keys / "servers").mkdir()
    load_keys(keys)
    (keys / part).chmod(mode)
    with pytest.raises(ValueError, match=r"can be written to by others.*chmod go-w"):
        load_keys(keys)


def test_somebody_elses_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create_keys(tmp_path / "keys")
    owner = (tmp_path / "keys").stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    if owner == 0:  # root's own are trusted
        os.chown(tmp_path / "keys" / "clients", 12345, 12345)
    with pytest.raises(ValueError, match="belongs to user"):
        load_keys(tmp_path / "keys")
