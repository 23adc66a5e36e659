"""What is in the frames of a connection, whose messages are taken, and what reliable subscribers have taken of them.

From the publisher, one frame is one message:

    topic, UTF-8 | 0 | version, uint8 | publisher, uint32 | sequence, uint32 | sent, uint64 | CDR

with little-endian integers; `sent` is in nanoseconds of the publisher's monotonic clock.

To the publisher, beside the subscriptions of ZeroMQ itself: the name of a subscriber, as a subscription, and from one
that must miss nothing, which messages it has taken. What is for that subscriber alone, because it had not taken it when
it was started again, has that subscription and a zero byte before it.

A reliable subscriber says of each message when it has done with it: not that it has arrived, but that whatever followed
from it is safe. What it has not taken is kept. Who comes under the name of one that has left, because its process was
started again, is sent what that one had not taken, and before that as much as it asks for to be in the picture.
"""

from __future__ import annotations

import struct
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
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


WINDOW = 256
"""messages of a topic that a reliable subscriber may be behind before it is waited for; with what is sent beside them,
and with `MAX_CONTEXT`, below the messages that ZeroMQ holds for a subscriber, so that it never drops one"""
MAX_CONTEXT = 512
"""messages before those that somebody can ask for"""
DEAF_S = 10.0
"""without a sign of life for so long, a subscriber that has something to read is not waited for any more"""
WRAP = 2**32
"""sequence numbers are unsigned integers of 32 bits"""


@dataclass(eq=False)
class _Place:
    """How far a subscriber is.

    Attributes:
        following: of each topic, the sequence of the message that it takes next.
        context: messages before that it wants to see if it begins anew.
        sign_s: when it last gave a sign of life, or first had something to read.
    """

    following: dict[str, int]
    context: int
    sign_s: float

    def silent_s(self, sequence: Mapping[str, int]) -> float:
        """Since when it does not read what it could, seconds."""
        if all(sequence[topic] == following for topic, following in self.following.items()):
            return 0.0
        return time.monotonic() - self.sign_s


