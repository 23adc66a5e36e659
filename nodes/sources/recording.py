"""Recorded sources: rosbag2 directory, ``.mcap``, ``.npz``, ``.csv``, motion capture file, or video."""

import csv
import dataclasses
import difflib
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose import PACKAGE
from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import POSE_RAW, POSE_TRUTH
from steadypose.msgs.types import Diagnostics, Message, Pose, PoseRaw, RawBody
from steadypose.nodes.checks.stamps import RATES_HZ
from steadypose.nodes.extras import require_extra
from steadypose.nodes.settings import STREAMS, LaunchError, as_text, located
from steadypose.nodes.sources.npz import MotionSource, NpzSource, holds_motion
from steadypose.nodes.sources.source import CalibrationSettings, RecordedSource, WebcamSettings
from steadypose.prior.body.layouts import SKELETONS, Skeleton, layout_names
from steadypose.prior.clean.admission import SLOWEST_NS
from steadypose.prior.settings import nearest

logger = logging.getLogger(__name__)

NO_RIG: Mapping[str, Any] = MappingProxyType({})
_FILES = ".csv, .npz, .bvh, .trc, .c3d, .npy"
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
"""File name suffixes of videos, in which MediaPipe detects skeletons."""
ANIMATIONS = (".fbx", ".glb", ".gltf", ".vrm", ".vrma")  # formats that are not read, but convert to BVH
LOST, BROKEN, UNDECODABLE = "bytes of a damaged recording", "damaged recording", "undecodable"
DAMAGE = (LOST, BROKEN, UNDECODABLE)  # prefixes of the causes that count unreadable parts of a recording


