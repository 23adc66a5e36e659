"""Frame format, acknowledgements of reliable subscribers, and the rule of one publisher per source.

A frame from the publisher holds one message:

    topic, UTF-8 | 0 | version, uint8 | publisher, uint32 | sequence, uint32 | sent, uint64 | CDR

Integers are little-endian; `sent` is the publisher's monotonic clock in nanoseconds.

A subscriber sends the publisher its ZeroMQ subscriptions. A named subscriber also sends its name in the form of a
subscription, and a reliable one acknowledges messages. Messages that are resent to one subscriber alone are prefixed by
its name's subscription and a zero byte.

A reliable subscriber acknowledges a message when it has finished with it: not on arrival, but once everything that
followed from it is safe. The publisher keeps unacknowledged messages. A restarted subscriber connects under the same
name. It receives the messages that its predecessor had not acknowledged, preceded by as many earlier messages as it
requests as context.
"""

import struct
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

VERSION = 2
MAX_FRAME = 2**20  # largest size of a frame, bytes. 100 people with 100 joints each take 160 kB.
PREFIX = struct.Struct("<BIIQ")

# No topic begins with this byte. It sorts last, and ZeroMQ sends subscriptions in sorted order: when a subscriber's
# name arrives, its topics are subscribed.
_NAME = b"\xff"
_TAKEN = b"\x02"
_COUNT = struct.Struct("<III")


class Listener(NamedTuple):
    """A named subscriber, as it identifies itself to publishers."""

    name: str
    instance: int
    """random number drawn at start, which distinguishes a restarted process from its predecessor, uint32"""
    reliable: tuple[str, ...] = ()  # topics of which it must not miss a message
    context: int = 0  # number of messages per topic to resend even though its predecessor had acknowledged them

    def subscription(self) -> bytes:
        """The subscription that identifies it, and that prefixes messages resent to it alone."""
        topics = " ".join(self.reliable).encode()
        return _NAME + b"\0".join([self.name.encode(), b"%08x" % self.instance, topics, b"%d" % self.context])


def read_subscription(prefix: bytes) -> Listener | None:
    """The listener that a subscription identifies; None for an ordinary subscription."""
    if not prefix.startswith(_NAME):
        return None
    try:
        name, instance, topics, context = prefix.removeprefix(_NAME).split(b"\0")
        return Listener(name.decode(), int(instance, 16), tuple(topics.decode().split()), int(context))
    except ValueError:
        return None


class Taken(NamedTuple):
    """A listener's acknowledgement of all messages of a publisher's topic before a sequence number."""

    instance: int
    publisher: int
    following: int  # sequence number of the message that it expects next
    topic: str

    def frame(self) -> bytes:
        return _TAKEN + _COUNT.pack(self.instance, self.publisher, self.following) + self.topic.encode()


def read_taken(frame: bytes, topics: Collection[str]) -> Taken | None:
    """The acknowledgement in a frame; None if the frame is something else."""
    if not frame.startswith(_TAKEN) or len(frame) < 1 + _COUNT.size:
        return None
    topic = frame[1 + _COUNT.size :].decode(errors="replace")
    instance, publisher, following = _COUNT.unpack_from(frame, 1)
    return Taken(instance, publisher, following, topic) if topic in topics else None


WINDOW = 256
"""Number of unacknowledged messages of a topic at which the publisher waits for a reliable subscriber.

With `MAX_CONTEXT` and other messages it stays below ZeroMQ's queue for a subscriber, so ZeroMQ drops none."""
MAX_CONTEXT = 512  # largest number of acknowledged messages that a subscriber can request as context
DEAF_S = 10.0
"""Silence after which the publisher no longer waits for a subscriber that has unread messages, seconds."""
WRAP = 2**32  # modulus of sequence numbers, which are uint32


@dataclass(eq=False)
class _Progress:
    """Progress of a subscriber."""

    following: dict[str, int]  # by topic, the sequence number of the next message to be acknowledged
    context: int  # number of acknowledged messages that it requests if it restarts
    sign_s: float  # time of its last sign of life, or since which it has unread messages, monotonic seconds

    def silent_s(self, sequence: Mapping[str, int]) -> float:
        """Time for which it has had unread messages without a sign of life, seconds."""
        if all(sequence[topic] == following for topic, following in self.following.items()):
            return 0.0
        return time.monotonic() - self.sign_s


