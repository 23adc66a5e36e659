"""The topics, and what travels on each."""

from collections.abc import Mapping
from types import MappingProxyType

from steadypose.msgs.types import Diagnostics, Message, PoseClean, PoseEvents, PoseRaw, PoseWorld

POSE_RAW = "pose/raw"
POSE_CLEAN = "pose/clean"
POSE_WORLD = "pose/world"
POSE_EVENTS = "pose/events"
POSE_TRUTH = "pose/truth"
"""the ground truth of a simulated stream"""
DIAGNOSTICS = "diagnostics"

TOPICS: Mapping[str, type[Message]] = MappingProxyType(
    {
        POSE_RAW: PoseRaw,
        POSE_CLEAN: PoseClean,
        POSE_WORLD: PoseWorld,
        POSE_EVENTS: PoseEvents,
        POSE_TRUTH: PoseWorld,
        DIAGNOSTICS: Diagnostics,
    }
)


def check_topic(topic: str, message: Message) -> None:
    """Raise `ValueError` unless `message` is of the type that travels on `topic`."""
    if topic not in TOPICS:
        raise ValueError(f"topic: expected one of {', '.join(TOPICS)}, got {topic!r}")
    if type(message) is not TOPICS[topic]:
        raise ValueError(f"{topic}: expected {TOPICS[topic].__name__}, got {type(message).__name__}")
