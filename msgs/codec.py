"""Encodes and decodes messages as CDR, ROS 2's wire format, by the definitions in `msgs/msg`."""

import struct
from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from steadypose.msgs.forms import Array, ListOf, States
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD, TOPICS
from steadypose.msgs.types import Diagnostics, Level, Message, Pose, forms_of

MAX_BODIES = 128
MAX_EVENTS = 16 * MAX_BODIES
MAX_VALUES = 1000  # largest number of entries in one node's diagnostics
MAX_NAME = 1024
"""Largest size of a name (source, frame, layout) in UTF-8, bytes. Every node remembers a thousand sources."""
_HEADER = "iIs"
# the fields before the limited count, by struct's format characters with s for a string; and the limit
_BEFORE = {
    POSE_RAW: (_HEADER + "ss" + 7 * "d" + "?", MAX_BODIES),
    POSE_CLEAN: (_HEADER + "s" + 7 * "d" + "?" + "I", MAX_BODIES),
    POSE_WORLD: (_HEADER + "s" + 4 * "d", MAX_BODIES),
    POSE_EVENTS: (_HEADER + "s", MAX_EVENTS),
    POSE_TRUTH: (_HEADER + "s" + 4 * "d", MAX_BODIES),
    DIAGNOSTICS: (_HEADER + "I" + "B" + "sss", MAX_VALUES),
}


def check_size(topic: str, payload: bytes | memoryview) -> None:
    """Check the number of bodies, events or values in an encoded message, and its names, before it is decoded.

    A megabyte of bodies without joints would take seconds to decode, and would block all other messages. Raises
    ValueError if a number exceeds its limit.
    """
    before, most = _BEFORE[topic]
    order = "<" if len(payload) > 1 and payload[1] & 1 else ">"
    at = 0
    data = memoryview(payload)[4:]
    try:
        for kind in before:
            size = 4 if kind == "s" else struct.calcsize(kind)
            at += -at % size
            if kind == "s":
                (length,) = struct.unpack_from(f"{order}I", data, at)
                if length > MAX_NAME + 1 and topic != DIAGNOSTICS:  # with its zero byte
                    raise ValueError(f"expected names of at most {MAX_NAME} bytes, got {length - 1}")
                at += length
            at += size
        at += -at % 4
        (count,) = struct.unpack_from(f"{order}I", data, at)
    except struct.error:
        return  # too short; decoding raises the more precise error
    if count > most:
        raise ValueError(f"expected at most {most} bodies, events or values, got {count}")


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
"""ROS 2's definitions that the messages use. Loading all of rosbags' definitions would take 50 ms at every start."""


class DecodeError(ValueError):
    """Bytes that are not a message of the expected type."""


@cache
def typestore() -> Typestore:
    """The compiled message types: ROS 2's and those of `msgs/msg`.

    They are compiled on the first call (50 ms), not at import, because that takes as long as all of this package's
    imports together. Code that opens a socket or a file calls this function, so that no message waits for it.
    """
    store = get_typestore(Stores.EMPTY)
    definitions = {}
    for name, text in ROS_DEFINITIONS.items():
        definitions |= get_types_from_msg(text, name)
    for path in sorted(DEFINITIONS.glob("*.msg")):
        definitions |= get_types_from_msg(path.read_text(), f"steadypose_msgs/msg/{path.stem}")
    store.register(definitions)
    for kind in TOPICS.values():
        store.get_msgdef(wire_type(kind))
    return store


def wire_type(kind: type) -> str:
    """ROS 2 name of a message type, such as `steadypose_msgs/msg/PoseRaw`."""
    return "diagnostic_msgs/msg/DiagnosticArray" if kind is Diagnostics else f"steadypose_msgs/msg/{kind.__name__}"


def encode(message: Message) -> bytes:
    """Encode a message as little-endian CDR, with the four-byte encapsulation header."""
    kind = type(message)
    return bytes(typestore().serialize_cdr(_codec(kind).to_wire(message), wire_type(kind), little_endian=True))


def decode(topic: str, payload: bytes | memoryview) -> Message:
    """Decode a message of `topic` from CDR of either byte order. Its arrays are copies.

    Raises DecodeError if the topic is unknown, or the bytes are not a message of its type. Lengths are checked before
    memory is allocated.
    """
    if topic not in TOPICS:
        raise DecodeError(f"unknown topic {topic!r}: expected one of {', '.join(TOPICS)}")
    kind = TOPICS[topic]
    try:
        check_size(topic, payload)
        return _codec(kind).from_wire(typestore().deserialize_cdr(payload, wire_type(kind)))
    except (SerdeError, ValueError) as error:
        raise DecodeError(f"{topic}: {len(payload)} bytes are not a {wire_type(kind)}: {error}") from error


class _Codec(NamedTuple):
    to_wire: Callable[[Any], Any]
    from_wire: Callable[[Any], Any]


