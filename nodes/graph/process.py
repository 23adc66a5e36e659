"""Processes of our own: how one is started safely, what its start gives back, its signals, and its notes to systemd."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_SCRIPT = (
    # as python -P, which 3.10 does not have
    "import sys; sys.path[:] = [p for p in sys.path if p]; "
    "from importlib import import_module; module, _, name = sys.argv.pop(1).partition(':'); "
    "sys.exit(getattr(import_module(module), name)())"
)


def own_command(function: str, *arguments: str) -> list[str]:
    """The command line of a process that calls a function, and exits with what it returns.

    Args:
        function: as ``module:name``.
        arguments: what it finds in `sys.argv`.
    """
    return [sys.executable, "-c", _SCRIPT, function, *arguments]


def own_environment() -> dict[str, str]:
    """This process' environment for such a process: without the working folder, which an empty part of a path means."""
    found = dict(os.environ)
    if parts := found.get("PYTHONPATH"):
        found["PYTHONPATH"] = os.pathsep.join(part for part in parts.split(os.pathsep) if part)
    return found | {"PYTHONSAFEPATH": "1"}


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


READY = "READY=1"
ALIVE = "WATCHDOG=1"
STOPPING = "STOPPING=1"


def notify(state: str) -> None:
    """Send a line of the protocol of sd_notify(3) to who started this process, if it listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.sendto(state.encode(), address.replace("@", "\0", 1) if address.startswith("@") else address)
