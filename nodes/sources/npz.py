"""Poses as ``.npz``: the plain arrays that a researcher has and wants, in place of a recording.

In: ``positions`` (T, J, 3) metres, NaN where missing; ``skeleton``, a name; ``stamp_ns`` (T,) or ``fps``; and where
known ``confidence`` (T, J) in 0..1 and ``up``, the axis that points up (``z``, ``y`` or ``-y``).

Out, one row for each row in: ``stamp_ns`` (T,), ``positions`` (T, 22, 3) metres in the input's frame, ``rotations``
(T, 22, 4) local, xyzw, ``state`` (T, 22) `msgs.types.JointState`, ``sigma`` (T, 22) metres, ``anomaly`` (T,),
``anomaly_flag`` (T,), ``contacts`` (T, 8), ``root_velocity`` (T, 3) m/s, ``world_positions`` (T, 22, 3) metres,
and ``joint_names`` (22,). Where the prior gave no body, numbers are NaN and the state is UNKNOWN. With several
bodies an axis for them comes after time, and ``body_id`` (B,) names them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import JOINTS, Message, Pose, PoseClean, PoseRaw, PoseWorld, RawBody
from steadypose.prior.body.layouts import SKELETONS

PERIOD_NS = 1_000_000_000 / 30
"""of the grid the prior answers on"""
SLACK_NS = 1_000_000
STAMPS_END_NS = 2**31 * 10**9
"""ROS 2 counts seconds in 31 bits"""

_ROW = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("positions", np.float32, (22, 3)),
        ("world_positions", np.float32, (22, 3)),
        ("rotations", np.float32, (22, 4)),
        ("sigma", np.float32, (22,)),
        ("contacts", np.float32, (8,)),
        ("root_velocity", np.float64, (3,)),
        ("anomaly", np.float64),
        ("state", np.uint8, (22,)),
        ("anomaly_flag", np.bool_),
    ]
)
_ARRAYS = ("positions", "skeleton", "stamp_ns", "fps", "confidence", "up")
_NEAREST = ("state", "anomaly_flag")


class NpzError(ValueError):
    """An ``.npz`` that does not hold poses. The text says what was expected, what came, and what to do."""


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
        self._skeleton = _text(path, arrays, "skeleton")
        if self._skeleton not in SKELETONS:
            raise NpzError(f"{path}: skeleton: expected one of {', '.join(SKELETONS)}, got {self._skeleton!r}")
        joints = len(SKELETONS[self._skeleton].joints)
        self._positions = _numbers(path, arrays, "positions")
        if self._positions.ndim != 3 or self._positions.shape[1:] != (joints, 3):
            raise NpzError(
                f"{path}: positions: expected shape (T, {joints}, 3) for {self._skeleton}, got "
                f"{self._positions.shape}; give one body a file, metres, and NaN for what is missing"
            )
        frames = len(self._positions)
        if not frames:
            raise NpzError(f"{path}: positions: expected at least one frame, got none")
        self.stamps_ns = _stamps(path, arrays, frames)
        """(T,) int64"""
        self._confidence = np.asarray(np.isfinite(self._positions).all(axis=-1), np.float32)
        if "confidence" in arrays:
            self._confidence = _numbers(path, arrays, "confidence")
            if self._confidence.shape != (frames, joints):
                raise NpzError(f"{path}: confidence: expected {(frames, joints)}, got {self._confidence.shape}")
        try:
            self._sensor_pose = Pose.from_up(_text(path, arrays, "up") if "up" in arrays else "z")
        except ValueError as error:
            raise NpzError(f"{path}: {error}") from error

    def __len__(self) -> int:
        return len(self._positions)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        for stamp_ns, positions, confidence in zip(self.stamps_ns, self._positions, self._confidence, strict=True):
            yield (
                POSE_RAW,
                PoseRaw(
                    stamp_ns=int(stamp_ns),
                    frame_id="sensor",
                    source=self.path.stem,
                    skeleton=self._skeleton,
                    sensor_pose=self._sensor_pose,
                    calibrated=False,
                    bodies=[RawBody(id=0, positions=positions, confidence=confidence)],
                ),
            )


class NpzSource(ArraySource):
    """The frames of an ``.npz`` as messages; a source for the input node and for ``steadypose clean``.

    Raises:
        NpzError: an array is missing, or has the wrong form.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, _load(path))


