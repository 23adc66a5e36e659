"""Messages to bytes and back: CDR, as ROS 2 puts it on the wire, from the definitions in `msgs/msg`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from steadypose.msgs.limits import check_size
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.types import (
    CleanBody,
    Diagnostics,
    Event,
    EventKind,
    Hand,
    Level,
    Message,
    Phase,
    Pose,
    PoseClean,
    PoseEvents,
    PoseRaw,
    PoseWorld,
    RawBody,
    Tracking,
    WorldBody,
)

DEFINITIONS = Path(__file__).parent / "msg"
ROS_DEFINITIONS = {
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "diagnostic_msgs/msg/KeyValue": "string key\nstring value",
    "diagnostic_msgs/msg/DiagnosticStatus": "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
    "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values",
    "diagnostic_msgs/msg/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
}
"""Those of ROS 2's own that the messages are made of: to load all that rosbags has takes 50 ms of every start."""


class DecodeError(ValueError):
    """Bytes that are not the message they should be."""


@cache
def typestore() -> Typestore:
    """The wire's types: ROS 2's own and those of `msgs/msg`, compiled.

    Made on the first call (50 ms), because it costs as much as all of this package's imports together. Whatever
    opens a socket or a file calls it, so that no message has to wait for it.
    """
    store = get_typestore(Stores.EMPTY)
    definitions = {}
    for name, text in ROS_DEFINITIONS.items():
        definitions |= get_types_from_msg(text, name)
    for path in sorted(DEFINITIONS.glob("*.msg")):
        definitions |= get_types_from_msg(path.read_text(), f"steadypose_msgs/msg/{path.stem}")
    store.register(definitions)
    for codec in _CODECS.values():
        store.get_msgdef(codec.wire_type)
    return store


def wire_type(message_type: type[Message]) -> str:
    """The ROS 2 name of a message type, such as `steadypose_msgs/msg/PoseRaw`."""
    return _CODECS[message_type].wire_type


def encode(message: Message) -> bytes:
    """The message as CDR, little-endian, with its four bytes of encapsulation."""
    codec = _CODECS[type(message)]
    return bytes(typestore().serialize_cdr(codec.to_wire(message), codec.wire_type, little_endian=True))


def decode(topic: str, payload: bytes | memoryview) -> Message:
    """The message that travels on `topic`, from CDR of either byte order; its arrays are its own.

    Raises:
        DecodeError: for an unknown topic and for any bytes that are not such a message. Lengths are checked
            against the bytes that are there before anything is allocated.
    """
    if topic not in TOPICS:
        raise DecodeError(f"unknown topic {topic!r}: expected one of {', '.join(TOPICS)}")
    codec = _CODECS[TOPICS[topic]]
    try:
        check_size(topic, payload)
        return codec.from_wire(typestore().deserialize_cdr(payload, codec.wire_type))
    except (SerdeError, ValueError) as error:
        raise DecodeError(f"{topic}: {len(payload)} bytes are not a {codec.wire_type}: {error}") from error


def _ros(name: str) -> Any:
    return typestore().types[name]


def _flat(array: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    return np.ascontiguousarray(array, dtype).reshape(-1)


def _f32(array: NDArray[Any]) -> NDArray[Any]:
    return _flat(array, np.float32)


def _own(array: NDArray[Any], *shape: int) -> NDArray[Any]:
    # a copy: what was decoded is a read-only, perhaps unaligned view into the payload
    return np.array(array).reshape(shape)


def _header_to_wire(stamp_ns: int, frame_id: str) -> Any:
    time = _ros("builtin_interfaces/msg/Time")(*divmod(stamp_ns, 10**9))
    return _ros("std_msgs/msg/Header")(time, frame_id)


def _ns_from_wire(time: Any) -> int:
    if time.nanosec >= 10**9:
        raise ValueError(f"stamp.nanosec: expected under 1000000000, got {time.nanosec}")
    return time.sec * 10**9 + time.nanosec


def _pose_to_wire(position: NDArray[Any], orientation: NDArray[Any]) -> Any:
    return _ros("geometry_msgs/msg/Pose")(
        _ros("geometry_msgs/msg/Point")(*position.tolist()),
        _ros("geometry_msgs/msg/Quaternion")(*orientation.tolist()),
    )


def _position_from_wire(pose: Any) -> NDArray[np.float64]:
    return np.array([pose.position.x, pose.position.y, pose.position.z])


def _orientation_from_wire(pose: Any) -> NDArray[np.float64]:
    return np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])


