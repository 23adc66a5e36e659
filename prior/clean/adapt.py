"""Converts messages to canonical joints and back: joint layouts, the sensor's frame, and validation of the input."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np

from steadypose.msgs.topics import broken
from steadypose.msgs.types import CleanBody, PoseClean, PoseRaw, RawBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import SensorFrame, quaternions
from steadypose.prior.body.layouts import SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.skeleton import PARENT, REST_LENGTHS, finite_joints
from steadypose.prior.clean.admission import MAX_DISTANCE, MAX_PLACE
from steadypose.prior.clean.frame import CleanFrame
from steadypose.prior.compiled import median

MIN_SIZE, MAX_SIZE, MIN_BONES = 0.05, 2.5, 4
"""Least and largest median ratio of a body's bone lengths to the mean person's; least number of observed bones to judge
it. Some trackers give every joint the same position, often zero, in frames in which they fail."""
UNIT_TOLERANCE = 0.01  # largest deviation from 1 of the norm of a sensor's quaternion


class BodyJoints(NamedTuple):
    """Joints of a body, or of S bodies by slot."""

    positions: Floats  # (22, 3) or (S, 22, 3) metres, z up; NaN where unobserved
    confidence: Floats  # (22,) or (S, 22) in 0..1


class RecentMessages(deque[PoseRaw]):
    """Messages of a stream since the frame that is to be published next, oldest first."""

    def at(self, stamp_ns: int) -> PoseRaw:
        """Return the message nearest to a frame's stamp, and forget those before it."""
        while len(self) > 1 and self[1].stamp_ns <= stamp_ns:
            self.popleft()
        return min(islice(self, 2), key=lambda message: abs(message.stamp_ns - stamp_ns))


def stacked(bodies: Collection[BodyJoints]) -> BodyJoints:
    """Stack N bodies into arrays (N, 22, 3) and (N, 22)."""
    positions, confidence = zip(*bodies, strict=True) if bodies else ((), ())
    return BodyJoints(np.reshape(positions, (-1, 22, 3)), np.reshape(confidence, (-1, 22)))


def layout_of(raw: PoseRaw, counters: Counter[str]) -> Skeleton | None:
    """Return the layout of a message's joints. If the message cannot be used, count the cause and return None."""
    layout = SKELETONS.get(raw.skeleton)
    if layout is None:
        counters["unknown_skeleton"] += 1
        return None
    pose = raw.sensor_pose
    near = bool((np.abs(pose.position) < MAX_PLACE).all())
    if not (near and abs(np.linalg.norm(pose.orientation) - 1) < UNIT_TOLERANCE):
        counters["sensor_pose_invalid"] += 1
        return None
    return layout


def canonical_bodies(
    raw: PoseRaw, layout: Skeleton, sensor: SensorFrame, counters: Counter[str], *, numbered: bool
) -> dict[int, BodyJoints]:
    """Convert a message's bodies in ``layout`` to canonical joints in the world; ``counters`` count what is refused, by
    cause.

    The result is keyed by id or, if ``numbered`` (for a source without stable ids), by index in the message.
    """
    bodies: dict[int, BodyJoints] = {}
    for index, body in enumerate(raw.bodies):
        if len(body.positions) != len(layout.joints):
            counters["wrong_joint_count"] += 1
            continue
        key = index if numbered else body.id
        if key in bodies:
            counters["body_id_repeated"] += 1
            continue
        positions, confidence = _canonical(body, layout, counters)
        if not MIN_SIZE <= (size := _size_of(positions)) <= MAX_SIZE:
            counters["body_too_large" if size > MAX_SIZE else "body_too_small"] += 1
            continue
        bodies[key] = BodyJoints(sensor.to_world(positions), confidence)
    return bodies


def _canonical(body: RawBody, layout: Skeleton, counters: Counter[str]) -> tuple[Floats, Floats]:
    """Return a body's canonical joints in the sensor's frame, without joints that are unobserved or too far away."""
    joints = body.positions.astype(np.float64)
    confidence = np.fmin(np.fmax(body.confidence.astype(np.float64), 0.0), 1.0)  # NaN becomes 0
    joints[confidence == 0.0] = np.nan  # trackers give such joints any position, often the origin
    finite = finite_joints(joints)
    far = finite & (np.abs(np.where(finite[:, None], joints, 0.0)).max(axis=1) > MAX_DISTANCE)
    if far.any():
        counters["joints_too_far"] += int(far.sum())
        joints[far] = np.nan
    return to_canonical(layout, joints, confidence)


def _size_of(positions: Floats) -> float:
    """Return the median ratio of the bone lengths of joints (22, 3) to the mean person's; 1 if too few are observed."""
    lengths = np.linalg.norm(positions[1:] - positions[PARENT[1:]], axis=1)
    observed = np.isfinite(lengths)
    return median(lengths[observed] / REST_LENGTHS[1:][observed]) if observed.sum() >= MIN_BONES else 1.0


def clean_bodies(frame: CleanFrame, sensor: SensorFrame, ids: Mapping[int, int]) -> dict[int, CleanBody]:
    """Return the bodies of a frame by slot, in the sensor's frame. ``ids`` maps slots to body ids.

    Bodies that break the guarantees of `msgs.topics` are left out.
    """
    estimate, score = frame.estimate, frame.score
    bodies: dict[int, CleanBody] = {}
    for slot, body_id in ids.items():
        if not np.isfinite(estimate.positions[slot, 0, 0]):
            continue
        rotations = estimate.rotations[slot].copy()
        rotations[0] = sensor.rotation.T @ rotations[0]
        body = CleanBody(
            id=body_id,
            positions=sensor.from_world(estimate.positions[slot]),
            rotations=quaternions(rotations),
            state=estimate.state[slot],
            sigma=estimate.sigma[slot],
            anomaly=float(score.anomaly[slot]),
            anomaly_flag=bool(score.flag[slot]),
            joint_anomaly=score.joint_anomaly[slot],
            bone_lengths=np.sqrt((estimate.offsets[slot] ** 2).sum(axis=-1)),
            raw_positions=sensor.from_world(frame.observed[slot]),
            raw_confidence=frame.confidence[slot],
        )
        if broken(body) is None:
            bodies[slot] = body
    return bodies


def clean_message(raw: PoseRaw, stamp_ns: int, delay_frames: int, bodies: list[CleanBody]) -> PoseClean:
    """Build a source's output message, in the frame of its message ``raw``; ``stamp_ns`` is on the source's clock."""
    return PoseClean(
        stamp_ns=stamp_ns,
        frame_id=raw.frame_id,
        source=raw.source,
        sensor_pose=raw.sensor_pose,
        calibrated=raw.calibrated,
        delay_frames=delay_frames,
        bodies=bodies,
    )


def end_of_stream(raw: PoseRaw, delay_frames: int) -> PoseClean:
    """Build the last output message of a source whose last message is ``raw``."""
    ended = clean_message(raw, raw.stamp_ns, delay_frames, [])
    ended.end_of_stream = True
    return ended
