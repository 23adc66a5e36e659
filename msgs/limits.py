"""Limits of a message's size, checked before any of it is decoded."""

from __future__ import annotations

import struct

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD

MAX_BODIES = 128
MAX_EVENTS = 16 * MAX_BODIES
MAX_VALUES = 1000
"""of one node's diagnostics"""

_HEADER = "iIs"
#: what comes before the count that is limited: numbers as `struct` names them, s for a string
_BEFORE = {
    POSE_RAW: (_HEADER + "ss" + 7 * "d" + "?", MAX_BODIES),
    POSE_CLEAN: (_HEADER + "s" + 7 * "d" + "?" + "I", MAX_BODIES),
    POSE_WORLD: (_HEADER + "s" + 4 * "d", MAX_BODIES),
    POSE_EVENTS: (_HEADER + "s", MAX_EVENTS),
    POSE_TRUTH: (_HEADER + "s" + 4 * "d", MAX_BODIES),
    DIAGNOSTICS: (_HEADER + "I" + "B" + "sss", MAX_VALUES),
}


def check_size(topic: str, payload: bytes | memoryview) -> None:
    """Raises:
    ValueError: CDR of a message that holds more bodies, events or values than any is to hold. A million bytes of bodies
        without joints would take seconds to decode, in which nobody else is heard.
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
                at += length
            at += size
        at += -at % 4
        (count,) = struct.unpack_from(f"{order}I", data, at)
    except struct.error:
        return  # too short, which decoding says better
    if count > most:
        raise ValueError(f"expected at most {most} bodies, events or values, got {count}")