def _raw_to_wire(m: PoseRaw) -> Any:
    body = _ros("steadypose_msgs/msg/RawBody")
    return _ros("steadypose_msgs/msg/PoseRaw")(
        header=_header_to_wire(m.stamp_ns, m.frame_id),
        source=m.source,
        skeleton=m.skeleton,
        sensor_pose=_pose_to_wire(m.sensor_pose.position, m.sensor_pose.orientation),
        calibrated=m.calibrated,
        bodies=[body(b.id, _f32(b.positions), _f32(b.confidence)) for b in m.bodies],
        end_of_stream=m.end_of_stream,
    )


def _raw_from_wire(w: Any) -> PoseRaw:
    return PoseRaw(
        stamp_ns=_ns_from_wire(w.header.stamp),
        frame_id=w.header.frame_id,
        source=w.source,
        skeleton=w.skeleton,
        sensor_pose=Pose(_position_from_wire(w.sensor_pose), _orientation_from_wire(w.sensor_pose)),
        calibrated=w.calibrated,
        bodies=[RawBody(b.id, _own(b.positions, -1, 3), _own(b.confidence, -1)) for b in w.bodies],
        end_of_stream=w.end_of_stream,
    )


def _clean_to_wire(m: PoseClean) -> Any:
    body = _ros("steadypose_msgs/msg/CleanBody")
    return _ros("steadypose_msgs/msg/PoseClean")(
        header=_header_to_wire(m.stamp_ns, m.frame_id),
        source=m.source,
        sensor_pose=_pose_to_wire(m.sensor_pose.position, m.sensor_pose.orientation),
        calibrated=m.calibrated,
        delay_frames=m.delay_frames,
        bodies=[
            body(
                id=b.id,
                positions=_f32(b.positions),
                rotations=_f32(b.rotations),
                state=_flat(b.state, np.uint8),
                sigma=_f32(b.sigma),
                anomaly=b.anomaly,
                anomaly_flag=b.anomaly_flag,
                joint_anomaly=_f32(b.joint_anomaly),
                bone_lengths=_f32(b.bone_lengths),
                raw_positions=_f32(b.raw_positions),
                raw_confidence=_f32(b.raw_confidence),
            )
            for b in m.bodies
        ],
        end_of_stream=m.end_of_stream,
    )


def _clean_from_wire(w: Any) -> PoseClean:
    return PoseClean(
        stamp_ns=_ns_from_wire(w.header.stamp),
        frame_id=w.header.frame_id,
        source=w.source,
        sensor_pose=Pose(_position_from_wire(w.sensor_pose), _orientation_from_wire(w.sensor_pose)),
        calibrated=w.calibrated,
        delay_frames=w.delay_frames,
        bodies=[
            CleanBody(
                id=b.id,
                positions=_own(b.positions, -1, 3),
                rotations=_own(b.rotations, -1, 4),
                state=_own(b.state, -1),
                sigma=_own(b.sigma, -1),
                anomaly=b.anomaly,
                anomaly_flag=b.anomaly_flag,
                joint_anomaly=_own(b.joint_anomaly, -1),
                bone_lengths=_own(b.bone_lengths, -1),
                raw_positions=_own(b.raw_positions, -1, 3),
                raw_confidence=_own(b.raw_confidence, -1),
            )
            for b in w.bodies
        ],
        end_of_stream=w.end_of_stream,
    )


def _world_to_wire(m: PoseWorld) -> Any:
    body = _ros("steadypose_msgs/msg/WorldBody")
    vector = _ros("geometry_msgs/msg/Vector3")
    return _ros("steadypose_msgs/msg/PoseWorld")(
        header=_header_to_wire(m.stamp_ns, m.frame_id),
        source=m.source,
        ground_plane=_flat(m.ground_plane, np.float64),
        bodies=[
            body(
                id=b.id,
                root_pose=_pose_to_wire(b.root_position, b.root_orientation),
                root_velocity=vector(*b.root_velocity.tolist()),
                covariance=_flat(b.covariance, np.float64),
                positions=_f32(b.positions),
                rotations=_f32(b.rotations),
                state=_flat(b.state, np.uint8),
                sigma=_f32(b.sigma),
                contacts=_f32(b.contacts),
                tracking=int(b.tracking),
            )
            for b in m.bodies
        ],
        end_of_stream=m.end_of_stream,
    )


