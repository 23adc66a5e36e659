"""Poses as ``.npz``: the plain arrays that a researcher has and wants, in place of a recording.

In: ``positions`` (T, J, 3) metres, NaN where missing; ``skeleton``, a name; ``stamp_ns`` (T,) or ``fps``; and where
known ``confidence`` (T, J) in 0..1 and ``up``, the axis that points up (``z``, ``y`` or ``-y``). Of several bodies,
``positions`` (T, B, J, 3), all NaN where one is not there, ``confidence`` (T, B, J), and ``body_id`` (B,), their
numbers, if they are not to be 0, 1, ….
"""

from __future__ import annotations

import zipfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import Message, Pose, PoseRaw, RawBody
from steadypose.nodes.checks.layout import axes_hint, count_hint, frames_hint, skeleton_hint, stamps_hint
from steadypose.nodes.sources.cleaned import CLEANED, as_input
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.npz import check_arrays

STAMPS_END_NS = 2**31 * 10**9
"""ROS 2 counts seconds in 31 bits"""

_ARRAYS = ("positions", "skeleton", "stamp_ns", "fps", "confidence", "up", "body_id")


class NpzError(ValueError):
    """An ``.npz`` that does not hold poses. The text says what was expected, what was found, and what to do."""


class ArraySource:
    """The frames of arrays, by their names in an ``.npz``, as messages; a source for `steadypose.clean`.

    Args:
        path: the file that they are of, or what errors should call them.
        arrays: as above.

    Raises:
        NpzError: an array is missing, or has the wrong form.
    """

    def __init__(self, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        if "skeleton" not in arrays and "positions" in arrays:
            raise NpzError(f"{path}: expected an array 'skeleton', a name{count_hint(arrays['positions'].shape)}")
        self._skeleton = _text(path, arrays, "skeleton")
        if self._skeleton not in SKELETONS:
            hint = skeleton_hint(self._skeleton, np.shape(arrays.get("positions", ())))
            raise NpzError(f"{path}: skeleton: expected one of {', '.join(SKELETONS)}, got {self._skeleton!r}{hint}")
        joints = len(SKELETONS[self._skeleton].joints)
        positions = _numbers(path, arrays, "positions")
        if positions.ndim not in (3, 4) or positions.shape[-2:] != (joints, 3):
            raise NpzError(
                f"{path}: positions: expected shape (T, {joints}, 3), or (T, bodies, {joints}, 3), for "
                f"{self._skeleton}, got {positions.shape}; in metres, NaN for what is missing"
                f"{axes_hint(positions.shape, self._skeleton)}"
            )
        frames = len(positions)
        if not frames:
            raise NpzError(f"{path}: positions: expected at least one frame, got none")
        self.stamps_ns = read_stamps(path, arrays, frames)
        """(T,) int64"""
        confidence = np.asarray(np.isfinite(positions).all(axis=-1), np.float32)
        if "confidence" in arrays:
            confidence = _numbers(path, arrays, "confidence")
            if confidence.shape != positions.shape[:-1]:
                raise NpzError(f"{path}: confidence: expected {positions.shape[:-1]}, got {confidence.shape}")
        self._positions = positions.reshape(frames, -1, joints, 3)
        self._confidence = confidence.reshape(frames, -1, joints)
        self._ids = _ids(path, arrays, self._positions.shape[1])
        try:
            self._sensor_pose = Pose.from_up(_text(path, arrays, "up") if "up" in arrays else "z")
        except ValueError as error:
            raise NpzError(f"{path}: {error}") from error

    def __len__(self) -> int:
        return len(self._positions)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        alone = len(self._ids) == 1
        for stamp_ns, positions, confidence in zip(self.stamps_ns, self._positions, self._confidence, strict=True):
            bodies = [
                RawBody(id=id, positions=joints, confidence=sure)
                for id, joints, sure in zip(self._ids, positions, confidence, strict=True)
                if alone or not np.isnan(joints).all()
            ]
            yield (
                POSE_RAW,
                PoseRaw(
                    stamp_ns=int(stamp_ns),
                    frame_id="sensor",
                    source=self.path.stem,
                    skeleton=self._skeleton,
                    sensor_pose=self._sensor_pose,
                    calibrated=False,
                    bodies=bodies,
                ),
            )


class NpzSource(ArraySource):
    """The frames of an ``.npz`` as messages; a source for the input node and for ``steadypose clean``.

    Raises:
        NpzError: an array is missing, or has the wrong form.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, as_input(read_arrays(path, (*_ARRAYS, *CLEANED))))


def read_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Those of the arrays ``names`` (None: of all) that an ``.npz`` holds.

    Raises:
        NpzError: it cannot be read, or holds what only pickle could read, which runs code.
    """
    if not zipfile.is_zipfile(path):
        raise NpzError(f"{path}: cannot be read as .npz: expected a zip archive of arrays, as numpy.savez writes it")
    try:
        check_arrays(path)
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file if names is None or name in names}
    except Exception as error:  # of damaged bytes zipfile, zlib and numpy's parser of headers raise a dozen kinds
        raise NpzError(f"{path}: cannot be read as .npz: {error}") from error