class Deliveries:
    """Keeps a publisher's messages until the reliable subscribers ``names`` have acknowledged them.

    ``sequence`` is the number of each topic's next message, for a publisher that resumes a predecessor's stream.
    """

    def __init__(self, names: Collection[str], sequence: Mapping[str, int]) -> None:
        self.sequence = Counter(sequence)
        """sequence number of the next message, by topic"""
        self._names = frozenset(names)
        self._live: dict[Listener, _Progress] = {}
        self._last: dict[str, _Progress] = {}  # by name, the most recent subscriber, connected or not
        self._kept: deque[tuple[str, int, bytes]] = deque()

    def sent(self, topic: str, frame: bytes) -> None:
        """Record that the next message of a topic was sent as ``frame``."""
        for progress in self._live.values():
            if not progress.silent_s(self.sequence):
                progress.sign_s = time.monotonic()
        if any(topic in progress.following for progress in self._last.values()):
            self._kept.append((topic, self.sequence[topic], frame))
            self._drop_unneeded()
        self.sequence[topic] = (self.sequence[topic] + 1) % WRAP

    def join(self, listener: Listener) -> list[bytes]:
        """Record that a subscriber connected. Returns the frames to resend to it alone."""
        if listener.name not in self._names or not listener.reliable:
            return []
        before = self._last.get(listener.name)  # a successor recognises what it need not receive again
        inherited = before.following if before else {}
        following = {topic: inherited.get(topic, self.sequence[topic]) for topic in listener.reliable}
        self._live[listener] = self._last[listener.name] = progress = _Progress(
            following, min(max(listener.context, 0), MAX_CONTEXT), time.monotonic()
        )
        kept = [(frame, sequence, following[topic]) for topic, sequence, frame in self._kept if topic in following]
        return [frame for frame, sequence, expected in kept if _ahead(sequence + progress.context, expected)]

    def leave(self, listener: Listener) -> None:
        """Record that a subscriber disconnected."""
        gone, name = self._live.pop(listener, None), listener.name
        if gone is None:
            return
        if self._last[name] is gone:
            same = (progress for other, progress in self._live.items() if other.name == name)
            self._last[name] = next((progress for progress in same if not self._is_deaf(progress)), gone)
        elif self._is_deaf(self._last[name]):
            self._last[name] = gone

    def leave_all(self) -> None:
        for listener in list(self._live):
            self.leave(listener)

    def take(self, taken: Taken) -> None:
        """Record an acknowledgement. Impossible ones are ignored."""
        for listener, progress in self._live.items():
            if listener.instance == taken.instance and taken.topic in progress.following:
                progress.sign_s = time.monotonic()
                further = (taken.following - progress.following[taken.topic]) % WRAP
                if further < WRAP // 2:  # after a publisher's restart it may be ahead of the resent messages
                    further = min(further, self._behind(progress, taken.topic))
                    progress.following[taken.topic] = (progress.following[taken.topic] + further) % WRAP
        self._drop_unneeded()

    def waited_for(self, topic: str) -> frozenset[str]:
        """Names of the subscribers that must acknowledge messages before the topic's next message is sent."""
        return frozenset(
            listener.name
            for listener, progress in self._live.items()
            if topic in progress.following and not self._is_deaf(progress) and self._behind(progress, topic) >= WINDOW
        )

    def silent(self, for_s: float) -> frozenset[str]:
        """Names of the connected subscribers that have had unread messages for longer than ``for_s``."""
        return frozenset(
            listener.name for listener, progress in self._live.items() if progress.silent_s(self.sequence) > for_s
        )

    def is_taken(self, topic: str, sequence: int) -> bool:
        """Whether all reliable subscribers of a topic have acknowledged a message."""
        return all(
            topic not in progress.following
            or self._is_deaf(progress)
            or not _ahead(sequence, progress.following[topic])
            for progress in (*self._last.values(), *self._live.values())
        )

    def _is_deaf(self, progress: _Progress) -> bool:
        return progress in self._live.values() and progress.silent_s(self.sequence) > DEAF_S

    def _behind(self, progress: _Progress, topic: str) -> int:
        return (self.sequence[topic] - progress.following[topic]) % WRAP

    def _drop_unneeded(self) -> None:
        """Drop messages that no subscriber can still request, and the oldest ones if a subscriber stays away."""
        while self._kept:
            topic, sequence, _ = self._kept[0]
            wanted = any(
                topic in progress.following and _ahead(sequence + progress.context, progress.following[topic])
                for progress in (*self._last.values(), *self._live.values())
                if not self._is_deaf(progress)
            )
            if wanted and (self.sequence[topic] - sequence) % WRAP <= WINDOW + MAX_CONTEXT:
                return
            self._kept.popleft()


def _ahead(sequence: int, following: int) -> bool:
    """Whether a sequence number equals or follows the expected one."""
    return (sequence - following) % WRAP < WRAP // 2


AWAY_S = 1.0  # time of silence after which another publisher may take over a source, seconds
MOST = 1024  # largest number of remembered streams


class _Principal(NamedTuple):
    """The publisher of a stream: its number, its connection, when it was last heard, and its predecessor's number."""

    publisher: int
    connection: object
    heard_s: float
    before: int | None


class Principals:
    """Binds each source to the first publisher heard with it. The subscribers of one program share an instance.

    An address has one publisher at a time, so a new publisher at the same address is the restarted old one. If a source
    also comes from another address, it has two publishers, and only the first is admitted.
    """

    def __init__(self) -> None:
        self._bound: OrderedDict[tuple[str, str], _Principal] = OrderedDict()

    def admits(self, topic: str, source: str, publisher: int, connection: object, *, ended: bool = False) -> bool:
        """Whether a message comes from the publisher that its source is bound to.

        ``connection`` is the identity of a subscriber to a single address, None for one to several. If the stream has
        ``ended`` with this message, its source is released.
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
