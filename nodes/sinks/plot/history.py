"""A recording as arrays per body and topic, one row per message; and its errors against the ground truth, if any."""

from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import JOINTS, Diagnostics, Message, PoseClean, PoseEvents, PoseRaw, PoseWorld, Tracking
from steadypose.nodes.sinks.drawing import to_world
from steadypose.nodes.sources.npz import Arrays, ArraySource, is_output, read_arrays
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.layouts import SKELETONS, to_canonical

SENSOR = {"sensor.jitter_mm", "sensor.slow_error_mm"}
"""Keys of the prior's diagnostics with the estimated sensor noise."""
_NONE = np.zeros(0)


class Track(NamedTuple):
    """One body on one topic, one row per message. Positions are in the world."""

    time: NDArray[np.float64]  # (T,) seconds since the recording's first stamp
    positions: NDArray[np.float64]  # (T, 22, 3) metres; NaN where unobserved
    raw: NDArray[np.float64]  # (T, 22, 3) metres, the input joints; empty except on `pose/clean`
    state: NDArray[np.uint8]  # (T, 22) `JointState`
    sigma: NDArray[np.float64]  # (T, 22) metres
    anomaly: NDArray[np.float64]  # (T,)
    flag: NDArray[np.bool_]  # (T,)
    contacts: NDArray[np.float64]  # (T, 8)
    tracking: NDArray[np.uint8]  # (T,) `Tracking`


@dataclass
class History:
    """A recording as arrays."""

    name: str
    stamps: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """stamps by topic: (T,) seconds since the recording's first stamp"""
    tracks: dict[str, dict[int, Track]] = field(default_factory=dict)  # tracks by topic and body
    calibrated: bool = True  # whether the camera's position in the world is known
    reported: bool = False  # whether diagnostics were recorded
    observable: NDArray[np.bool_] = field(default_factory=lambda: np.ones(len(JOINTS), bool))
    """(22,) whether the sensor's layout has each joint"""
    origin: str = ""  # sources and skeletons, for the title
    sensor: dict[str, list[float]] = field(default_factory=dict)
    """sensor noise estimated by the prior, each second: ``jitter_mm`` and ``slow_error_mm``"""
    dropped_or_refused: Counter[str] = field(default_factory=Counter)
    """dropped and refused messages by node and cause, as counted by the nodes; and unreadable messages"""

    def track(self, topic: str, body: int) -> Track | None:
        return self.tracks.get(topic, {}).get(body)

    @property
    def bodies(self) -> list[int]:
        return sorted({body for tracks in self.tracks.values() for body in tracks})


def history_of_arrays(arrays: Arrays, name: str = "arrays") -> History:
    """The history of an output of ``clean``, ``complete`` or ``fit``, or of an input. Raises NpzError if neither."""
    return _of_output(name, arrays) if is_output(arrays) else _of_source(name, ArraySource(Path(name), arrays))


def history_of_path(path: Path) -> History:
    """The history of a recording, or of a file of poses. Raises RecordingError, or as `open_recording`."""
    if path.suffix == ".npz" and path.exists():
        return history_of_arrays(read_arrays(path), path.name)
    if not path.is_dir() and path.suffix != ".mcap":
        return _of_source(path.name, open_recording(path))
    with RecordingReader(path) as reader:
        history = gather(path.name, reader, reader.start_ns)
        history.dropped_or_refused.update({f"unreadable {topic}": count for topic, count in reader.refused.items()})
        if not reader.complete:
            history.dropped_or_refused["bytes cut off"] = reader.lost_bytes
    return history