def _array(path: Path, arrays: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in arrays:
        raise NpzError(f"{path}: expected an array {name!r}; it has {', '.join(arrays) or 'none that are known'}")
    return arrays[name]


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], name: str) -> NDArray[np.float32]:
    array = _array(path, arrays, name)
    if array.dtype.kind not in "fiu":
        raise NpzError(f"{path}: {name}: expected numbers, got {array.dtype}")
    with np.errstate(over="ignore"):  # what does not fit is infinite, and refused as such where it is used
        return array.astype(np.float32)


def _text(path: Path, arrays: Mapping[str, NDArray[Any]], name: str) -> str:
    array = _array(path, arrays, name)
    if array.dtype.kind != "U" or array.size != 1:
        raise NpzError(f"{path}: {name}: expected one text, got {array.dtype} of shape {array.shape}")
    return str(array.item())


def _ids(path: Path, arrays: Mapping[str, NDArray[Any]], bodies: int) -> list[int]:
    if "body_id" not in arrays:
        return list(range(bodies))
    ids = arrays["body_id"]
    fit = ids.dtype.kind in "iu" and ids.shape == (bodies,) and len(set(ids.tolist())) == bodies
    if not fit or np.abs(ids.astype(np.float64)).max(initial=0) >= 2**31:
        raise NpzError(
            f"{path}: body_id: expected {bodies} different integers of 32 bits, one for each body of positions; got "
            f"{ids.dtype} of shape {ids.shape}"
        )
    return ids.tolist()


def read_stamps(path: Path, arrays: Mapping[str, NDArray[Any]], frames: int) -> NDArray[np.int64]:
    """(T,) nanoseconds of capture, from ``stamp_ns``, or counted from 0 by ``fps``.

    Raises:
        NpzError: there is neither, or not of this length, or beyond what a message can hold.
    """
    if "stamp_ns" in arrays:
        stamps = arrays["stamp_ns"]
        fit = stamps.dtype.kind in "iu" and stamps.shape == (frames,)
        if not fit or stamps.min() < 0 or stamps.max() >= STAMPS_END_NS:
            span = f", {stamps.min()} to {stamps.max()}" if stamps.size and stamps.dtype.kind in "iuf" else ""
            raise NpzError(
                f"{path}: stamp_ns: expected {frames} integers of 0 or more and under {STAMPS_END_NS}, nanoseconds of "
                f"capture; got {stamps.dtype} of shape {stamps.shape}{span}{stamps_hint(stamps, frames)}"
            )
        return stamps.astype(np.int64)
    if "fps" in arrays:
        fps = arrays["fps"]
        if fps.dtype.kind not in "fiu" or fps.size != 1 or not 0 < fps.item() < 1e6:
            raise NpzError(f"{path}: fps: expected one number above 0 and under a million, got {fps!r}")
        if frames / fps.item() * 1e9 >= STAMPS_END_NS:
            raise NpzError(f"{path}: fps: {frames} frames at {fps.item():g} a second last longer than stamps can hold")
        return np.round(np.arange(frames) * (1e9 / float(fps.item()))).astype(np.int64)
    raise NpzError(f"{path}: expected stamp_ns (T,), nanoseconds of capture, or fps; got neither{frames_hint(arrays)}")
