"""Messages to canonical joints and back: layouts, the sensor's frame, and what no message may bring in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from steadypose.msgs.topics import broken
from steadypose.msgs.types import CleanBody, PoseClean, PoseRaw, RawBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import SensorFrame, quaternions
from steadypose.prior.body.layouts import SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS, finite_joints
from steadypose.prior.clean.frame import CleanFrame
from steadypose.prior.compiled import median

MAX_DISTANCE = 30.0
"""Metres from the sensor beyond which a joint is no observation."""
MAX_PLACE = 10_000.0
"""Metres from the world's origin beyond which no sensor stands: joints lose their millimetres."""
MAX_SIZE, MIN_BONES = 2.5, 4
"""Least number of observed bones by which a body is refused, and ratio of their median to the mean person's from which
on it is: nobody is so large."""
UNIT_TOLERANCE = 0.01
"""Largest distance from 1 of the norm of a sensor pose's quaternion."""

_REST_LENGTHS = np.linalg.norm(REST_OFFSETS[1:], axis=1)


class BodyJoints(NamedTuple):
    """Joints of a body, or of S bodies by slot.

    Attributes:
        positions: (22, 3) or (S, 22, 3) metres, z up; NaN where unobserved.
        confidence: (22,) or (S, 22) in 0..1.
    """

    positions: Floats
    confidence: Floats


def stacked(bodies: Collection[BodyJoints]) -> BodyJoints:
    """N bodies as one: (N, 22, 3) and (N, 22)."""
    return BodyJoints(
        np.array([body.positions for body in bodies]).reshape(-1, 22, 3),
        np.array([body.confidence for body in bodies]).reshape(-1, 22),
    )


def layout_of(raw: PoseRaw, counters: Counter[str]) -> Skeleton | None:
    """The layout of a message's joints, or None, counted, if the message cannot be used."""
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
    """A message's bodies as canonical joints in the world.

    Args:
        raw: the message.
        layout: of its joints.
        sensor: where the sensor stands.
        counters: what was refused, by cause.
        numbered: whether bodies are called by their place in the message, for a source that does not know whose body
            is whose, or by their id.
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
        if _is_too_large(positions):
            counters["body_too_large"] += 1
            continue
        bodies[key] = BodyJoints(sensor.to_world(positions), confidence)
    return bodies


def _canonical(body: RawBody, layout: Skeleton, counters: Counter[str]) -> tuple[Floats, Floats]:
    """A body's canonical joints in the sensor's frame; what is not finite or too far away is missing."""
    joints = body.positions.astype(np.float64)
    finite = finite_joints(joints)
    far = finite & (np.abs(np.where(finite[:, None], joints, 0.0)).max(axis=1) > MAX_DISTANCE)
    if far.any():
        counters["joints_too_far"] += int(far.sum())
        joints[far] = np.nan
    confidence = np.fmin(np.fmax(body.confidence.astype(np.float64), 0.0), 1.0)  # NaN becomes 0
    return to_canonical(layout, joints, confidence)


def _is_too_large(positions: Floats) -> bool:
    """Whether joints (22, 3) are nobody's: one such frame would be learned from for seconds."""
    lengths = np.linalg.norm(positions[1:] - positions[PARENT[1:]], axis=1)
    observed = np.isfinite(lengths)
    return bool(observed.sum() >= MIN_BONES and median(lengths[observed] / _REST_LENGTHS[observed]) > MAX_SIZE)


def clean_bodies(frame: CleanFrame, sensor: SensorFrame, ids: Mapping[int, int]) -> dict[int, CleanBody]:
    """The bodies of a moment, by slot, as that sensor sees them; ``ids`` from slots to what they are called.

    One that breaks what `msgs.topics` promises is not among them.
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
    """The output for a source of which ``raw`` came last; ``stamp_ns`` is its time, on the source's clock."""
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
    """The last output for a source that has ended with ``raw``."""
    ended = clean_message(raw, raw.stamp_ns, delay_frames, [])
    ended.end_of_stream = True
    return ended
