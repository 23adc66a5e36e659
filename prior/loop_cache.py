"""On-disk cache of compiled loops: keyed by their sources, verified by digest, and recompiled if damaged.

numba's own cache has four problems. An empty or truncated index file (after a power failure) raises an exception at
every later start. Two processes that compile at once can mix up their entries. A function is not recompiled when a
function that it calls changes. Without a writable folder, nothing runs. Here, each entry is one file that is written
atomically, and its name contains a digest of everything that it was compiled from. Unreadable entries are ignored.

Entries are pickles, so folders that other users can write to are not read.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import logging
import os
import pickle
import platform
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from steadypose import PACKAGE

logger = logging.getLogger(__name__)

LOOPS = 165  # number of entries that the nodes need with the default settings
COMPLETE = "complete"  # name of a file beside the entries: the digest of the sources for which all entries exist
_OTHERS = 3  # number of folders of other versions and processors that are kept
_UNFINISHED = ".unfinished-"
_MUCH = 5 * LOOPS
"""Number of unused entries above which they are removed."""
_WARNED = "STEADYPOSE_UNCACHED"
"""Environment variable that is set once a parent process has warned that nothing can be cached."""
_DIGEST = hashlib.sha256().digest_size

saved: set[str] = set()  # names of the entries that this process has compiled and written
watchers: list[Callable[[str], None]] = []  # functions called with the name of each entry that is loaded or compiled


def folders() -> list[Path]:
    """Return the folders of entries in order of preference: beside the package, then in the user's cache folder.

    ``NUMBA_CACHE_DIR``, which numba also uses, replaces both.
    """
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(chosen).absolute() / "steadypose" / _version()]
    found = [PACKAGE / "__pycache__" / "loops" / _version()]
    with suppress(RuntimeError):  # a user without a home
        home = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(home) if os.path.isabs(home) else Path.home() / ".cache"
        found.append(base / "steadypose" / "loops" / _version())
    return found


@cache
def _version() -> str:
    """Return a name for everything that entries depend on besides sources: Python, numba, and the processor."""
    about = [importlib.metadata.version(name) for name in ("numba", "llvmlite", "numpy")]
    about += [os.environ.get(name, "") for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_OPT")]
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        about += sorted({line for line in file if line.startswith(("model name", "flags", "Features", "CPU part"))})
    digest = hashlib.sha256("\n".join(about).encode()).hexdigest()[:12]
    return f"{sys.implementation.cache_tag}-{platform.machine()}-{digest}"


def readable() -> Iterator[Path]:
    """Return the existing folders that no other user can write to."""
    return (folder for folder in folders() if folder.is_dir() and _is_safe(folder))


@cache
def writable() -> Path | None:
    """Return the first folder to which entries can be written, created if missing; None if there is none."""
    for folder in folders():
        with suppress(OSError):
            folder.mkdir(mode=0o755, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            if _is_safe(folder):
                return folder
    return None


def _is_safe(folder: Path) -> bool:
    status = folder.stat()
    others = stat.S_IWOTH if status.st_gid == os.getgid() else stat.S_IWOTH | stat.S_IWGRP
    return status.st_uid in (0, os.getuid()) and not status.st_mode & others


def is_complete() -> bool:
    """Whether all loops of the nodes have been compiled from these sources on this machine."""
    for folder in readable():
        with suppress(OSError):
            if (folder / COMPLETE).read_text(encoding="ascii") == _sources():
                return True
    return False


def mark_complete(folder: Path, entries: set[str]) -> None:
    """Note that everything is compiled. Remove old versions, and entries other than these if there are many."""
    others = [file for file in folder.iterdir() if file.name not in (*entries, COMPLETE)]
    for file in others if len(others) > _MUCH else ():
        with suppress(OSError):
            file.unlink()
    _write(folder / COMPLETE, _sources().encode("ascii"))
    versions = [other for other in folder.parent.iterdir() if other.is_dir() and other != folder]
    for other in sorted(versions, key=lambda path: path.stat().st_mtime, reverse=True)[_OTHERS:]:
        with suppress(OSError):
            for file in other.iterdir():
                file.unlink()
            other.rmdir()


def _sources() -> str:
    digest = hashlib.sha256()
    for file in sorted((PACKAGE / "prior").rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def remove_damaged() -> int:
    """Remove damaged entries, and the mark that all entries exist; returns the number of damaged entries."""
    damaged = 0
    for folder in readable():
        for file in folder.iterdir():
            if file.name != COMPLETE and not file.name.startswith(_UNFINISHED) and _content(file) is None:
                damaged += 1
                with suppress(OSError):
                    file.unlink()
                    (folder / COMPLETE).unlink(missing_ok=True)
    return damaged


def _content(file: Path) -> bytes | None:
    """Return the content of an entry; None if it is damaged."""
    data = file.read_bytes()
    return data[_DIGEST:] if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST] else None


def load(name: str, key: object) -> Any | None:
    """Return the entry saved under this name, if it is undamaged and has this key."""
    for folder in readable():
        try:
            content = _content(folder / name)
            if content is None:
                logger.warning("steadypose: %s is damaged; compiling it anew", folder / name)
                continue
            saved_key, entry = pickle.loads(content)
        except FileNotFoundError:
            continue
        except Exception as error:  # unpickling raises many kinds, and a cache entry is not essential
            logger.warning("steadypose: %s cannot be used (%s); compiling it anew", folder / name, error)
            continue
        if saved_key == key:
            _notify_watchers(name)
            return entry
    return None


def save(name: str, data: bytes) -> None:
    """Write an entry atomically. If the disk is full, the loop is compiled again next time."""
    folder = writable()
    if folder is None:
        warn_uncached(logger.warning)
    else:
        with suppress(OSError):
            _write(folder / name, hashlib.sha256(data).digest() + data)
            saved.add(name)
    _notify_watchers(name)


@cache
def announce() -> None:
    """Log once per process that it compiles, to explain the delay."""
    if not watchers:  # watchers report progress themselves
        logger.warning("steadypose: compiling loops for this processor, once")


def _notify_watchers(name: str) -> None:
    for watcher in watchers:
        watcher(name)


def _write(file: Path, data: bytes) -> None:
    with tempfile.NamedTemporaryFile(dir=file.parent, prefix=_UNFINISHED, delete=False) as unfinished:
        try:
            unfinished.write(data)
            unfinished.flush()
            os.fchmod(unfinished.fileno(), 0o644)
            os.replace(unfinished.name, file)
        except OSError:
            os.unlink(unfinished.name)
            raise


def warn_uncached(say: Callable[[str], None]) -> None:
    """Warn that nothing can be cached, once for this process and its child processes."""
    if _WARNED in os.environ:
        return
    os.environ[_WARNED] = "1"
    tried = " nor ".join(str(folder.parent) for folder in folders())
    say(
        f"compiled loops cannot be kept: neither {tried} can be written to by this user alone, so every start compiles "
        "for half a minute or more; set XDG_CACHE_HOME to a folder that can be"
    )


@cache
def digest(loop: Any) -> str:
    """Return a digest of what a dispatcher is compiled from: its code, and the constants and loops that it names."""
    hasher = hashlib.sha256()
    for part in _parts(loop.py_func, loop):
        hasher.update(part.encode() + b"\0")
    hasher.update(repr(sorted(loop.targetoptions.items())).encode())
    return hasher.hexdigest()


def _parts(function: FunctionType, loop: object) -> Iterator[str]:
    yield f"{function.__module__}.{function.__qualname__}"
    for code in _codes(function.__code__):
        yield code.co_code.hex()
        constants = [c for c in code.co_consts if not isinstance(c, CodeType)]
        named = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        for value in (*constants, *code.co_names, *named, *cells):
            # numba's intrinsics write instructions; their class is not imported, because a camera's node needs no numba
            if intrinsic := getattr(value, "_defn", None):
                yield from _parts(intrinsic, loop)
            elif value is not loop:
                yield digest(value) if hasattr(value, "py_func") else _text(value)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _text(value: object) -> str:
    """Convert a value to text that is the same in every process."""
    if isinstance(value, (ModuleType, FunctionType, type)):
        return f"{value.__name__} {getattr(value, '_fields', '')}"
    if hasattr(value, "tobytes"):  # an array
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"  # type: ignore[attr-defined]
    return repr(value)
