"""Opens archives of arrays only if their headers respect a size limit, as two megabytes can unpack to five thousand."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy
from numpy.lib.npyio import NpzFile

MAX_BYTES = 2**29
"""Largest size of one array, bytes: nine hours of a 22-joint skeleton at 30 frames per second in double precision."""

MAX_RATIO = 100
"""Largest ratio of all arrays' bytes to the file's bytes, above `RATIO_FROM`; noisy joints have a ratio of ten."""
RATIO_FROM = 2**26
MAX_ARRAYS = 20_000
"""Largest number of arrays in a file. Checking a header takes 0.1 ms; UI-PRMD has three thousand arrays."""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class MotionError(ValueError):
    """A motion file is invalid; the message says what was expected and what was found."""


def check_arrays(file: IO[bytes] | Path) -> None:
    """Check every array's header.

    Raises:
        ValueError: an array is larger than `MAX_BYTES`, or its size differs from its header; or there are more than
            `MAX_ARRAYS` arrays, or all arrays together are much larger than the file.
        zipfile.BadZipFile, OSError: the file is no archive, or cannot be read.
    """
    with zipfile.ZipFile(file) as archive:
        entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
        if len(entries) > MAX_ARRAYS:
            raise ValueError(f"{len(entries)} arrays: expected at most {MAX_ARRAYS}")
        for entry in entries:
            name = entry.filename.removesuffix(".npy")
            if entry.file_size > MAX_BYTES:
                raise ValueError(f"{name}: {entry.file_size} bytes: expected at most {MAX_BYTES}; cut it into parts")
            with archive.open(entry) as array:
                version = npy.read_magic(array)
                if version not in _HEADERS:
                    raise ValueError(f"{name}: a header of version {version}: expected 1.0 or 2.0")
                shape, _, dtype = _HEADERS[version](array)
                if math.prod(shape) * dtype.itemsize > entry.file_size:
                    raise ValueError(f"{name}: expected {shape} {dtype}, found {entry.file_size} bytes")
        total, packed = sum(entry.file_size for entry in entries), sum(entry.compress_size for entry in entries)
        if total > max(RATIO_FROM, MAX_RATIO * packed):
            raise ValueError(
                f"{packed} bytes that become {total}: expected at most {MAX_RATIO} times as many; if it is as it "
                "should be, save it without compression (numpy.savez)"
            )


@contextmanager
def open_npz(file: IO[bytes] | Path, *needs: str) -> Iterator[NpzFile]:
    """Open an .npz that holds the arrays that it ``needs``.

    Raises:
        MotionError: it is no .npz, needs pickle (which can run code), or lacks an array.
    """
    name = f"{file}: " if isinstance(file, Path) else ""
    if not zipfile.is_zipfile(file):
        raise MotionError(f"{name}expected an .npz archive")
    try:
        check_arrays(file)
        if not isinstance(file, Path):
            file.seek(0)
        archive = np.load(file)
    except Exception as error:  # on damaged bytes, zipfile, zlib and numpy's header parser raise a dozen kinds
        raise MotionError(f"{name}expected an .npz archive: {error}") from error
    assert isinstance(archive, NpzFile), "np.load gives one for every zip archive"
    with archive:
        missing = set(needs) - set(archive.files)
        if missing:
            raise MotionError(
                f"{name}expected arrays {', '.join(sorted(missing))}; the file has {archive.files[:6]}..."
            )
        yield archive
