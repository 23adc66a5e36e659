"""How one recording is completed: its bodies on the grid of 30 Hz, what is missing filled in, and the nodes' messages.

A key frame may stand seconds from the next: so, other than `clean`, this gives frames where the input has none.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import CleanBody, JointState, Message, Pose, PoseClean, PoseRaw
from steadypose.nodes.commands.output import (
    ARRAY_FILES,
    check_replaceable,
    put_in_place,
    unfinished,
    write_arrays,
    write_recording,
)
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.npz import NpzCollector
from steadypose.nodes.sources.recording import NO_RIG, open_recording, with_end
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.kinematics import quaternions, rotation_matrix
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, finite_joints
from steadypose.prior.complete.body import Completed, Fill, Uncertainty, complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.root_path import is_root_centred, root_path
from steadypose.prior.models.completer.inference import LiveCompleter
from steadypose.prior.models.root_velocity import LiveRootVelocity
from steadypose.prior.timing.resample import PERIOD_NS
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

APART_NS = 8_000_000_000
"""A longer gap without any observation of a body is not filled: a new stretch begins."""

BETWEEN_NS = PERIOD_NS * 3 // 2
"""Joints seen so far apart, at most, are joined by a line; between others motion is filled in."""

SIZES = (0.4, 2.5)
"""Range of factors between a person's bones and those of a generic adult; others are not in metres."""


@dataclass
class Sightings:
    """What a recording shows of a body, frame by frame.

    Attributes:
        stamps_ns: of each frame that shows it.
        positions: (22, 3) metres each, z up; NaN where not known.
    """

    stamps_ns: list[int] = field(default_factory=list)
    positions: list[Floats] = field(default_factory=list)


@dataclass(frozen=True)
class Stretch:
    """A body on the grid, from when it was first seen until it was away for long.

    Attributes:
        body: its number.
        first: of its frames, counted on the grid.
        given: (T, 22, 3) metres, z up; NaN where not known.
        offsets: (22, 3) metres, its bones.
    """

    body: int
    first: int
    given: Floats
    offsets: Floats


@dataclass(frozen=True)
class Done:
    """Summary of the completion of one recording.

    Attributes:
        frames: given out.
        bodies: how many.
        given: share of the joints of these that the recording knew.
        longest_gap: frames of which nothing was known, at most.
        unreached: joints too far from all that is known.
        stretches: what came in, and what came out.
        refused: what was refused or dropped, by cause.
        centred: bodies whose root stands still, whose way was read from their motion.
    """

    frames: int
    bodies: int
    given: float
    longest_gap: int
    unreached: int
    stretches: list[tuple[Stretch, Completed]]
    refused: dict[str, int]
    centred: list[int]


@dataclass(frozen=True)
class Completion:
    """What came of a recording.

    Attributes:
        raws: ``pose/raw`` as it was, with its end.
        answers: ``pose/clean`` and ``pose/world`` with their topics, in order.
        done: the summary.
    """

    raws: list[PoseRaw]
    answers: list[tuple[str, Message]]
    done: Done


def complete_recording(
    source: Path,
    out: Path,
    fill: Fill,
    uncertainty: Uncertainty,
    *,
    rig: Mapping[str, Any] = NO_RIG,
    replace: bool = False,
    began: Callable[[int], None] = lambda frames: None,
    advanced: Callable[[int], None] = lambda frame: None,
) -> Done:
    """Complete one recording. The output is there whole, or not at all.

    Args:
        source: a recording or file of poses.
        out: the recording to make, or .npz or .csv.
        fill: a completer.
        uncertainty: standard deviations of its output.
        rig: what a file of motion does not say.
        replace: whether what is at ``out`` may be replaced, if it is a recording or an .npz.
        began: called with the number of frames of all bodies together.
        advanced: called with how many of them are done.

    Raises:
        LaunchError, RecordingError, NpzError: the input cannot be used, or the output not be made.
    """
    check_replaceable(out, replace=replace)
    completion = complete_source(open_recording(source, rig), str(source), fill, uncertainty, began, advanced)
    with unfinished(out) as part:
        if out.suffix in ARRAY_FILES:
            write_arrays(part, completed_arrays(completion))
        else:
            every = [*((POSE_RAW, message) for message in completion.raws), *completion.answers]
            write_recording(part, sorted(every, key=lambda pair: pair[1].stamp_ns))
        put_in_place(part, out)
    return completion.done


def load_completer(weights: str) -> tuple[PartsCompleter, Uncertainty]:
    """The completer of a weight set, and the standard deviations of its output."""
    completer = LiveCompleter.load(weights)
    return PartsCompleter(completer), Uncertainty(completer.config.never_sigma, completer.config.half_frames)


