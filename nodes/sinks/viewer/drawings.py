"""The drawings of the last minutes, as browsers get them: those that are there, then each as it comes."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator

MOST_BYTES = 2**28
"""of drawings that are kept for browsers that come later: about five minutes of one body"""
FIRST = 100
"""pieces that are never let go: names, colours and layout are among them"""
WAIT_S = 0.5
"""for the next piece, before a reader looks whether its browser is still there"""


class Drawings:
    """Pieces of Rerun's data format, each whole by itself. For several threads."""

    def __init__(self) -> None:
        self._first: list[bytes] = []
        self._later: deque[bytes] = deque()
        self._let_go = 0
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()

    def add(self, piece: bytes) -> None:
        """Keep a piece, and let the oldest go."""
        with self._changed:
            if len(self._first) < FIRST:
                self._first.append(piece)
            else:
                self._later.append(piece)
                self._bytes += len(piece)
            while self._bytes > MOST_BYTES:
                self._bytes -= len(self._later.popleft())
                self._let_go += 1
            self._changed.notify_all()

    def follow(self) -> Iterator[bytes]:
        """The pieces that are kept, then each that comes; an empty one now and then, while none does."""
        at = 0  # of all that ever were
        while not self._closed:
            with self._changed:
                first, later = self._first[at:], []
                if not first:
                    start = max(at - FIRST - self._let_go, 0)
                    later = [self._later[index] for index in range(start, len(self._later))]
                    at = FIRST + self._let_go + len(self._later) if later else at
                at += len(first)
                if not first and not later:
                    self._changed.wait(WAIT_S)
            yield from first or later or [b""]

    def close(self) -> None:
        """End what readers follow."""
        self._closed = True
        with self._changed:
            self._changed.notify_all()
