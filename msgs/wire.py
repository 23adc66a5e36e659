"""What is in the frames of a connection.

From the publisher, one frame is one message:

    topic, UTF-8 | 0 | version, uint8 | publisher, uint32 | sequence, uint32 | sent, uint64 | CDR

with little-endian integers; `sent` is in nanoseconds of the publisher's monotonic clock.

To the publisher, beside the subscriptions of ZeroMQ itself: the name of a subscriber, as a subscription, and from one
that must miss nothing, which messages it has taken. What is for that subscriber alone, because it had not taken it when
it was started again, has that subscription and a zero byte before it.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import NamedTuple

VERSION = 2
MAX_FRAME = 2**20
"""bytes; 100 people with 100 joints each are 160 kB"""
PREFIX = struct.Struct("<BIIQ")

# No topic begins with this byte. It is also the last in order, and ZeroMQ subscribes in that order: whose name has
# arrived gets its topics.
_NAME = b"\xff"
_TAKEN = b"\x02"
_COUNT = struct.Struct("<III")


class Listener(NamedTuple):
    """A subscriber with a name, as it makes itself known."""

    name: str
    instance: int
    """drawn at random at start, so that a restarted publisher is recognised as a new one, uint32"""
    reliable: tuple[str, ...] = ()
    """topics of which it must miss nothing"""
    context: int = 0
    """messages of each that it wants to see again, if the one of this name before it had taken them"""

    def subscription(self) -> bytes:
        """What it subscribes to, to be known, and to be sent what is for it alone."""
        topics = " ".join(self.reliable).encode()
        return _NAME + b"\0".join([self.name.encode(), b"%08x" % self.instance, topics, b"%d" % self.context])


def read_subscription(prefix: bytes) -> Listener | None:
    """The listener that a subscription makes known; None if it is another subscription."""
    if not prefix.startswith(_NAME):
        return None
    try:
        name, instance, topics, context = prefix.removeprefix(_NAME).split(b"\0")
        return Listener(name.decode(), int(instance, 16), tuple(topics.decode().split()), int(context))
    except ValueError:
        return None


class Taken(NamedTuple):
    """How far a listener has come with a topic of a publisher."""

    instance: int
    publisher: int
    following: int
    """sequence of the message that it expects next"""
    topic: str

    def frame(self) -> bytes:
        return _TAKEN + _COUNT.pack(self.instance, self.publisher, self.following) + self.topic.encode()


def read_taken(frame: bytes, topics: Collection[str]) -> Taken | None:
    """What a frame says of a listener's progress; None if it is something else."""
    if not frame.startswith(_TAKEN) or len(frame) < 1 + _COUNT.size:
        return None
    topic = frame[1 + _COUNT.size :].decode(errors="replace")
    instance, publisher, following = _COUNT.unpack_from(frame, 1)
    return Taken(instance, publisher, following, topic) if topic in topics else None