def complete_source(
    frames: RecordedSource,
    name: str,
    fill: Fill,
    uncertainty: Uncertainty,
    began: Callable[[int], None] = lambda frames: None,
    advanced: Callable[[int], None] = lambda frame: None,
) -> Completion:
    """Complete what a source has; ``name`` is what errors call it, the rest as of `complete_recording`.

    Raises:
        LaunchError: it shows nobody.
    """
    messages = [message for _, message in with_end(frames) if isinstance(message, PoseRaw)]
    raws = [message for message in messages if not message.end_of_stream]
    if not raws:
        raise LaunchError(f"{name}: expected frames, but none of {len(frames)} could be read")
    anchor = min(message.stamp_ns for message in raws)
    stretches = [stretch for body, seen in _sightings(name, raws).items() for stretch in _on_grid(body, seen, anchor)]
    if not stretches:
        raise LaunchError(f"{name}: expected a body with joints in some frame, got none; see what it holds: info")
    began(sum(len(stretch.given) for stretch in stretches))
    done: list[tuple[Stretch, Completed]] = []
    before = 0
    for stretch in stretches:
        done.append((stretch, complete(fill, stretch.given, stretch.offsets, lambda k, at=before: advanced(at + k))))
        before += len(stretch.given)
        advanced(before)
    centred = sorted({s.body for s, _ in done if is_root_centred(s.given)})
    clean = _clean_messages(raws, done, uncertainty, anchor)
    world = TrajectoryPipeline(TrajectorySettings())
    paths = _paths(done, centred)
    answers: list[tuple[str, Message]] = []
    for message in clean:
        answers.append((POSE_CLEAN, message))
        answers += [(POSE_WORLD, answer) for answer in world.process(_moved(message, paths, anchor))]
    known = [completed.known.mean() for _, completed in done]
    summary = Done(
        frames=len(clean) - 1,
        bodies=len({stretch.body for stretch, _ in done}),
        given=float(np.average(known, weights=[len(s.given) for s, _ in done])),
        longest_gap=max(completed.span for _, completed in done),
        unreached=sum(int((~finite_joints(completed.positions)).sum()) for _, completed in done),
        stretches=done,
        refused={cause: n for cause, n in (frames.refused + world.counters).items() if n},
        centred=centred,
    )
    return Completion(messages, answers, summary)


def completed_arrays(completion: Completion) -> dict[str, NDArray[Any]]:
    """The arrays of ``clean``, with a row for each frame of the grid on which there is a body."""
    collector = NpzCollector()
    stamps = []
    for _, message in completion.answers:
        collector.add(message)
        if isinstance(message, PoseClean) and not message.end_of_stream:
            stamps.append(message.stamp_ns)
    return collector.arrays(np.array(stamps, np.int64))


def _sightings(source: str, raws: Iterable[PoseRaw]) -> Mapping[int, Sightings]:
    """Every body of a recording, in the z-up world."""
    found: dict[int, Sightings] = defaultdict(Sightings)
    for message in raws:
        if message.skeleton not in SKELETONS:
            raise LaunchError(
                f"{source}: skeleton {message.skeleton!r} is not known: expected one of {', '.join(SKELETONS)}, or one "
                "of your own by --skeletons"
            )
        turn, place = rotation_matrix(message.sensor_pose.orientation), message.sensor_pose.position
        for body in message.bodies:
            seen = np.where((body.confidence > 0)[:, None], body.positions, np.nan).astype(np.float64)
            joints, _ = to_canonical(SKELETONS[message.skeleton], seen, body.confidence)
            track = found[body.id]
            if finite_joints(joints).any() and (not track.stamps_ns or message.stamp_ns > track.stamps_ns[-1]):
                track.stamps_ns.append(message.stamp_ns)
                track.positions.append(joints @ turn.T + place)
    return {body: track for body, track in found.items() if track.stamps_ns}


