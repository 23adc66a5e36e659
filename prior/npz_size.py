"""Size limit of the arrays of an ``.npz``, checked by their headers: two megabytes may unpack to five thousand."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO

from numpy.lib import format as npy

MAX_BYTES = 2**29
"""of one array: nine hours of a skeleton of 22 joints at 30 frames a second, in double precision"""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def check_arrays(file: IO[bytes] | Path) -> None:
    """Look at every array's header.

    Raises:
        ValueError: an array is larger than `MAX_BYTES`, or not as large as its header says.
        zipfile.BadZipFile, OSError: it is no archive, or cannot be read.
    """
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if not entry.filename.endswith(".npy"):
                continue
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
    if not isinstance(file, Path):
        file.seek(0)
