"""What a node's start takes of time and memory, and gives back."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

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
    Only who compiles loops makes more than that. `loops.compile_missing` compiles those of the settings that ship;
    other settings may need more, and a damaged one is compiled again. Compiling leaves up to 400 MB, so the process
    then starts anew, once, with the loops that are now on disk.
    """
    thresholds = gc.get_threshold()
    gc.set_threshold(_STARTS_WITH)
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(*thresholds)
    cache = sys.modules.get("steadypose.prior.loop_cache")
    if cache is not None and cache.saved and _COMPILED not in os.environ:
        os.environ[_COMPILED] = "1"
        sys.stdout.flush()
        os.execv(sys.executable, sys.orig_argv)
    if sys.platform == "linux":
        _give_back()


def stop_on_signals(stop: Callable[[int, FrameType | None], object]) -> None:
    """Call this at what asks a process to stop: SIGTERM, Ctrl-C, also where a shell that starts it in the background
    ignores that, and the end of its terminal, unless nohup(1) had that ignored."""
    for request in (signal.SIGTERM, signal.SIGINT):
        signal.signal(request, stop)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, stop)


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
