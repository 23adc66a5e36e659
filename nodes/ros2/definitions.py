"""ROS 2's messages, created and serialised from their definitions without a ROS installation; and the interface of a
connection to its topics.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from steadypose.msgs.codec import DEFINITIONS

IDS_LIST = "std_msgs/Header header\nstring[] ids\n"  # definition of hri_msgs/IdsList (REP-155)


@cache
def ros_types() -> Typestore:
    """The types of ROS 2 Jazzy, of `msgs/msg`, and those used of hri_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions = get_types_from_msg(IDS_LIST, "hri_msgs/msg/IdsList")
    for path in sorted(DEFINITIONS.glob("*.msg")):
        definitions |= get_types_from_msg(path.read_text(), f"steadypose_msgs/msg/{path.stem}")
    store.register(definitions)
    return store


def new(kind: str, /, **fields: Any) -> Any:
    """Create a message of a type such as ``nav_msgs/msg/Odometry``.

    Omitted fields are zero or empty. They are shared between messages, so do not modify them.
    """
    return ros_types().types[kind](**_blank(kind) | fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    """``std_msgs/Header``."""
    types = ros_types().types
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), frame_id)


def stamp_ns(header: Any) -> int:
    """Stamp of a header, nanoseconds."""
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def serialise(message: Any) -> bytes:
    """Encode a message as CDR, with the four-byte encapsulation header."""
    return bytes(ros_types().serialize_cdr(message, message.__msgtype__))


def deserialise(cdr: bytes, name: str) -> Any:
    """Decode a message of a type from CDR. Raises rosbags' SerdeError if the bytes are not one."""
    return ros_types().deserialize_cdr(cdr, name)


@cache
def _blank(name: str) -> dict[str, Any]:
    return {field: _zero(node) for field, node in ros_types().fielddefs[name][1]}


def _zero(node: Any) -> Any:
    kind, what = node
    if kind == Nodetype.BASE:
        return {"string": "", "bool": False}.get(what[0], 0.0 if what[0].startswith("float") else 0)
    if kind == Nodetype.NAME:
        return new(what)
    item, count = what
    if item[0] == Nodetype.BASE and item[1][0] != "string":
        dtype = "uint8" if item[1][0] in ("byte", "char") else item[1][0]
        return np.zeros(count if kind == Nodetype.ARRAY else 0, dtype)
    return [_zero(item) for _ in range(count)] if kind == Nodetype.ARRAY else []


Publish = Callable[[bytes], None]  # function that publishes a message, given as CDR
DEPTH = 10  # queue length for a late subscriber, messages


class Connection(Protocol):
    """A node in a ROS domain. Not thread-safe."""

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        """Create a reliable publisher on a topic such as ``tf`` of a type such as ``tf2_msgs/msg/TFMessage``.

        If ``latched``, late subscribers receive the last message. Raises LaunchError if the type is not available.
        """
        ...

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        """Subscribe to a topic. `spin` calls ``heard`` with each message. Publishers may be reliable or best-effort."""
        ...

    def spin(self, timeout_s: float) -> None:
        """Wait for messages for at most ``timeout_s``, and pass them to their callbacks."""
        ...

    def drop(self, publish: Publish) -> None:
        """Remove a publisher."""
        ...

    def close(self) -> None: ...
