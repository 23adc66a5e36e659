"""How far a node has come, in a file that outlives it, so that the one after it goes on where its listeners are.

A few bytes in the directory of the sockets, written with each message that all reliable listeners have taken. They hold
for nodes of the same supervisor only; a new run begins at the beginning.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

_FORM = struct.Struct("<qqqqqq")


class Progress(NamedTuple):
    """What was published and taken."""

    publisher: int = 0
    """the publisher's number"""
    sequence: tuple[int, int] = (0, 0)
    """of the next message of the node's first topic, and of its second"""
    mark: tuple[int, int] = (0, 0)
    """what the node itself notes of the last message: `Node.mark`"""


class ProgressFile:
    """Keeps the progress of a node.

    Args:
        path: of the file.
        supervisor: process id of the node's supervisor; 0 if there is none, and no progress is kept.
    """

    def __init__(self, path: Path, supervisor: int) -> None:
        self._path, self._supervisor = path, supervisor
        self._file: int | None = None

    def read(self) -> Progress | None:
        """Where the node before this one was; None if there was none."""
        try:
            supervisor, publisher, *numbers = _FORM.unpack(self._path.read_bytes())
        except (OSError, struct.error):
            return None
        if not self._supervisor or supervisor != self._supervisor:
            return None
        return Progress(publisher, (numbers[0], numbers[1]), (numbers[2], numbers[3]))

    def write(self, progress: Progress) -> None:
        if not self._supervisor:
            return
        if self._file is None:
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        form = _FORM.pack(self._supervisor, progress.publisher, *progress.sequence, *progress.mark)
        os.pwrite(self._file, form, 0)

    def close(self, *, finished: bool) -> None:
        """Stop keeping it; one that is finished has no progress any more."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if finished and self._supervisor:
            self._path.unlink(missing_ok=True)