class _Part(NamedTuple):
    """One field of a definition: how to write it from a message, and how to read the message's fields from it."""

    write: Callable[[Any], Any]
    read: Mapping[str, Callable[[Any], Any]]


@cache
def _codec(kind: type) -> _Codec:
    """The codec of a message type, derived from its definition in `msgs/msg` and its fields' forms."""
    if kind is Diagnostics:
        return _Codec(_diagnostics_to_wire, _diagnostics_from_wire)
    store, name = typestore(), wire_type(kind)
    parts = [_part(kind, field, node) for field, node in store.fielddefs[name][1]]
    made, writes = store.types[name], [part.write for part in parts]
    reads = [item for part in parts for item in part.read.items()]
    return _Codec(
        lambda message: made(*[write(message) for write in writes]),
        lambda wire: kind(**{field: read(wire) for field, read in reads}),
    )


def _part(kind: type, field: str, node: Any) -> _Part:
    form = forms_of(kind).get(field)
    nodetype, what = node
    if isinstance(form, ListOf):
        item = _codec(form.kind)
        return _Part(
            lambda m: [item.to_wire(one) for one in getattr(m, field)],
            {field: lambda w: [item.from_wire(one) for one in getattr(w, field)]},
        )
    if nodetype in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        array = form.array if isinstance(form, States) else form
        assert isinstance(array, Array)
        dtype, shape = array.dtype, tuple(n if isinstance(n, int) else -1 for n in array.shape)
        # copied, because decoding yields a read-only and possibly unaligned view of the payload
        return _Part(
            lambda m: np.ascontiguousarray(getattr(m, field), dtype).reshape(-1),
            {field: lambda w: np.array(getattr(w, field)).reshape(shape)},
        )
    if what == "std_msgs/msg/Header":
        return _Part(
            lambda m: _header(m.stamp_ns, m.frame_id),
            {"stamp_ns": lambda w: _nanoseconds(w.header.stamp), "frame_id": lambda w: w.header.frame_id},
        )
    if what == "builtin_interfaces/msg/Time":
        name = f"{field}_ns"
        return _Part(lambda m: _time(getattr(m, name)), {name: lambda w: _nanoseconds(getattr(w, field))})
    if what == "geometry_msgs/msg/Vector3":
        vector = typestore().types[what]
        return _Part(lambda m: vector(*getattr(m, field).tolist()), {field: lambda w: _xyz(getattr(w, field))})
    if what == "geometry_msgs/msg/Pose" and field == "root_pose":
        return _Part(
            lambda m: _pose(m.root_position, m.root_orientation),
            {"root_position": lambda w: _xyz(w.root_pose.position), "root_orientation": lambda w: _xyzw(w.root_pose)},
        )
    if what == "geometry_msgs/msg/Pose":
        return _Part(
            lambda m: _pose(getattr(m, field).position, getattr(m, field).orientation),
            {field: lambda w: Pose(_xyz(getattr(w, field).position), _xyzw(getattr(w, field)))},
        )
    return _Part(attrgetter(field), {field: attrgetter(field)})


def _time(stamp_ns: int) -> Any:
    return typestore().types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))


def _nanoseconds(time: Any) -> int:
    if time.nanosec >= 10**9:
        raise ValueError(f"stamp.nanosec: expected under 1000000000, got {time.nanosec}")
    return time.sec * 10**9 + time.nanosec


def _header(stamp_ns: int, frame_id: str) -> Any:
    return typestore().types["std_msgs/msg/Header"](_time(stamp_ns), frame_id)


def _pose(position: NDArray[Any], orientation: NDArray[Any]) -> Any:
    pose, point, quaternion = (typestore().types[f"geometry_msgs/msg/{x}"] for x in ("Pose", "Point", "Quaternion"))
    return pose(point(*position.tolist()), quaternion(*orientation.tolist()))


def _xyz(wire: Any) -> NDArray[np.float64]:
    return np.array([wire.x, wire.y, wire.z])


def _xyzw(pose: Any) -> NDArray[np.float64]:
    turned = pose.orientation
    return np.array([turned.x, turned.y, turned.z, turned.w])


def _diagnostics_to_wire(m: Diagnostics) -> Any:
    types = typestore().types
    pair = types["diagnostic_msgs/msg/KeyValue"]
    values: list[Any] = [pair(key, value) for key, value in m.values.items()]
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=int(m.level), name=m.node, message=m.message, hardware_id="", values=values
    )
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=_header(m.stamp_ns, ""), status=[status])


def _diagnostics_from_wire(w: Any) -> Diagnostics:
    if len(w.status) != 1:
        raise ValueError(f"status: expected one, got {len(w.status)}")
    status = w.status[0]
    values = {pair.key: pair.value for pair in status.values}
    return Diagnostics(_nanoseconds(w.header.stamp), status.name, Level(status.level), status.message, values)