def _of_output(name: str, arrays: Arrays) -> History:
    """The history of an output, without input joints. Both topics are in the world."""
    several, time = "body_id" in arrays, (arrays["stamp_ns"] - arrays["stamp_ns"].min()) / 1e9
    history = History(name, {POSE_CLEAN: time, POSE_WORLD: time}, origin="source arrays")
    for number, body in enumerate(arrays["body_id"].tolist() if several else [0]):

        def of_body(name: str, number: int = number) -> NDArray[Any]:
            return arrays[name][:, number] if several else arrays[name]

        there = ~np.isnan(of_body("world_positions")).all(axis=(1, 2))
        if there.any():
            keys = ("world_positions", "state", "sigma", "anomaly", "anomaly_flag", "contacts")
            joints, state, sigma, anomaly, flag, contacts = (of_body(key)[there] for key in keys)
            raw, tracking = np.full_like(joints, np.nan), np.zeros(len(joints), np.uint8)
            track = Track(time[there], joints, raw, state, sigma, anomaly, flag, contacts, tracking)
            for topic in history.stamps:
                history.tracks.setdefault(topic, {})[body] = track
    return history


def _of_source(name: str, messages: Iterable[tuple[str, Message]]) -> History:
    stamped = [(topic, message.stamp_ns, message) for topic, message in messages]
    return gather(name, stamped, min((stamp_ns for _, stamp_ns, _ in stamped), default=0))


def gather(name: str, messages: Iterable[tuple[str, int, Message]], start_ns: int) -> History:
    """Collect messages, each with topic and stamp, as arrays of the stream ``name``, which starts at ``start_ns``."""
    rows: dict[tuple[str, int], list[tuple[Any, ...]]] = {}
    stamps: dict[str, list[float]] = {}
    dropped_or_refused: dict[str, Mapping[str, str]] = {}
    sources, skeletons = Counter[str](), Counter[str]()
    observable = np.zeros(len(JOINTS), bool)
    history = History(name)
    for topic, stamp_ns, message in messages:
        if isinstance(message, Diagnostics):
            dropped_or_refused[message.node] = message.values
            for key in SENSOR & message.values.keys():
                with suppress(ValueError):  # the recording may come from another program
                    history.sensor.setdefault(key.removeprefix("sensor."), []).append(float(message.values[key]))
            continue
        if message.end_of_stream or isinstance(message, PoseEvents):
            continue
        time = (stamp_ns - start_ns) / 1e9
        stamps.setdefault(topic, []).append(time)
        sources[message.source] += 1
        history.calibrated &= getattr(message, "calibrated", True)
        if isinstance(message, PoseRaw) and message.skeleton in SKELETONS:
            skeletons[message.skeleton] += 1
            observable |= SKELETONS[message.skeleton].observable
        for body, row in _rows(message, time):
            rows.setdefault((topic, body), []).append(row)
    history.stamps = {topic: np.array(times) for topic, times in stamps.items()}
    for (topic, body), of_body in rows.items():
        track = Track(*(np.array(column) for column in zip(*of_body, strict=True)))
        history.tracks.setdefault(topic, {})[body] = track
    if observable.any():
        history.observable = observable
    history.reported = bool(dropped_or_refused)
    names = {"source": sources, "skeleton": skeletons}
    history.origin = " · ".join(f"{what} {', '.join(found)}" for what, found in names.items() if found)
    for node, values in dropped_or_refused.items():
        for key, value in values.items():
            if key.startswith(("dropped.", "refused.")) and value.isdecimal():
                history.dropped_or_refused[f"{node} {key}"] += int(value)
    return history


def _rows(message: PoseRaw | PoseClean | PoseWorld, time: float) -> Iterable[tuple[int, tuple[Any, ...]]]:
    """Id and row (the fields of `Track`) of each body in a message."""
    if isinstance(message, PoseRaw):
        skeleton = SKELETONS.get(message.skeleton)
        for body in message.bodies if skeleton else ():
            if skeleton and len(body.positions) == len(skeleton.joints):
                positions, _ = to_canonical(skeleton, to_world(body.positions, message.sensor_pose), body.confidence)
                yield body.id, (time, positions, _NONE, _NONE, _NONE, np.nan, False, _NONE, Tracking.OK)
    elif isinstance(message, PoseClean):
        for body in message.bodies:
            positions = to_world(body.positions, message.sensor_pose)
            raw = to_world(body.raw_positions, message.sensor_pose)
            scores = body.anomaly, body.anomaly_flag
            yield body.id, (time, positions, raw, body.state, body.sigma, *scores, _NONE, Tracking.OK)
    else:
        for body in message.bodies:
            of_world = body.contacts, body.tracking
            yield body.id, (time, body.positions, _NONE, body.state, body.sigma, np.nan, False, *of_world)


