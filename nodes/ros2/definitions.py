"""ROS 2's message types from their definitions: made, serialised and read without a ROS installation; and what a
connection to its topics can do.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from steadypose.msgs.codec import DEFINITIONS

IDS_LIST = "std_msgs/Header header\nstring[] ids\n"
"""hri_msgs/IdsList of REP-155"""


@cache
def ros_types() -> Typestore:
    """The types of Jazzy, of `msgs/msg`, and what is used of hri_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions = get_types_from_msg(IDS_LIST, "hri_msgs/msg/IdsList")
    for path in sorted(DEFINITIONS.glob("*.msg")):
        definitions |= get_types_from_msg(path.read_text(), f"steadypose_msgs/msg/{path.stem}")
    store.register(definitions)
    return store


def new(kind: str, /, **fields: Any) -> Any:
    """A message of a type such as ``nav_msgs/msg/Odometry``; fields that are left out are zero or empty, and shared."""
    return ros_types().types[kind](**_blank(kind) | fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    """``std_msgs/Header``."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    types = ros_types().types
    return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, nanoseconds), frame_id)


def stamp_ns(header: Any) -> int:
    """Nanoseconds of a header."""
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def serialise(message: Any, name: str) -> bytes:
    """A message as CDR, with its four bytes of encapsulation."""
    return bytes(ros_types().serialize_cdr(message, name))


def deserialise(cdr: bytes, name: str) -> Any:
    """Raises:
    rosbags.serde.SerdeError: the bytes are no such message.
    """
    return ros_types().deserialize_cdr(cdr, name)


def type_hash(name: str) -> str:
    """REP-2011's hash of a type, by which ROS 2 distinguishes its versions."""
    return ros_types().hash_rihs01(name)


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


Publish = Callable[[bytes], None]
"""a message, as CDR"""
DEPTH = 10
"""messages held for a subscriber that is late"""


class Connection(Protocol):
    """A node in a ROS domain. Not thread-safe."""

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        """A reliable publisher of messages on a topic.

        Args:
            topic: such as ``tf``; without a leading slash.
            kind: such as ``tf2_msgs/msg/TFMessage``.
            latched: whether late subscribers get the last message (TRANSIENT_LOCAL).

        Raises:
            LaunchError: the type is not available.
        """
        ...

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        """Call ``heard`` with each message of a topic from `spin`; publishers may be reliable or best-effort."""
        ...

    def spin(self, timeout_s: float) -> None:
        """Wait for messages, for so long at most, and pass them to their callbacks."""
        ...

    def drop(self, publish: Publish) -> None:
        """Publish there no more."""
        ...

    def close(self) -> None: ...
