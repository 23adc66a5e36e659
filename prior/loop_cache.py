"""Compiled loops on disk: found again by what they were compiled from, checked by digest, and compiled anew if damaged.

numba's own cache is a file with an index for each function, beside the source or in numba's folder: an empty or a cut
off file there (a power failure) is an exception at every later start, two processes that compile at once can exchange
each other's entries, a function is not compiled anew when one that it calls changes, and without a folder to write to
nothing runs. Here an entry is one file, written whole or not at all, and its name is a digest of all that it was
compiled from. An entry that cannot be read is none.

Entries are pickles, so a folder that somebody else could write to is not read either.
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

LOOPS = 150
"""entries that the nodes take with the settings that ship"""
COMPLETE = "complete"
"""beside the entries: the digest of the sources that all of them are there for"""
_OTHERS = 3
"""folders of other versions and processors that are kept"""
_UNFINISHED = ".unfinished-"
_MUCH = 5 * LOOPS
"""entries of sources and settings that are no more in use"""
_WARNED = "STEADYPOSE_UNCACHED"
"""in the environment, where a process that started this one has said that nothing can be kept"""
_DIGEST = hashlib.sha256().digest_size

saved: set[str] = set()
"""entries that this process has compiled and written"""
watchers: list[Callable[[str], None]] = []
"""called with the name of each entry as it is loaded or compiled"""


def folders() -> list[Path]:
    """Where entries may be, the first to be written to first: beside the package, or else in the user's cache folder.

    ``NUMBA_CACHE_DIR``, which numba itself obeys, replaces both.
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
    """Of all that makes one machine's entries useless for another: Python, numba, and what the processor can do."""
    about = [importlib.metadata.version(name) for name in ("numba", "llvmlite", "numpy")]
    about += [os.environ.get(name, "") for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_OPT")]
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        about += sorted({line for line in file if line.startswith(("model name", "flags", "Features", "CPU part"))})
    digest = hashlib.sha256("\n".join(about).encode()).hexdigest()[:12]
    return f"{sys.implementation.cache_tag}-{platform.machine()}-{digest}"


def readable() -> Iterator[Path]:
    """The folders that are there, and that nobody else can write to."""
    return (folder for folder in folders() if folder.is_dir() and _is_safe(folder))


@cache
def writable() -> Path | None:
    """The first folder that entries can be written to, made if it is missing; None: there is none."""
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
    """Whether all loops of the nodes have been compiled from these sources, on this machine."""
    for folder in readable():
        with suppress(OSError):
            if (folder / COMPLETE).read_text(encoding="ascii") == _sources():
                return True
    return False


def mark_complete(folder: Path, entries: set[str]) -> None:
    """Note that all is compiled; remove what is not of these ``entries`` where it has become much, and old versions."""
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
    """Remove entries that are not as they were written, and with them the mark that all are there; returns how many."""
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
    """What was written there; None: that is no longer what it holds."""
    data = file.read_bytes()
    return data[_DIGEST:] if hashlib.sha256(data[_DIGEST:]).digest() == data[:_DIGEST] else None


def load(name: str, key: object) -> Any | None:
    """What was saved under this name, if it is whole, and of this key."""
    for folder in readable():
        try:
            content = _content(folder / name)
            if content is None:
                logger.warning("steadypose: %s is damaged; compiling it anew", folder / name)
                continue
            found, entry = pickle.loads(content)
        except FileNotFoundError:
            continue
        except Exception as error:  # whatever unpickling raises; it is only a cache
            logger.warning("steadypose: %s cannot be used (%s); compiling it anew", folder / name, error)
            continue
        if found == key:
            _tell(name)
            return entry
    return None


def save(name: str, data: bytes) -> None:
    """Write an entry, whole or not at all. A full disk is no reason to stop: it is compiled the next time as well."""
    folder = writable()
    if folder is None:
        warn_uncached(logger.warning)
    else:
        with suppress(OSError):
            _write(folder / name, hashlib.sha256(data).digest() + data)
            saved.add(name)
    _tell(name)


@cache
def announce() -> None:
    """Say, once in a process, that it compiles: nobody should wonder what takes so long."""
    if not watchers:  # who says more
        logger.warning("steadypose: compiling loops for this processor, once")


def _tell(name: str) -> None:
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
    """Say that nothing can be kept: once, for this process and those that it starts."""
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
    """Of all that a loop is compiled from: its code, and the constants and loops of its module that it names.

    Args:
        loop: a dispatcher of numba.
    """
    function, found = loop.py_func, hashlib.sha256()
    for part in _parts(function, loop):
        found.update(part.encode() + b"\0")
    found.update(repr(sorted(loop.targetoptions.items())).encode())
    return found.hexdigest()


def _parts(function: FunctionType, loop: object) -> Iterator[str]:
    yield f"{function.__module__}.{function.__qualname__}"
    for code in _codes(function.__code__):
        yield code.co_code.hex()
        constants = [c for c in code.co_consts if not isinstance(c, CodeType)]
        named = [function.__globals__[name] for name in code.co_names if name in function.__globals__]
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        for value in (*constants, *code.co_names, *named, *cells):
            if value is not loop:
                yield digest(value) if hasattr(value, "py_func") else _text(value)


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _text(value: object) -> str:
    """A value as text that is the same in every process."""
    if isinstance(value, (ModuleType, FunctionType, type)):
        return f"{value.__name__} {getattr(value, '_fields', '')}"
    if hasattr(value, "tobytes"):  # an array
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"  # type: ignore[attr-defined]
    return repr(value)