MAX_TRUTH_GAP_S = 0.05  # largest time between a pose and the ground truth it is compared with, seconds


class TrackError(NamedTuple):
    """Error of a track against the ground truth."""

    time: NDArray[np.float64]  # (T,) seconds
    mean: NDArray[np.float64]  # (T,) metres, mean over the joints present
    by_joint: NDArray[np.float64]  # (22,) metres, mean over time


def errors_of(history: History, body: int) -> dict[str, TrackError]:
    """Errors of a body's joints on each topic."""
    truth = [person for person in history.tracks.get(POSE_TRUTH, {}).values() if len(person.time) > 1]
    found = {}
    for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD):
        track = history.track(topic, body)
        if track is None or not truth:
            continue
        joints = np.stack([_distances(track, person, placed=history.calibrated) for person in truth])
        means = np.stack([nan_mean(distances, axis=1) for distances in joints])
        some = np.flatnonzero(np.isfinite(means).any(axis=0))
        if len(some):
            # the sensor's ids may differ from the ground truth's, so compare with the nearest person
            nearest = np.nanargmin(means[:, some], axis=0)
            found[topic] = TrackError(track.time[some], means[nearest, some], nan_mean(joints[nearest, some], axis=0))
    return found


def _distances(track: Track, truth: Track, *, placed: bool) -> NDArray[np.float64]:
    """(T, 22) distances from the ground truth at the same times, metres; NaN where missing.

    A track that is not ``placed`` in the world is first aligned to the truth.
    """
    index = np.clip(np.searchsorted(truth.time, track.time), 1, len(truth.time) - 1)
    before, after = truth.time[index - 1], truth.time[index]
    share = np.clip((track.time - before) / np.maximum(after - before, 1e-9), 0, 1)[:, None, None]
    expected = truth.positions[index - 1] * (1 - share) + truth.positions[index] * share
    far = np.minimum(np.abs(track.time - before), np.abs(after - track.time)) > MAX_TRUTH_GAP_S
    expected[far] = np.nan
    positions = track.positions if placed else _aligned(track.positions, expected)
    return np.linalg.norm(positions - expected, axis=2)


def _aligned(positions: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (T, 22, 3) after the translation and rotation about the vertical that best fit the expected ones."""
    both = np.isfinite(positions).all(axis=2) & np.isfinite(expected).all(axis=2)
    if not both.any():
        return positions
    origin, target = positions[both].mean(axis=0), expected[both].mean(axis=0)
    p, q = positions[both] - origin, expected[both] - target
    turn = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]))
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return (positions - origin) @ rotation.T + target


def nan_mean(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Mean over an axis without NaN; NaN where all values are NaN."""
    return np.ma.masked_invalid(values).mean(axis=axis).filled(np.nan)


class PlotError(ValueError):
    """A plot that cannot be drawn. The text says why."""


def body_of(history: History, body: int | None) -> int:
    """The body to draw: the requested one, or the one observed the longest. Raises PlotError if there is none."""
    if not history.tracks:
        raise PlotError(f"{history.name}: expected at least one body, got none; see `steadypose info`")
    if body is None:
        tracks = next(history.tracks[t] for t in (POSE_CLEAN, POSE_WORLD, POSE_RAW, POSE_TRUTH) if t in history.tracks)
        return max(tracks, key=lambda body: len(tracks[body].time))
    if body not in history.bodies:
        raise PlotError(f"body: expected one of {history.bodies}, got {body}")
    return body
