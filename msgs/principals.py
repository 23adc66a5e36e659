"""One publisher a stream: who publishes as a source, and who else tries to."""

from __future__ import annotations

import time
from collections import OrderedDict
from typing import NamedTuple

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