class RecordingSource:
    """The skeletons of a recording, without end-of-stream messages. Raises RecordingError if it has none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with RecordingReader(path) as recording:
            if not recording.count(POSE_RAW):
                got = f"{', '.join(recording.topics)}; record that topic too"
                raise RecordingError(f"{path}: expected messages on {POSE_RAW}, got {got}")
            self.refused: Counter[str] = Counter({LOST: recording.lost_bytes})
            self._frames = recording.count(POSE_RAW)

    def __len__(self) -> int:
        return self._frames

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        with RecordingReader(self.path) as recording:
            try:
                for topic, _, message in recording.messages([POSE_RAW, POSE_TRUTH]):
                    if not isinstance(message, Diagnostics) and not message.end_of_stream:
                        yield topic, message
            except RecordingError:
                self.refused[BROKEN] += 1
            self.refused[LOST] = recording.lost_bytes
            self.refused.update({f"{UNDECODABLE} {topic}": n for topic, n in recording.refused.items()})


def open_recording(path: str | Path, rig: Mapping[str, Any] = NO_RIG, image_file: Path | None = None) -> RecordedSource:
    """Open a recorded source: rosbag2 directory, ``.mcap``, ``.npz``, ``.csv``, motion capture file, or video.

    ``path`` may be the name of a bundled stream. ``rig`` describes a motion capture file, for what the file itself
    lacks (`prior.mocap.files.Description`); ``image_file`` is for the newest image of a video, for the viewer.

    Raises LaunchError if there is nothing at the path, or it is a video and MediaPipe is not installed; RecordingError,
    NpzError, CsvError or MotionError if the file contains no skeletons. All are ValueErrors that say what to do.
    """
    if not str(path):
        raise LaunchError(f"[input] recording: expected a recording, {_FILES} or a video, got none; give --input")
    path = located(str(path), Path(), STREAMS)
    if not path.exists():
        own = PACKAGE / STREAMS / path.name
        hint = f"; the bundled stream is {path.name!r}, without a folder" if own.is_dir() else ""
        if len(path.parts) == 1 and not path.suffix:
            hint = hint or nearest(path.name, (p.name for p in (PACKAGE / STREAMS).iterdir() if p.is_dir()))
        raise LaunchError(f"{path} does not exist: expected a rosbag2 directory, an .mcap, {_FILES}, or a video{hint}")
    motion = holds_motion(path)
    if rig and not motion:
        raise LaunchError(f"{path}: expected a motion capture file beside --rig, which describes one; leave --rig out")
    if path.suffix.lower() in VIDEOS:
        require_extra("webcam")
        from steadypose.nodes.sources.webcam_device import VideoSource  # OpenCV

        return VideoSource(WebcamSettings(video=str(path)), CalibrationSettings(), image_file=image_file)
    if motion:
        return MotionSource(path, rig)
    if path.is_file() and path.suffix not in (".npz", ".csv", ".mcap"):
        remedy = "; export its animation as .bvh" if path.suffix.lower() in ANIMATIONS else ""
        got = f"got {path.suffix!r}{remedy}"
        raise LaunchError(f"{path}: expected a rosbag2 directory, an .mcap, {_FILES}, or a video, {got}")
    formats: Mapping[str, Callable[[Path], RecordedSource]] = {".npz": NpzSource, ".csv": CsvSource}
    return formats.get(path.suffix, RecordingSource)(path)


def with_end(messages: Iterable[tuple[str, Message]]) -> Iterator[tuple[str, Message]]:
    """The messages, followed by the end-of-stream message."""
    last: PoseRaw | None = None
    for topic, message in messages:
        yield topic, message
        if isinstance(message, PoseRaw):
            last = message
    if last:
        yield POSE_RAW, end_of(last)


def end_of(last: PoseRaw) -> PoseRaw:
    """The end-of-stream message that follows the last message."""
    return dataclasses.replace(last, bodies=[], end_of_stream=True)


AXES = ("x", "y", "z")
LATEST_S = 2.0**31  # upper bound of a stamp, seconds. ROS 2 stores seconds in an int32.
UNITS = {"milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
MISSING = frozenset({"", "nan", "null", "none", "n/a", "na", "#n/a", "-"})
"""What a cell without a number may contain, in small letters."""
NOTES = ("skeleton", "up")  # keys of the lines ``# KEY: VALUE``


class CsvError(ValueError):
    """A CSV that does not contain poses. The text says what was expected, what came, and what to do."""


class CsvSource:
    """The frames of a CSV as messages; a source for the input node and for ``steadypose clean``.

    The CSV has a header and one row per frame or, with several bodies, one per body and frame::

        stamp, left_shoulder_x, left_shoulder_y, left_shoulder_z, left_elbow_x, ...
        0.000, 0.183, 1.402, 2.918, 0.301, ...

    ``stamp`` is the capture time in seconds; positions are in metres, empty or ``nan`` where missing (`MISSING`).
    Joints have the names of a layout (`prior.body.layouts`), in any order; joints without columns are unobserved.
    Optional columns are ``JOINT_confidence``, 0 to 1, and ``body``, an integer id of each body; others are ignored.
    Lines before the header may contain ``# skeleton: NAME``, if the joints' names fit several layouts, and ``# up: z``
    (the default), ``y`` or ``-y``.

    Unreadable rows are skipped and counted in ``refused``, which names the first of each kind.

    Raises:
        CsvError: the header or all rows are unusable, or stamps are in another unit.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        notes = _notes(path)
        numbers: list[int] = []
        rows = csv.reader(_table(path, numbers))
        try:
            columns = [name.strip() for name in next(rows, [])]
            if not columns:
                raise CsvError(f"{path}: has no rows: expected a header, stamp, JOINT_x, ..., and a row for each frame")
            self._skeleton = _skeleton(path, columns, notes.get("skeleton"))
            self._frames = self._read(((numbers[rows.line_num - 1], row) for row in rows), columns)
        except csv.Error as error:
            raise CsvError(f"{path}: cannot be read as CSV: {error}") from error
        if not self._frames and not self.refused:
            raise CsvError(f"{path}: has a header, but no rows: expected one for each frame, and for each body in it")
        try:
            self._sensor_pose = Pose.from_up(notes.get("up", "z"))
        except ValueError as error:
            raise CsvError(f"{path}: {error}") from error
        if not self._frames:
            raise CsvError(f"{path}: expected a row of numbers after the header, got none: {'; '.join(self.refused)}")

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        source, skeleton = as_text(self.path.stem), self._skeleton.name
        for stamp_ns, bodies in self._frames:
            yield POSE_RAW, PoseRaw(stamp_ns, "sensor", source, skeleton, self._sensor_pose, False, list(bodies))

    def _read(self, rows: Iterable[tuple[int, list[str]]], columns: list[str]) -> list[tuple[int, list[RawBody]]]:
        """Stamp and bodies of each frame, in file order, from the numbers of rows in the file and their cells."""
        positions = _columns(columns, self._skeleton, AXES)
        confidence = _columns(columns, self._skeleton, ("confidence",))
        stamp, body = columns.index("stamp"), columns.index("body") if "body" in columns else -1
        used = sorted({stamp, body, *positions.flat, *confidence.flat} - {-1})
        stamps: list[str] = []
        refused: dict[str, list[str]] = {}
        read: list[tuple[int, RawBody]] = []
        numbers = np.full(len(columns) + 1, np.nan)  # the last stands for missing columns, whose index is -1
        for number, row in rows:
            try:
                if len(row) != len(columns):
                    where = f"row {number}: {len(row)} cells for {len(columns)} columns"
                    raise _RowError("rows of another length than the header", where)
                stamps.append(row[stamp])
                for index in used:
                    numbers[index] = _number(number, columns[index], row[index])
                stamp_ns = _stamp_ns(number, float(numbers[stamp]))
                id = 0 if body == -1 else _id(number, float(numbers[body]))
            except _RowError as error:
                cause, where = error.args
                refused.setdefault(cause, []).append(where)
                continue
            joints, confidences = numbers[positions], numbers[confidence][:, 0]
            confidences = np.where(np.isnan(confidences), np.isfinite(joints).all(axis=-1), confidences)
            with np.errstate(over="ignore"):
                read.append((stamp_ns, RawBody(id, joints, confidences)))
        _check_unit(self.path, stamps)
        self.refused.update({f"{cause}, first {where[0]}": len(where) for cause, where in refused.items()})
        return [(stamp_ns, [one for _, one in group]) for stamp_ns, group in groupby(read, key=lambda pair: pair[0])]


