"""The newest camera image for the viewer, in a file of this user beside the sockets. Enabled by ``[input] image``.

It is a file and not a message, so that images of people appear in no recording and on no network.
"""

import os
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats

NAME = "image"  # name of the file in the directory of the sockets
PERIOD_NS = 66_000_000
"""Shortest interval between images, nanoseconds. Half of a camera's frames are enough for viewing."""
WIDTH = 480  # largest width of a stored image, pixels
_HEAD = struct.Struct("<q2I4d")


class CameraImage(NamedTuple):
    """An image, and the intrinsics that project points in the camera's optical frame into it."""

    stamp_ns: int
    size: tuple[int, int]  # width and height in pixels
    intrinsics: Floats  # (3, 3) pixels
    jpeg: bytes


class ImageWriter:
    """Writes the newest image to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp_ns: int | None = None

    def put(self, image: NDArray[Any], stamp_ns: int, intrinsics: Floats) -> None:
        """Store an undistorted BGR image (H, W, 3), unless the last one is younger than `PERIOD_NS`."""
        if self._stamp_ns is not None and 0 <= stamp_ns - self._stamp_ns < PERIOD_NS:
            return
        import cv2  # imported late: installed only with the extras of sources that have images

        self._stamp_ns = stamp_ns
        height, width = image.shape[:2]
        size = (min(width, WIDTH), round(height * min(1.0, WIDTH / width)))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 75])
        scale = size[0] / width
        lens = intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] * scale
        part = self._path.with_suffix(".part")
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
            file.write(_HEAD.pack(stamp_ns, *size, *lens) + jpeg.tobytes())
        part.replace(self._path)

    def close(self) -> None:
        """Delete the file."""
        self._path.unlink(missing_ok=True)


class ImageReader:
    """Reads the image of an `ImageWriter` of the same machine and user."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed_ns = 0

    def next(self) -> CameraImage | None:
        """The newest image; None if there is none or it was already returned."""
        try:
            changed_ns = self._path.stat().st_mtime_ns
            if changed_ns == self._changed_ns:
                return None
            data = self._path.read_bytes()
        except FileNotFoundError:
            return None
        self._changed_ns = changed_ns
        stamp_ns, width, height, fx, fy, cx, cy = _HEAD.unpack_from(data)
        intrinsics = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return CameraImage(stamp_ns, (width, height), intrinsics, data[_HEAD.size :])
