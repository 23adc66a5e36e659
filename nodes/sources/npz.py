"""Poses as plain arrays: from an ``.npz``, also one written by ``steadypose clean``, and from motion capture files.

Required arrays: ``positions`` (T, J, 3) metres, NaN where missing; ``skeleton``, a layout's name; ``stamp_ns`` (T,) or
``fps``. Optional arrays: ``confidence`` (T, J) 0 to 1, or True where a joint was seen; ``up``, the axis that points up
(``z``, ``y`` or ``-y``).

For several bodies: ``positions`` (T, B, J, 3), all NaN where a body is absent; ``confidence`` (T, B, J); and
``body_id`` (B,), their ids (default 0, 1, …).
"""

import difflib
import logging
import zipfile
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import OBSERVED, Message, Pose, PoseRaw, RawBody
from steadypose.nodes.checks.layout import axes_hint, count_hint, skeleton_hint, stamps_hint
from steadypose.nodes.settings import as_text
from steadypose.prior.body.layouts import CANONICAL, SKELETONS, layout_names
from steadypose.prior.clean.admission import MAX_DISTANCE
from steadypose.prior.npz import check_arrays

logger = logging.getLogger(__name__)

CLEANED = ("world_positions", "state")  # names of arrays that an output has and an input lacks
Arrays = Mapping[str, NDArray[Any]]


def is_output(arrays: Arrays) -> bool:
    """Whether arrays are an output of ``steadypose clean``: without a skeleton's name, with joints in the world."""
    return "skeleton" not in arrays and all(name in arrays for name in CLEANED)


def as_input(arrays: Arrays) -> Arrays:
    """Convert the arrays of an output to those of an input: observed joints in the world, z up; imputed ones are NaN.

    The arrays of an input are returned unchanged.
    """
    if not is_output(arrays):
        return arrays
    observed = np.isin(arrays["state"], OBSERVED)
    positions = np.where(observed[..., None], arrays["world_positions"], np.nan)
    kept = {name: arrays[name] for name in ("stamp_ns", "body_id") if name in arrays}
    return kept | {"positions": positions, "skeleton": np.array(CANONICAL.name), "up": np.array("z")}


STAMPS_END_NS = 2**31 * 10**9  # upper bound of stamps, nanoseconds. ROS 2 stores seconds in an int32.
_ARRAYS = ("positions", "skeleton", "stamp_ns", "fps", "confidence", "up", "body_id")
_OPTIONAL = {"confidence", "up", "body_id"}


class NpzError(ValueError):
    """An ``.npz`` that does not contain poses. The text says what was expected, what came, and what to do."""