class Deliveries:
    """Keeps the messages of one publisher's reliable subscribers until they are taken.

    Args:
        names: of the subscribers.
        sequence: of the next message of each topic, for a publisher that goes on where another one ended.
    """

    def __init__(self, names: Collection[str], sequence: Mapping[str, int]) -> None:
        self.sequence = Counter(sequence)
        """of the next message of each topic"""
        self._names = frozenset(names)
        self._live: dict[Listener, _Place] = {}
        self._last: dict[str, _Place] = {}  # of each name, the one who came last, live or gone
        self._kept: deque[tuple[str, int, bytes]] = deque()

    def sent(self, topic: str, frame: bytes) -> None:
        """Note the next message of a topic, as it was sent."""
        for place in self._live.values():
            if not place.silent_s(self.sequence):
                place.sign_s = time.monotonic()
        if any(topic in place.following for place in self._last.values()):
            self._kept.append((topic, self.sequence[topic], frame))
            self._let_go()
        self.sequence[topic] = (self.sequence[topic] + 1) % WRAP

    def join(self, listener: Listener) -> list[bytes]:
        """Note that a subscriber is there; the frames to be sent to it alone."""
        if listener.name not in self._names or not listener.reliable:
            return []
        before = self._last.get(listener.name)  # what an heir need not have again, it knows itself
        inherited = before.following if before else {}
        following = {topic: inherited.get(topic, self.sequence[topic]) for topic in listener.reliable}
        self._live[listener] = self._last[listener.name] = place = _Place(
            following, min(max(listener.context, 0), MAX_CONTEXT), time.monotonic()
        )
        return [
            frame
            for topic, sequence, frame in self._kept
            if topic in following and _ahead(sequence + place.context, following[topic])
        ]

    def leave(self, listener: Listener) -> None:
        """Note that a subscriber is gone."""
        gone = self._live.pop(listener, None)
        if gone is None:
            return
        last = self._last[listener.name]
        if last is gone:
            same = (place for other, place in self._live.items() if other.name == listener.name)
            self._last[listener.name] = next((place for place in same if not self._is_deaf(place)), gone)
        elif self._is_deaf(last):
            self._last[listener.name] = gone

    def leave_all(self) -> None:
        """Note that all subscribers were disconnected."""
        for listener in list(self._live):
            self.leave(listener)

    def take(self, taken: Taken) -> None:
        """Note what a subscriber says that it has taken; what cannot be is ignored."""
        for listener, place in self._live.items():
            if listener.instance == taken.instance and taken.topic in place.following:
                place.sign_s = time.monotonic()
                further = (taken.following - place.following[taken.topic]) % WRAP
                if further < WRAP // 2:  # of a publisher that resumes it may have more than was sent again
                    further = min(further, self._behind(place, taken.topic))
                    place.following[taken.topic] = (place.following[taken.topic] + further) % WRAP
        self._let_go()

    def waited_for(self, topic: str) -> frozenset[str]:
        """The names of the subscribers that must take something before the next message of a topic is sent."""
        return frozenset(
            listener.name
            for listener, place in self._live.items()
            if topic in place.following and not self._is_deaf(place) and self._behind(place, topic) >= WINDOW
        )

    def silent(self, for_s: float) -> frozenset[str]:
        """The names of the subscribers that are there and have not read for so long, though they could."""
        return frozenset(
            listener.name for listener, place in self._live.items() if place.silent_s(self.sequence) > for_s
        )

    def is_taken(self, topic: str, sequence: int) -> bool:
        """Whether all reliable subscribers of a topic have taken a message."""
        return all(
            topic not in place.following or self._is_deaf(place) or not _ahead(sequence, place.following[topic])
            for place in (*self._last.values(), *self._live.values())
        )

    def _is_deaf(self, place: _Place) -> bool:
        return place in self._live.values() and place.silent_s(self.sequence) > DEAF_S

    def _behind(self, place: _Place, topic: str) -> int:
        return (self.sequence[topic] - place.following[topic]) % WRAP

    def _let_go(self) -> None:
        """Forget what nobody will ask for; and where somebody stays away, the oldest."""
        while self._kept:
            topic, sequence, _ = self._kept[0]
            wanted = any(
                topic in place.following and _ahead(sequence + place.context, place.following[topic])
                for place in (*self._last.values(), *self._live.values())
                if not self._is_deaf(place)
            )
            if wanted and (self.sequence[topic] - sequence) % WRAP <= WINDOW + MAX_CONTEXT:
                return
            self._kept.popleft()


def _ahead(sequence: int, following: int) -> bool:
    """Whether a message comes no earlier than the one that is expected next."""
    return (sequence - following) % WRAP < WRAP // 2


AWAY_S = 1.0
"""of silence after which another publisher may go on with a source"""
MOST = 1024
"""streams that are remembered"""


class _Principal(NamedTuple):
    """Who publishes a stream: its number, by which connection it came, when it was last heard, and who was before."""

    publisher: int
    connection: object
    heard_s: float
    before: int | None


class Principals:
    """Binds each source to the publisher that is first heard with it. To be shared by subscribers of one program.

    An address has one publisher at a time, so a new one there is the old one, started again; but a source that comes
    from elsewhere as well has two publishers, and only the first is heard.
    """

    def __init__(self) -> None:
        self._bound: OrderedDict[tuple[str, str], _Principal] = OrderedDict()

    def admits(self, topic: str, source: str, publisher: int, connection: object, *, ended: bool = False) -> bool:
        """Whether a message is from whom its source belongs to.

        Args:
            topic, source, publisher: of the message.
            connection: of a subscriber to a single address; None of one to several.
            ended: whether the stream ends with this message, and its source is free.
        """
        now_s, key = time.monotonic(), (topic, source)
        bound = self._bound.get(key)
        before = bound.before if bound else None
        if bound and bound.publisher != publisher:
            again = connection is not None and connection is bound.connection and publisher != bound.before
            if not again and now_s - bound.heard_s < AWAY_S:
                return False
            before = bound.publisher
        if ended:
            self._bound.pop(key, None)
            return True
        self._bound[key] = _Principal(publisher, connection, now_s, before)
        self._bound.move_to_end(key)
        if len(self._bound) > MOST:
            self._bound.popitem(last=False)
        return True
