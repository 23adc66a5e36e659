"""What reliable subscribers have taken, and what they may still have to be sent again.

A reliable subscriber says of each message when it has done with it: not that it has arrived, but that whatever followed
from it is safe. What it has not taken is kept. Who comes under the name of one that has left, because its process was
started again, is sent what that one had not taken, and before that as much as it asks for to be in the picture.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from steadypose.msgs.wire import Listener, Taken

WINDOW = 256
"""messages of a topic that a reliable subscriber may be behind before it is waited for; with what is sent beside them,
and with `MAX_CONTEXT`, below the messages that ZeroMQ holds for a subscriber, so that it never drops one"""
MAX_CONTEXT = 256
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
