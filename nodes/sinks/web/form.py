"""Messages as JSON, for programs that have no CDR: what docs/browser.md describes.

Positions are in metres, to a tenth of a millimetre; what is not finite is null. Stamps are seconds of capture: a
JavaScript number has no room for nanoseconds.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import DIAGNOSTICS, POSE_EVENTS, POSE_WORLD
from steadypose.msgs.types import (
    CONTACTS,
    JOINTS,
    Diagnostics,
    Event,
    EventKind,
    JointState,
    Message,
    PoseEvents,
    PoseWorld,
    WorldBody,
)
from steadypose.prior.body.skeleton import PARENTS

VERSION = 1
HELLO = "hello"


def hello() -> str:
    """What a client gets first: the names that the numbers of all other messages stand for."""
    return _text(
        {
            "topic": HELLO,
            "version": VERSION,
            "joints": JOINTS,
            "parents": PARENTS,
            "contacts": CONTACTS,
            "states": [state.name for state in JointState],
            "events": [kind.name for kind in EventKind],
        }
    )


def to_json(message: Message) -> str | None:
    """One message; None of what browsers do not get."""
    if isinstance(message, PoseWorld):
        return _text(_header(POSE_WORLD, message) | {"bodies": [_body(body) for body in message.bodies]})
    if isinstance(message, PoseEvents):
        return _text(_header(POSE_EVENTS, message) | {"events": [_event(event) for event in message.events]})
    if isinstance(message, Diagnostics):
        return _text(
            {
                "topic": DIAGNOSTICS,
                "stamp": message.stamp_ns / 1e9,
                "node": message.node,
                "level": message.level.name,
                "message": message.message,
                "values": message.values,
            }
        )
    return None


def _header(topic: str, message: PoseWorld | PoseEvents) -> dict[str, Any]:
    return {
        "topic": topic,
        "stamp": message.stamp_ns / 1e9,
        "frame": message.frame_id,
        "source": message.source,
        "end": message.end_of_stream,
    }


def _body(body: WorldBody) -> dict[str, Any]:
    return {
        "id": body.id,
        "tracking": body.tracking.name,
        "root": _numbers(body.root_position),
        "orientation": _numbers(body.root_orientation),
        "velocity": _numbers(body.root_velocity),
        "positions": _numbers(body.positions),
        "state": body.state.tolist(),
        "sigma": _numbers(body.sigma),
        "contacts": _numbers(body.contacts),
    }


def _event(event: Event) -> dict[str, Any]:
    return {
        "body": event.body,
        "kind": event.kind.name,
        "phase": event.phase.name,
        "hand": event.hand.name,
        "confidence": round(event.confidence, 3) if math.isfinite(event.confidence) else None,
        "direction": _numbers(event.direction) if event.kind == EventKind.POINTS else None,
        "since": event.since_ns / 1e9,
    }


def _numbers(values: NDArray[np.floating]) -> list[Any]:
    rounded = np.round(values.astype(np.float64), 4)
    if np.isfinite(rounded).all():
        return rounded.tolist()
    return _without_nan(rounded.tolist())


def _without_nan(values: Any) -> Any:
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return values if math.isfinite(values) else None


def _text(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