class ArraySource:
    """The frames of arrays, by their names in an ``.npz`` (see the module), as messages; ``path`` names them in errors.

    Raises NpzError if an array is missing, or has the wrong form.
    """

    def __init__(self, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        if "skeleton" not in arrays and "positions" in arrays:
            raise NpzError(f"{path}: expected an array 'skeleton', a name{count_hint(arrays['positions'].shape)}")
        self._skeleton = _text(path, arrays, "skeleton")
        if self._skeleton not in SKELETONS:
            hint = skeleton_hint(self._skeleton, np.shape(arrays.get("positions", ())))
            raise NpzError(f"{path}: skeleton: expected one of {layout_names()}, got {self._skeleton!r}{hint}")
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
        """(T,) capture times, nanoseconds"""
        confidence = np.asarray(np.isfinite(positions).all(axis=-1), np.float32)
        if "confidence" in arrays:
            confidence = _numbers(path, arrays, "confidence", "fiub")
            if confidence.shape != positions.shape[:-1]:
                raise NpzError(f"{path}: confidence: expected {positions.shape[:-1]}, got {confidence.shape}")
        self._positions = positions.reshape(frames, -1, joints, 3)
        self._confidence = confidence.reshape(frames, -1, joints)
        self._ids = _ids(path, arrays, self._positions.shape[1])
        self.bodies = tuple(self._ids) if positions.ndim == 4 else ()
        """ids along the axis of bodies; none if the positions have no such axis"""
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
            source = as_text(self.path.stem)
            yield (POSE_RAW, PoseRaw(int(stamp_ns), "sensor", source, self._skeleton, self._sensor_pose, False, bodies))


class NpzSource(ArraySource):
    """The frames of an ``.npz`` as messages. Raises NpzError if an array is missing, or has the wrong form."""

    def __init__(self, path: Path) -> None:
        arrays = read_arrays(path, known := (*_ARRAYS, *CLEANED))
        # a misspelt array that may be missing would be ignored without a word
        for name in {Path(entry).stem for entry in zipfile.ZipFile(path).namelist()} - set(known):
            if close := difflib.get_close_matches(name, _OPTIONAL - set(arrays), n=1, cutoff=0.75):
                raise NpzError(f"{path}: expected an array {close[0]!r}, or none of a similar name; it has {name!r}")
        super().__init__(path, as_input(arrays))


def read_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays ``names`` of an ``.npz``, if it has them; None reads all.

    Raises NpzError if the file cannot be read, or contains pickled objects, which could run code.
    """
    if not zipfile.is_zipfile(path):
        raise NpzError(f"{path}: cannot be read as .npz: expected a zip archive of arrays, as numpy.savez writes it")
    try:
        check_arrays(path)
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file if names is None or name in names}
    except Exception as error:  # for damaged files, zipfile, zlib and numpy raise a dozen kinds of exceptions
        hint = "; save arrays of numbers, not lists of different lengths" * ("allow_pickle" in str(error))
        raise NpzError(f"{path}: cannot be read as .npz: {error}{hint}") from error


def _array(path: Path, arrays: Mapping[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in arrays:
        # `arrays` are those that are known: a misspelt one is in the file alone
        there = [Path(n).stem for n in zipfile.ZipFile(path).namelist()] if zipfile.is_zipfile(path) else list(arrays)
        got = f"got {', '.join(there) or 'none'}; needed are positions (T, J, 3), skeleton, and fps or stamp_ns"
        raise NpzError(f"{path}: expected an array {name!r}, {got}")
    return arrays[name]


def _numbers(path: Path, arrays: Mapping[str, NDArray[Any]], name: str, kinds: str = "fiu") -> NDArray[np.float32]:
    array = _array(path, arrays, name)
    if array.dtype.kind not in kinds:
        raise NpzError(f"{path}: {name}: expected numbers, got {array.dtype}")
    with np.errstate(over="ignore"):  # values too large for float32 become infinite, and are refused later
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
        expected = f"{bodies} different integers of 32 bits, one for each body of positions"
        raise NpzError(f"{path}: body_id: expected {expected}; got {ids.dtype} of shape {ids.shape}")
    return ids.tolist()


def read_stamps(path: Path, arrays: Mapping[str, NDArray[Any]], frames: int) -> NDArray[np.int64]:
    """(T,) capture times, nanoseconds: ``stamp_ns``, or counted from 0 at ``fps``.

    Raises NpzError if both are missing, or of the wrong length, or too large for a message.
    """
    if "stamp_ns" in arrays:
        stamps = arrays["stamp_ns"]
        fit = stamps.dtype.kind in "iu" and stamps.shape == (frames,)
        if not fit or stamps.min() < 0 or stamps.max() >= STAMPS_END_NS:
            span = f", {stamps.min()} to {stamps.max()}" if stamps.size and stamps.dtype.kind in "iuf" else ""
            expected = f"{frames} integers of 0 or more and under {STAMPS_END_NS}, nanoseconds of capture"
            got = f"{stamps.dtype} of shape {stamps.shape}{span}{stamps_hint(stamps, frames)}"
            raise NpzError(f"{path}: stamp_ns: expected {expected}; got {got}")
        return stamps.astype(np.int64)
    if "fps" in arrays:
        fps = arrays["fps"]
        if fps.dtype.kind not in "fiu" or fps.size != 1 or not 0 < fps.item() < 1e6:
            raise NpzError(f"{path}: fps: expected one number above 0 and under a million, got {fps!r}")
        if frames / fps.item() * 1e9 >= STAMPS_END_NS:
            raise NpzError(f"{path}: fps: {frames} frames at {fps.item():g} a second last longer than stamps can hold")
        return np.round(np.arange(frames) * (1e9 / float(fps.item()))).astype(np.int64)
    hint = ": of a regular stream give fps, 30 for instance" if "positions" in arrays else ""
    raise NpzError(f"{path}: expected stamp_ns (T,), nanoseconds of capture, or fps; got neither{hint}")


SUFFIXES = (".bvh", ".trc", ".c3d", ".npy")
"""File name suffixes of motion capture. An .npz may contain motion capture, too."""


class MotionSource(ArraySource):
    """The body in a motion capture file, in canonical joints, z up. Raises MotionError if there is none.

    ``rig`` is what the file itself lacks (`prior.mocap.files.Description`), as a TOML table. A body far from the file's
    origin is given relative to the middle of its path, where the sensor is then said to be; the world is the file's.
    """

    def __init__(self, path: Path, rig: Mapping[str, Any]) -> None:
        from steadypose.prior.mocap.files import describe, read_motion  # imported late, because it imports scipy

        fps, positions = read_motion(path.name, path.read_bytes(), describe(rig))
        place = _middle(positions)
        arrays = {"positions": positions - place, "skeleton": np.array(CANONICAL.name), "fps": np.array(fps)}
        super().__init__(path, arrays)
        self._sensor_pose = Pose(place, self._sensor_pose.orientation)
        if place.any():
            text = "%s: the body is far from the origin: positions are relative to %s m, except in the world"
            logger.warning(text, path, place.round(2).tolist())


def _middle(positions: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3,) metres: the middle of the joints (T, J, 3), along axes on which they are too far away to be used; else 0."""
    joints = positions[np.isfinite(positions).all(axis=-1)]
    if not len(joints):
        return np.zeros(3)
    ends = np.percentile(joints.astype(np.float64), [1, 99], axis=0)  # some joints may be anywhere
    return np.where(np.abs(ends).max(axis=0) > MAX_DISTANCE, ends.mean(axis=0), 0.0)


def holds_motion(path: Path) -> bool:
    """Whether a file is motion capture: by its suffix, or an .npz with the arrays of AMASS."""
    if path.suffix.lower() in SUFFIXES:
        return True
    if path.suffix != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return {"poses.npy", "trans.npy"} <= set(archive.namelist())
