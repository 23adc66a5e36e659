"""Progress of a playback, so that a restarted input node resumes where it was.

A few bytes in a file in the directory of the sockets, written with each message, which survive the process. They are
valid for nodes of the same supervisor only; a new run begins at the beginning.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

_FORM = struct.Struct("<qqq")


class Progress(NamedTuple):
    """Where a recording is."""

    loops_ns: int = 0
    """by how much stamps are later than in the recording, because it was played before"""
    messages: int = 0
    """of this time through, that were published"""


class ProgressFile:
    """Keeps the progress of an input node.

    Args:
        path: of the file.
        supervisor: process id of the node's supervisor; 0 if there is none, and no progress is kept.
    """

    def __init__(self, path: Path, supervisor: int) -> None:
        self._path, self._supervisor = path, supervisor
        self._file: int | None = None

    def read(self) -> Progress:
        """Where the node before this one was; the beginning, if there was none."""
        try:
            supervisor, loops_ns, messages = _FORM.unpack(self._path.read_bytes())
        except (OSError, struct.error):
            return Progress()
        return Progress(loops_ns, messages) if self._supervisor and supervisor == self._supervisor else Progress()

    def write(self, progress: Progress) -> None:
        if not self._supervisor:
            return
        if self._file is None:
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        os.pwrite(self._file, _FORM.pack(self._supervisor, *progress), 0)

    def close(self, *, finished: bool) -> None:
        """Stop keeping it; one that is finished has no progress any more."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if finished and self._supervisor:
            self._path.unlink(missing_ok=True)