def _world_from_wire(w: Any) -> PoseWorld:
    return PoseWorld(
        stamp_ns=_ns_from_wire(w.header.stamp),
        frame_id=w.header.frame_id,
        source=w.source,
        ground_plane=_own(w.ground_plane, -1),
        bodies=[
            WorldBody(
                id=b.id,
                root_position=_position_from_wire(b.root_pose),
                root_orientation=_orientation_from_wire(b.root_pose),
                root_velocity=np.array([b.root_velocity.x, b.root_velocity.y, b.root_velocity.z]),
                covariance=_own(b.covariance, 6, 6),
                positions=_own(b.positions, -1, 3),
                rotations=_own(b.rotations, -1, 4),
                state=_own(b.state, -1),
                sigma=_own(b.sigma, -1),
                contacts=_own(b.contacts, -1),
                tracking=Tracking(b.tracking),
            )
            for b in w.bodies
        ],
        end_of_stream=w.end_of_stream,
    )


def _events_to_wire(m: PoseEvents) -> Any:
    event, vector = _ros("steadypose_msgs/msg/Event"), _ros("geometry_msgs/msg/Vector3")
    time = _ros("builtin_interfaces/msg/Time")
    return _ros("steadypose_msgs/msg/PoseEvents")(
        header=_header_to_wire(m.stamp_ns, m.frame_id),
        source=m.source,
        events=[
            event(
                body=e.body,
                kind=int(e.kind),
                phase=int(e.phase),
                hand=int(e.hand),
                confidence=e.confidence,
                direction=vector(*e.direction.tolist()),
                since=time(*divmod(e.since_ns, 10**9)),
            )
            for e in m.events
        ],
        end_of_stream=m.end_of_stream,
    )


def _events_from_wire(w: Any) -> PoseEvents:
    return PoseEvents(
        stamp_ns=_ns_from_wire(w.header.stamp),
        frame_id=w.header.frame_id,
        source=w.source,
        events=[
            Event(
                body=e.body,
                kind=EventKind(e.kind),
                phase=Phase(e.phase),
                hand=Hand(e.hand),
                confidence=e.confidence,
                direction=np.array([e.direction.x, e.direction.y, e.direction.z]),
                since_ns=_ns_from_wire(e.since),
            )
            for e in w.events
        ],
        end_of_stream=w.end_of_stream,
    )


def _diagnostics_to_wire(m: Diagnostics) -> Any:
    pair = _ros("diagnostic_msgs/msg/KeyValue")
    status = _ros("diagnostic_msgs/msg/DiagnosticStatus")(
        level=int(m.level),
        name=m.node,
        message=m.message,
        hardware_id="",
        values=[pair(key, value) for key, value in m.values.items()],
    )
    return _ros("diagnostic_msgs/msg/DiagnosticArray")(header=_header_to_wire(m.stamp_ns, ""), status=[status])


def _diagnostics_from_wire(w: Any) -> Diagnostics:
    if len(w.status) != 1:
        raise ValueError(f"status: expected one, got {len(w.status)}")
    status = w.status[0]
    return Diagnostics(
        stamp_ns=_ns_from_wire(w.header.stamp),
        node=status.name,
        level=Level(status.level),
        message=status.message,
        values={pair.key: pair.value for pair in status.values},
    )


class _Codec(NamedTuple):
    wire_type: str
    to_wire: Callable[[Any], Any]
    from_wire: Callable[[Any], Message]


_CODECS: dict[type[Message], _Codec] = {
    PoseRaw: _Codec("steadypose_msgs/msg/PoseRaw", _raw_to_wire, _raw_from_wire),
    PoseClean: _Codec("steadypose_msgs/msg/PoseClean", _clean_to_wire, _clean_from_wire),
    PoseWorld: _Codec("steadypose_msgs/msg/PoseWorld", _world_to_wire, _world_from_wire),
    PoseEvents: _Codec("steadypose_msgs/msg/PoseEvents", _events_to_wire, _events_from_wire),
    Diagnostics: _Codec("diagnostic_msgs/msg/DiagnosticArray", _diagnostics_to_wire, _diagnostics_from_wire),
}