def _on_grid(body: int, seen: Sightings, anchor_ns: int) -> list[Stretch]:
    """A body on the grid, in as many parts as it was away for long between."""
    stamps, positions = np.array(seen.stamps_ns), np.stack(seen.positions)
    offsets = estimate_offsets(positions[:: max(len(positions) // 900, 1)])
    _check_size(body, offsets)
    ends = np.flatnonzero(np.diff(stamps) > APART_NS) + 1
    found = []
    for rows in np.split(np.arange(len(stamps)), ends):
        first, last = (round((int(stamps[row]) - anchor_ns) / PERIOD_NS) for row in (rows[0], rows[-1]))
        ticks = anchor_ns + np.arange(first, last + 1) * PERIOD_NS
        given = np.full((len(ticks), 22, 3), np.nan)
        for joint in range(22):
            usable = rows[np.isfinite(positions[rows, joint]).all(axis=-1)]
            if len(usable):
                given[:, joint] = _interpolated(stamps[usable], positions[usable, joint], ticks)
        found.append(Stretch(body, first, given, offsets))
    return found


def _interpolated(stamps: NDArray[np.int64], places: Floats, ticks: NDArray[np.int64]) -> Floats:
    """(N, 3) at ``ticks`` (N,); NaN where no observation is near."""
    after = np.searchsorted(stamps, ticks).clip(0, len(stamps) - 1)
    before = np.where(stamps[after] > ticks, np.maximum(after - 1, 0), after)
    span = stamps[after] - stamps[before]
    share = np.where(span > 0, (ticks - stamps[before]) / np.maximum(span, 1), 0.0)[:, None]
    between = (span <= BETWEEN_NS) & (stamps[before] <= ticks) & (ticks <= stamps[after])
    nearest = np.where(np.abs(ticks - stamps[before]) <= np.abs(stamps[after] - ticks), before, after)
    near = np.abs(stamps[nearest] - ticks) <= PERIOD_NS // 2
    joined = np.where(between[:, None], (1.0 - share) * places[before] + share * places[after], places[nearest])
    return np.where((between | near)[:, None], joined, np.nan)


def _check_size(body: int, offsets: Floats) -> None:
    size = np.linalg.norm(offsets, axis=-1).sum() / np.linalg.norm(REST_OFFSETS, axis=-1).sum()
    if not SIZES[0] < size < SIZES[1]:
        raise LaunchError(
            f"body {body}: its bones are {size:.3g} times those of an adult: expected metres; convert the positions, "
            "or see whether the skeleton is the right one"
        )


def _clean_messages(
    raws: list[PoseRaw], done: list[tuple[Stretch, Completed]], uncertainty: Uncertainty, anchor_ns: int
) -> list[PoseClean]:
    """``pose/clean`` of every frame of the grid on which there is a body, in the frames in which these were seen."""
    bodies: dict[int, list[CleanBody]] = defaultdict(list)
    ordered = sorted(raws, key=lambda message: message.stamp_ns)
    stamps = np.array([message.stamp_ns for message in ordered])

    def context(frame: int) -> PoseRaw:
        at = np.searchsorted(stamps, anchor_ns + frame * PERIOD_NS + PERIOD_NS // 2, side="right") - 1
        return ordered[max(int(at), 0)]

    for stretch, completed in done:
        sigma = uncertainty.of(stretch.given)
        lengths = np.linalg.norm(stretch.offsets, axis=-1) * (np.array(PARENTS) >= 0)
        for row in np.flatnonzero(finite_joints(completed.positions).all(axis=1)):
            frame = stretch.first + int(row)
            pose = context(frame).sensor_pose
            turn = rotation_matrix(pose.orientation)
            rotations = completed.rotations[row].copy()
            rotations[0] = turn.T @ rotations[0]
            known = completed.known[row]
            bodies[frame].append(
                CleanBody(
                    id=stretch.body,
                    positions=(completed.positions[row] - pose.position) @ turn,
                    rotations=quaternions(rotations),
                    state=np.where(known, JointState.SEEN, JointState.IMPUTED),
                    sigma=sigma[row],
                    anomaly=np.nan,
                    anomaly_flag=False,
                    joint_anomaly=np.full(22, np.nan),
                    bone_lengths=lengths,
                    raw_positions=(stretch.given[row] - pose.position) @ turn,
                    raw_confidence=known.astype(np.float32),
                )
            )
    messages = []
    for frame in sorted(bodies):
        raw = context(frame)
        messages.append(
            PoseClean(
                anchor_ns + frame * PERIOD_NS, raw.frame_id, raw.source, raw.sensor_pose, raw.calibrated, 0,
                bodies[frame],
            )
        )  # fmt: skip
    last = messages[-1]
    end = PoseClean(last.stamp_ns, last.frame_id, last.source, last.sensor_pose, last.calibrated, 0, [], True)
    return [*messages, end]


def _paths(done: list[tuple[Stretch, Completed]], centred: list[int]) -> dict[tuple[int, int], Floats]:
    """Where bodies that are known about their root only are, by number and frame of the grid: (3,) metres."""
    paths: dict[tuple[int, int], Floats] = {}
    network = LiveRootVelocity.load(TrajectorySettings().weights) if centred else None
    for stretch, completed in done:
        if network is None or stretch.body not in centred:
            continue
        joints = completed.positions - completed.positions[:, :1]
        way = root_path(network, joints, completed.rotations[:, 0]) - completed.positions[:, 0]
        paths |= {(stretch.body, stretch.first + row): place for row, place in enumerate(way)}
    return paths


def _moved(message: PoseClean, paths: Mapping[tuple[int, int], Floats], anchor_ns: int) -> PoseClean:
    """The message with bodies where their paths have them."""
    frame = round((message.stamp_ns - anchor_ns) / PERIOD_NS)
    if message.end_of_stream or not any((body.id, frame) in paths for body in message.bodies):
        return message
    turn = rotation_matrix(message.sensor_pose.orientation)
    moved = []
    for body in message.bodies:
        step = turn.T @ paths.get((body.id, frame), np.zeros(3))
        fields = {name: getattr(body, name) for name in CleanBody.__slots__}
        moved.append(CleanBody(**{**fields, "positions": body.positions + step}))
    pose = Pose(message.sensor_pose.position, message.sensor_pose.orientation)
    return PoseClean(message.stamp_ns, message.frame_id, message.source, pose, message.calibrated, 0, moved)