class _RowError(ValueError):
    """A row that is no frame. Its arguments are the cause, in the plural, and where."""


def _number(row: int, column: str, cell: str) -> float:
    """The number in a cell; NaN if it is missing."""
    text = cell.strip()
    if text.lower() in MISSING:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise _RowError("rows with something else than numbers", f"row {row}, column {column}: {text[:20]!r}") from None


def _stamp_ns(row: int, seconds: float) -> int:
    if not 0 <= seconds < LATEST_S:
        raise _RowError("rows without a stamp of 0 s or more", f"row {row}, column stamp: {seconds:.15g}")
    return round(seconds * 1e9)


def _id(row: int, body: float) -> int:
    if not body.is_integer() or not -(2**31) <= body < 2**31:
        raise _RowError("rows of which the body is no whole number of 32 bits", f"row {row}, column body: {body:.15g}")
    return int(body)


def _lines(path: Path) -> Iterator[str]:
    try:
        with path.open(encoding="utf-8-sig") as file:
            for line in file:
                if "\0" in line:  # UTF-16 without a mark at its beginning
                    raise CsvError(f"{path}: cannot be read as text: got characters of 0; save it as UTF-8")
                yield line.rstrip("\n")
    except (UnicodeDecodeError, OSError) as error:
        remedy = "; save it as UTF-8" if isinstance(error, UnicodeDecodeError) else ""
        raise CsvError(f"{path}: cannot be read as text: {error}{remedy}") from error


def _table(path: Path, numbers: list[int]) -> Iterator[str]:
    """The lines of header and rows, one at a time, because cells as text take ten times the memory of numbers.

    Their numbers in the file are appended to ``numbers``.
    """
    for number, line in enumerate(_lines(path), start=1):
        if line.strip() and not line.startswith("#"):
            numbers.append(number)
            yield line


def _notes(path: Path) -> dict[str, str]:
    notes = {}
    for line in _lines(path):
        if not line.startswith("#"):
            continue
        key, colon, value = line[1:].partition(":")
        key = key.strip().lower()
        if key in NOTES:
            notes[key] = value.strip()
        elif colon and difflib.get_close_matches(key, NOTES, n=1, cutoff=0.75):
            raise CsvError(f"{path}: expected a line '# skeleton: NAME' or '# up: AXIS', got {line[:40]!r}")
        elif colon and key.isidentifier():  # a single word: meant as a setting, rather than a remark
            expected = "expected '# skeleton: NAME' or '# up: AXIS'; positions are read as metres, stamps as seconds"
            logger.warning("%s: the line %r is not used: %s", path, line[:40], expected)
    return notes