class NpzCollector:
    """Gathers the answers of both pipelines on their 30 Hz grid, and gives them at the stamps of the input."""

    def __init__(self) -> None:
        self._rows: dict[int, list[NDArray[np.void]]] = {}
        self._newest: dict[int, NDArray[np.void]] = {}

    def add(self, message: Message) -> None:
        """Take the next message of the stream; of each moment ``pose/clean`` comes before ``pose/world``."""
        if isinstance(message, PoseClean):
            self._newest = {}
            for body in message.bodies:
                row = self._newest[body.id] = _blank(())
                row["stamp_ns"] = message.stamp_ns
                for name in ("positions", "rotations", "state", "sigma", "anomaly", "anomaly_flag"):
                    row[name] = getattr(body, name)
                self._rows.setdefault(body.id, []).append(row)
        elif isinstance(message, PoseWorld):
            for body in message.bodies:
                row = self._newest.get(body.id)
                if row is not None and row["stamp_ns"] == message.stamp_ns:
                    row["world_positions"] = body.positions
                    row["root_velocity"] = body.root_velocity
                    row["contacts"] = body.contacts

    def arrays(self, stamps_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """The arrays of the output at ``stamps_ns`` (T,), by name."""
        tracks = [_at(np.stack(rows), stamps_ns) for rows in self._rows.values()]
        table = np.stack(tracks, axis=1) if tracks else _blank((len(stamps_ns), 1))
        several = len(tracks) > 1
        arrays: dict[str, NDArray[Any]] = {
            name: table[name] if several else table[name][:, 0] for name in _ROW.names or () if name != "stamp_ns"
        }
        arrays |= {"stamp_ns": stamps_ns, "joint_names": np.array(JOINTS)}
        return arrays | {"body_id": np.array(list(self._rows), np.int32)} if several else arrays


def _blank(shape: tuple[int, ...]) -> NDArray[np.void]:
    rows = np.zeros(shape, _ROW)
    for name in _ROW.names or ():
        if rows[name].dtype.kind == "f":
            rows[name] = np.nan
    return rows


def _at(grid: NDArray[np.void], stamps_ns: NDArray[np.int64]) -> NDArray[np.void]:
    """Rows of one body at other stamps: interpolated between neighbours of the grid, held for a period at its ends."""
    grid = grid[np.unique(grid["stamp_ns"], return_index=True)[1]]
    after = np.searchsorted(grid["stamp_ns"], stamps_ns, side="right").clip(1, max(len(grid) - 1, 1))
    before, after = after - 1, np.minimum(after, len(grid) - 1)
    first, last = grid["stamp_ns"][before], grid["stamp_ns"][after]
    span = last - first
    share = (stamps_ns - first) / np.maximum(span, 1)
    nearest = np.where(np.abs(stamps_ns - first) <= np.abs(last - stamps_ns), before, after)
    # a gap in the grid, and the ends, have one neighbour at most
    between = (span <= 1.5 * PERIOD_NS) & (share >= 0) & (share <= 1)
    known = between | (np.abs(grid["stamp_ns"][nearest] - stamps_ns) <= PERIOD_NS + SLACK_NS)
    before, after = np.where(between, before, nearest), np.where(between, after, nearest)
    share = np.where(between, share, 0.0)

    rows = _blank(stamps_ns.shape)
    for name in _ROW.names or ():
        values = grid[name]
        if name in _NEAREST:
            rows[name][known] = values[nearest][known]
        elif name != "stamp_ns":
            mix = _slerp if name == "rotations" else _lerp
            weight = share.reshape(-1, *[1] * (values.ndim - 1))
            mixed = mix(values[before].astype(np.float64), values[after].astype(np.float64), weight)
            rows[name][known] = np.where(np.isnan(mixed), values[nearest], mixed)[known]
    rows["stamp_ns"] = stamps_ns
    return rows


def _lerp(a: NDArray[np.float64], b: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    return a + share * (b - a)


def _slerp(a: NDArray[np.float64], b: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (..., 4) on the shorter arc from ``a`` to ``b``."""
    cosine = (a * b).sum(axis=-1, keepdims=True)
    b, angle = np.where(cosine < 0, -b, b), np.arccos(np.minimum(np.abs(cosine), 1.0))
    small = angle < 1e-4
    sine = np.where(small, 1.0, np.sin(angle))
    from_a = np.where(small, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    from_b = np.where(small, share, np.sin(share * angle) / sine)
    return from_a * a + from_b * b


def _load(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise NpzError(f"{path}: expected an .npz with named arrays, got a single array")
            return {name: file[name] for name in _ARRAYS if name in file}
    except NpzError:
        raise
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


def _stamps(path: Path, arrays: Mapping[str, NDArray[Any]], frames: int) -> NDArray[np.int64]:
    if "stamp_ns" in arrays:
        stamps = arrays["stamp_ns"]
        fit = stamps.dtype.kind in "iu" and stamps.shape == (frames,)
        if not fit or stamps.min() < 0 or stamps.max() >= STAMPS_END_NS:
            span = f", {stamps.min()} to {stamps.max()}" if stamps.size and stamps.dtype.kind in "iuf" else ""
            raise NpzError(
                f"{path}: stamp_ns: expected {frames} integers of 0 or more and under {STAMPS_END_NS}, nanoseconds of "
                f"capture; got {stamps.dtype} of shape {stamps.shape}{span}"
            )
        return stamps.astype(np.int64)
    if "fps" in arrays:
        fps = arrays["fps"]
        if fps.dtype.kind not in "fiu" or fps.size != 1 or not 0 < fps.item() < 1e6:
            raise NpzError(f"{path}: fps: expected one number above 0 and under a million, got {fps!r}")
        if frames / fps.item() * 1e9 >= STAMPS_END_NS:
            raise NpzError(f"{path}: fps: {frames} frames at {fps.item():g} a second last longer than stamps can tell")
        return np.round(np.arange(frames) * (1e9 / float(fps.item()))).astype(np.int64)
    raise NpzError(f"{path}: expected stamp_ns (T,), nanoseconds of capture, or fps; got neither")
