"""Our own processes: safe start, release of start-up memory, signals, and systemd notifications."""

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
    # equivalent of python -P, which 3.10 lacks
    "import sys; sys.path[:] = [p for p in sys.path if p]; "
    "from importlib import import_module; module, _, name = sys.argv.pop(1).partition(':'); "
    "sys.exit(getattr(import_module(module), name)())"
)


def own_command(function: str, *arguments: str) -> list[str]:
    """The command line of a process that calls a function, ``module:name``, and exits with its return value."""
    return [sys.executable, "-c", _SCRIPT, function, *arguments]


def own_environment() -> dict[str, str]:
    """The environment for such a process. It drops empty parts of PYTHONPATH, which mean the working directory."""
    found = dict(os.environ)
    if parts := found.get("PYTHONPATH"):
        found["PYTHONPATH"] = os.pathsep.join(part for part in parts.split(os.pathsep) if part)
    return found | {"PYTHONSAFEPATH": "1"}


_DONTNEED = 4  # ``MADV_DONTNEED`` of madvise(2)
_COMPILED = "STEADYPOSE_COMPILED"  # name of the environment variable that marks a process restarted after compiling
_STARTS_WITH = 400_000
"""Garbage collector's threshold during start-up, objects. A start that compiles nothing creates fewer."""


@contextmanager
def startup() -> Iterator[None]:
    """Context for a process's start-up: no garbage collection during it, and memory returned after it.

    Imports and loading create 200,000 permanent objects. Collecting during start-up would take a tenth of its time, and
    scanning the permanent objects later 50 ms per collection, so they are frozen.

    Only a process that compiles loops creates more. `loops.compile_missing` compiles those of the default settings;
    other settings may need further loops, and a damaged one is compiled again. Compiling leaves up to 400 MB allocated,
    so the process then re-executes itself once and loads the loops from disk.
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
    """Call ``stop`` on SIGTERM, SIGINT and SIGHUP.

    SIGINT is handled even if a shell started the process in the background and made it ignore SIGINT. SIGHUP stays
    ignored if nohup(1) ignores it.
    """
    for request in (signal.SIGTERM, signal.SIGINT):
        signal.signal(request, stop)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, stop)


def _give_back() -> None:
    """Return malloc's free memory and LLVM's code pages to the system.

    A process with loaded loops compiles none; if it does after all, the pages are read from the file again.
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
    """Send a state of sd_notify(3) to the service manager, if there is one."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.sendto(state.encode(), address.replace("@", "\0", 1) if address.startswith("@") else address)