def _check_unit(path: Path, cells: list[str]) -> None:
    """Raise CsvError if stamps are not seconds. Frames up to `SLOWEST_NS` apart are a slow recording."""
    stamps = []
    for cell in cells:
        with suppress(ValueError):  # of an empty cell, or text: its row is refused
            stamps.append(float(cell))
    seconds = np.array(stamps)
    seconds = seconds[np.isfinite(seconds)]
    steps = np.abs(np.diff(seconds))
    steps = steps[steps > 0]  # bodies of one frame share a stamp
    latest = float(np.median(seconds)) if len(seconds) else 0.0
    fits: list[str] = []
    if len(steps) > 1 and (step := float(np.median(steps))) > SLOWEST_NS / 1e9:
        fits = [unit for unit, factor in UNITS.items() if RATES_HZ[0] <= factor / step <= RATES_HZ[1]]
    if not fits and latest >= LATEST_S:
        fits = [unit for unit, factor in UNITS.items() if latest / factor < LATEST_S]
    if fits:
        got = ", ".join(f"{value:.15g}" for value in np.unique(seconds)[:3])
        remedy = f"these look like {fits[0]}; divide by {UNITS[fits[0]]}"
        raise CsvError(f"{path}: stamp: expected seconds, got {got}: {remedy}")


def _skeleton(path: Path, columns: list[str], named: str | None) -> Skeleton:
    """The layout that has all joints of the header."""
    if len(columns) == 1 and (separators := [character for character in ";\t" if character in columns[0]]):
        got = f"got {separators[0]!r} in {columns[0][:40]!r} ...; save it with commas, and points in numbers (0.183)"
        raise CsvError(f"{path}: expected columns separated by commas, {got}")
    if "stamp" not in columns:
        raise CsvError(
            f"{path}: expected a header with a column 'stamp', in seconds; got {', '.join(columns[:8]) or 'none'} ...; "
            "rename another program's columns to stamp, JOINT_x, JOINT_y, JOINT_z (docs/sources.md)"
        )
    if len(set(columns)) != len(columns):
        twice = [name for name, times in Counter(columns).items() if times > 1]
        raise CsvError(f"{path}: expected each column once, got {', '.join(twice)} again")
    joints = {name[:-2] for name in columns if name.endswith(tuple(f"_{axis}" for axis in AXES))}
    lone = [f"{joint}_{axis}" for joint in sorted(joints) for axis in AXES if f"{joint}_{axis}" not in columns]
    if not joints or lone:
        got = f"missing: {', '.join(lone[:5])}" if lone else f"got none among {', '.join(columns[:8])}"
        raise CsvError(f"{path}: expected columns JOINT_x, JOINT_y and JOINT_z for each joint; {got}")
    if named is not None and named not in SKELETONS:
        raise CsvError(f"{path}: skeleton: expected one of {layout_names()}, got {named!r}")
    for skeleton in [SKELETONS[named]] if named else SKELETONS.values():
        if joints <= set(skeleton.joints):
            return skeleton
    spelt = {_plain(joint) for joint in joints}  # the layout is chosen however its names are spelt
    closest = max(
        [SKELETONS[named]] if named else SKELETONS.values(),
        key=lambda s: (len(spelt & {_plain(joint) for joint in s.joints}), len(joints & set(s.joints))),
    )
    names = {_plain(joint): joint for joint in closest.joints}
    strange = {joint: names.get(_plain(joint)) for joint in sorted(joints - set(closest.joints))[:5]}
    listed = ", ".join(f"{joint} ({name})" if name else joint for joint, name in strange.items())
    remedy = "; rename them to the names in brackets" if any(strange.values()) else ""
    expected = "expected the joints of one skeleton"
    raise CsvError(f"{path}: {expected}; {closest.name} is closest, but has no {listed}{remedy}")


def _plain(joint: str) -> str:
    """A joint's name without what programs spell differently: LeftWrist is left_wrist."""
    return joint.lower().replace("_", "")


def _columns(columns: list[str], skeleton: Skeleton, endings: tuple[str, ...]) -> NDArray[np.intp]:
    """(J, len(endings)) index of each joint's columns; -1 for a missing column."""
    place = {name: index for index, name in enumerate(columns)}
    return np.array([[place.get(f"{joint}_{ending}", -1) for ending in endings] for joint in skeleton.joints])
