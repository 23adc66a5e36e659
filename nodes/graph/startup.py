"""What a node's start takes of time and memory, and gives back."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_DONTNEED = 4
"""``MADV_DONTNEED`` of madvise(2)"""

_COMPILED = "STEADYPOSE_COMPILED"
"""in the environment of a process that has started anew after compiling"""

_STARTS_WITH = 400_000
"""objects, more than any start makes that compiles nothing"""


@contextmanager
def startup() -> Iterator[None]:
    """Start within this: imports and loading make two hundred thousand objects that stay, and leave memory free.

    The garbage collector looks for none among them: not now, for a tenth of the time, nor ever, for 50 ms each time.
    Only who compiles loops makes more than that. Compiling leaves 400 MB, so the process then starts anew, with the
    loops that are now on disk; once, for where nothing can be written they are compiled each time.
    """
    thresholds, collections = gc.get_threshold(), gc.get_stats()[0]["collections"]
    gc.set_threshold(_STARTS_WITH)
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(*thresholds)
    if gc.get_stats()[0]["collections"] > collections and _COMPILED not in os.environ:
        os.environ[_COMPILED] = "1"
        sys.stdout.flush()
        os.execv(sys.executable, sys.orig_argv)
    if sys.platform == "linux":
        _give_back()


def _give_back() -> None:
    """Give back to the system what malloc has free, and the code of LLVM: who has loaded the loops compiles none.

    If one is compiled after all, its pages come back from the file.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)
    with suppress(OSError), open("/proc/self/maps", encoding="utf-8") as maps:
        for line in maps:
            if " r-xp " in line and "llvmlite" in line:
                begin, end = (int(address, 16) for address in line.split()[0].split("-"))
                libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _DONTNEED)
