"""Completes the bodies of a recording on the 30 Hz grid, and returns the result as ``pose/clean``.

Key frames may be seconds apart, so unlike `clean`, this outputs frames where the input has none. If joints are known
only relative to the root, the trajectory is the integral of the root velocity that is predicted from the body's motion
(HM-VAE, section 3.3 and Figure 5).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import CleanBody, JointState, PoseClean, PoseRaw
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.kinematics import CONTACT_JOINTS, REST_HEIGHT, SensorFrame, heading, quaternions, yaw_matrix
from steadypose.prior.body.layouts import SKELETONS, layout_names, to_canonical
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, at_origin, finite_joints
from steadypose.prior.complete.body import Completed, Fill, Uncertainty, complete
from steadypose.prior.complete.samples import draw
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, velocity_features
from steadypose.prior.timing.rate import FPS
from steadypose.prior.timing.resample import PERIOD_NS

APART_NS = 8_000_000_000
"""Longest gap without any observation of a body that is filled, nanoseconds; a longer one starts a new stretch."""

BETWEEN_NS = PERIOD_NS * 3 // 2
"""Longest interval between two observations of a joint that is interpolated linearly, nanoseconds. Motion in longer
intervals is completed."""

SIZES = (0.4, 2.5)
"""Range of ratios of a person's bones to a generic adult's; outside it, positions are not in metres."""

STILL_M, MOVING_M = 1e-3, 0.03
"""Largest extent of a root's motion, and least extent of another joint's, of root-relative coordinates, metres."""

_FEET = slice(2, 6)


class CompletionError(ValueError):
    """A recording cannot be completed; the message says what was expected, what was found, and what to do."""


@dataclass(frozen=True)
class Stretch:
    """A body on the grid, from its first observation until it was unobserved for long."""

    body: int  # its id
    first: int  # index on the grid of its first frame
    given: Floats  # (T, 22, 3) metres, z up; NaN where unknown
    offsets: Floats  # (22, 3) metres, its bones


@dataclass(frozen=True)
class Completion:
    """The completion of a recording."""

    anchor_ns: int  # stamp of the grid's first frame
    done: list[tuple[Stretch, Completed]]  # every stretch with its completion
    clean: list[PoseClean]  # ``pose/clean`` of the frames with a body, and the end of the stream
    centred: list[int]
    """ids of bodies whose pelvis is at the origin, so that their trajectory is predicted from their motion"""

    @property
    def given(self) -> float:
        """Share of the joints that the recording contained."""
        known = [completed.known.mean() for _, completed in self.done]
        return float(np.average(known, weights=[len(stretch.given) for stretch, _ in self.done]))


def complete_raws(
    source: str,
    raws: Sequence[PoseRaw],
    fill: Fill,
    uncertainty: Uncertainty,
    advanced: Callable[[int, int], None] = lambda frames, total: None,
) -> Completion:
    """Complete the bodies of a recording.

    Args:
        source: name of the recording in error messages.
        raws: its messages, at least one, in any order.
        fill: a completer.
        uncertainty: standard deviations of its output.
        advanced: called with the numbers of finished frames and of all, of all bodies together.

    Raises:
        CompletionError: the recording has an unknown skeleton, no body, or no body in metres.
    """
    raws = sorted(raws, key=lambda message: message.stamp_ns)
    anchor_ns = raws[0].stamp_ns
    stretches = _stretches(source, raws, anchor_ns)
    done: list[tuple[Stretch, Completed]] = []
    before, total = 0, sum(len(stretch.given) for stretch in stretches)
    advanced(before, total)
    for stretch in stretches:
        completed = complete(fill, stretch.given, stretch.offsets, lambda k, at=before: advanced(at + k, total))
        done.append((stretch, completed))
        before += len(stretch.given)
        advanced(before, total)
    centred = sorted({stretch.body for stretch, _ in done if is_root_centred(stretch.given)})
    return Completion(anchor_ns, done, _clean_messages(raws, done, uncertainty, anchor_ns), centred)


def alternative(completion: Completion, raws: Sequence[PoseRaw], uncertainty: Uncertainty, seed: int) -> Completion:
    """Draw another completion of the same messages with a random seed (`samples.draw`)."""
    random, covariance = np.random.default_rng(seed), uncertainty.posture.covariance
    done = [
        (stretch, draw(completed, uncertainty.of(stretch.given), stretch.offsets, covariance, random))
        for stretch, completed in completion.done
    ]
    raws = sorted(raws, key=lambda message: message.stamp_ns)
    return replace(completion, done=done, clean=_clean_messages(raws, done, uncertainty, completion.anchor_ns))


def _stretches(source: str, raws: Sequence[PoseRaw], anchor_ns: int) -> list[Stretch]:
    """Return every body of a recording on the grid that begins at ``anchor_ns``."""
    stamps: dict[int, list[int]] = defaultdict(list)
    positions: dict[int, list[Floats]] = defaultdict(list)
    for message in raws:
        if message.skeleton not in SKELETONS:
            raise CompletionError(
                f"{source}: skeleton {message.skeleton!r} is not known: expected one of {layout_names()}, or one "
                "of your own by --skeletons"
            )
        sensor = SensorFrame.of(message.sensor_pose)
        for body in message.bodies:
            observed = np.where((body.confidence > 0)[:, None], body.positions, np.nan).astype(np.float64)
            joints, _ = to_canonical(SKELETONS[message.skeleton], observed, body.confidence)
            newer = not stamps[body.id] or message.stamp_ns > stamps[body.id][-1]
            if newer and finite_joints(joints).any():
                stamps[body.id].append(message.stamp_ns)
                positions[body.id].append(sensor.to_world(joints))
    stretches = [
        stretch
        for body in stamps
        if stamps[body]
        for stretch in _on_grid(body, np.array(stamps[body]), np.stack(positions[body]), anchor_ns)
    ]
    if not stretches:
        raise CompletionError(
            f"{source}: expected a body with joints in some frame, got none; see what it holds: "
            f"steadypose info {source}"
        )
    return stretches


def _on_grid(body: int, stamps: NDArray[np.int64], positions: Floats, anchor_ns: int) -> list[Stretch]:
    """Resample a body to the grid, divided into parts at long gaps."""
    offsets = estimate_offsets(positions[:: max(len(positions) // 900, 1)])
    size = np.linalg.norm(offsets, axis=-1).sum() / np.linalg.norm(REST_OFFSETS, axis=-1).sum()
    if not SIZES[0] < size < SIZES[1]:
        raise CompletionError(
            f"body {body}: its bones are {size:.3g} times those of an adult: expected metres; convert the positions, "
            "or see whether the skeleton is the right one"
        )
    ends = np.flatnonzero(np.diff(stamps) > APART_NS) + 1
    stretches = []
    for rows in np.split(np.arange(len(stamps)), ends):
        first, last = (round((int(stamps[row]) - anchor_ns) / PERIOD_NS) for row in (rows[0], rows[-1]))
        ticks = anchor_ns + np.arange(first, last + 1) * PERIOD_NS
        given = np.full((len(ticks), 22, 3), np.nan)
        for joint in range(22):
            usable = rows[np.isfinite(positions[rows, joint]).all(axis=-1)]
            if len(usable):
                given[:, joint] = interpolated(stamps[usable], positions[usable, joint], ticks)
        stretches.append(Stretch(body, first, given, offsets))
    return stretches


def interpolated(stamps: NDArray[np.int64], places: Floats, ticks: NDArray[np.int64]) -> Floats:
    """(N, 3) positions interpolated at ``ticks`` (N,); NaN where no observation is near."""
    after = np.searchsorted(stamps, ticks).clip(0, len(stamps) - 1)
    before = np.where(stamps[after] > ticks, np.maximum(after - 1, 0), after)
    span = stamps[after] - stamps[before]
    share = np.where(span > 0, (ticks - stamps[before]) / np.maximum(span, 1), 0.0)[:, None]
    between = (span <= BETWEEN_NS) & (stamps[before] <= ticks) & (ticks <= stamps[after])
    nearest = np.where(np.abs(ticks - stamps[before]) <= np.abs(stamps[after] - ticks), before, after)
    near = np.abs(stamps[nearest] - ticks) <= PERIOD_NS // 2
    joined = np.where(between[:, None], (1.0 - share) * places[before] + share * places[after], places[nearest])
    return np.where((between | near)[:, None], joined, np.nan)


def _clean_messages(
    raws: Sequence[PoseRaw], done: list[tuple[Stretch, Completed]], uncertainty: Uncertainty, anchor_ns: int
) -> list[PoseClean]:
    """Build ``pose/clean`` of every grid frame with a body, in the frames of the input, which is in order."""
    bodies: dict[int, list[CleanBody]] = defaultdict(list)
    stamps = np.array([message.stamp_ns for message in raws])

    def context(frame: int) -> PoseRaw:
        at = np.searchsorted(stamps, anchor_ns + frame * PERIOD_NS + PERIOD_NS // 2, side="right") - 1
        return raws[max(int(at), 0)]

    for stretch, completed in done:
        sigma = uncertainty.of(stretch.given)
        lengths = np.linalg.norm(stretch.offsets, axis=-1) * (np.array(PARENTS) >= 0)
        for row in np.flatnonzero(finite_joints(completed.positions).all(axis=1)):
            frame = stretch.first + int(row)
            sensor = SensorFrame.of(context(frame).sensor_pose)
            rotations = completed.rotations[row].copy()
            rotations[0] = sensor.rotation.T @ rotations[0]
            known = completed.known[row]
            bodies[frame].append(
                CleanBody(
                    id=stretch.body,
                    positions=sensor.from_world(completed.positions[row]),
                    rotations=quaternions(rotations),
                    state=np.where(known, JointState.SEEN, JointState.IMPUTED),
                    sigma=sigma[row],
                    anomaly=np.nan,
                    anomaly_flag=False,
                    joint_anomaly=np.full(22, np.nan),
                    bone_lengths=lengths,
                    raw_positions=sensor.from_world(stretch.given[row]),
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
    return [*messages, replace(messages[-1], bodies=[], end_of_stream=True)]


def along_paths(completion: Completion, weights: str) -> list[PoseClean]:
    """Return ``pose/clean`` with bodies that are known only relative to their root moved along predicted paths;
    ``weights`` are those of the root velocity network."""
    if not completion.centred:
        return completion.clean
    network = LiveRootVelocity.load(weights)
    steps: dict[tuple[int, int], Floats] = {}
    for stretch, completed in completion.done:
        if stretch.body in completion.centred:
            joints = completed.positions - completed.positions[:, :1]
            path = root_path(network, joints, completed.rotations[:, 0]) - completed.positions[:, 0]
            first_ns = completion.anchor_ns + stretch.first * PERIOD_NS
            steps |= {(stretch.body, first_ns + row * PERIOD_NS): step for row, step in enumerate(path)}
    moved = []
    for message in completion.clean:
        sensor = SensorFrame.of(message.sensor_pose)
        bodies = [
            body if (step := steps.get((body.id, message.stamp_ns))) is None
            else replace(body, positions=body.positions + sensor.rotation.T @ step)
            for body in message.bodies
        ]  # fmt: skip
        moved.append(replace(message, bodies=bodies))
    return moved


def is_root_centred(positions: Floats) -> bool:
    """Whether joints (T, 22, 3) metres, NaN where unknown, are relative to the root: it stays while others move."""
    known = finite_joints(positions)
    if known[:, 0].sum() < FPS // 3:
        return False
    shown = np.where(known[..., None], positions, np.nan)
    spread = np.nan_to_num(np.fmax.reduce(shown) - np.fmin.reduce(shown)).max(axis=-1)
    return bool((spread[0] < STILL_M or at_origin(shown)) and spread[1:].max() > MOVING_M)


def root_path(network: LiveRootVelocity, joints: Floats, root_rotations: Floats) -> Floats:
    """Integrate the root velocities that the network predicts frame by frame of joints (T, 22, 3) metres relative to
    the root, z up, whose rotations (T, 3, 3) are to the world.

    Returns the root's path (T, 3) metres, world, which starts above the origin; the lower foot is always on the floor.
    """
    yaw = heading(root_rotations)
    features = velocity_features(joints, np.concatenate([joints[:1], joints[:-1]]), FRAME_S, yaw)
    state, velocities = network.start(1), np.empty((len(joints), 3))
    for t, frame in enumerate(features):
        velocity, _, state = network(frame[None], state)
        velocities[t] = velocity[0]
    path = np.cumsum((yaw_matrix(yaw) @ velocities[..., None])[..., 0], axis=0) * FRAME_S
    path -= path[0]
    feet = joints[:, list(CONTACT_JOINTS)[_FEET], 2] - REST_HEIGHT[_FEET]
    path[:, 2] = -feet.min(axis=1)
    return path
