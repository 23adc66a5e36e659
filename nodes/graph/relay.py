"""What a lossless node has answered, so that the one after it is given what it had not.

An input has been answered once all that was published until it was worked on is taken by all reliable subscribers; only
then is it taken here. So whatever dies on the way, each message is still kept by somebody before it. A node that begins
anew is given `CONTEXT` answered inputs as well, lest bodies begin anew with it; what it makes of them, its subscribers
have, and it is not published again.

How far a node has come stands in a few bytes in the directory of the sockets, written with each message that all
reliable subscribers have taken. They hold for nodes of the same supervisor only; a new run begins at the beginning.
"""

from __future__ import annotations

import os
import struct
from collections import deque
from pathlib import Path
from typing import NamedTuple

from steadypose.msgs.publisher import Publisher, Resume
from steadypose.msgs.types import Message, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.graph.clock import FRAME_NS

_FORM = struct.Struct("<qqqqqq")


class Progress(NamedTuple):
    """What was published and taken."""

    publisher: int = 0
    """the publisher's number"""
    sequence: tuple[int, int] = (0, 0)
    """of the next message of the node's first topic, and of its second"""
    mark: tuple[int, int] = (0, 0)
    """what the node itself notes of the last message: `Node.mark`"""


CONTEXT = 384
"""messages, 13 seconds of a stream of 30 Hz: longer than any window and delay, and than bones are measured for. These
are then measured at another time, so that poses are not those without a restart: observed joints differ by
0.4 mm (median; at most 99), hidden ones by 11 mm (at most 123); with 128 messages, by 2.1 (528) and 13 (289)."""
BACK_NS = 1_000_000_000
"""a stamp so far before the last is of a stream that begins anew"""


class Relay:
    """Inputs, and what was published because of them.

    Args:
        file: keeps the progress for the next node.
        topics: that the node publishes, two at most.
        supervisor: process id of the node's supervisor, without whom nobody begins where this one ends; or 0.
        lag: messages before those that were not taken at which the next one begins. Of a source: a node that dies with
            it has to be given its context.
    """

    def __init__(self, file: Path, topics: tuple[str, ...], supervisor: int, lag: int = 0) -> None:
        self._path, self._supervisor = file, supervisor
        self._file: int | None = None
        self._topics = topics
        self.begun = self._read() if topics and supervisor else None
        self._answered = self.begun if self.begun and any(self.begun.sequence) else None
        self.context = CONTEXT if topics and supervisor else 0
        """answered inputs to be given again to one that begins anew"""
        self._recent: deque[Progress] = deque(maxlen=lag + 1)
        self._untaken: deque[tuple[str, int, tuple[int, int]]] = deque()
        self._published = self._taken = 0
        self._inputs: deque[int] = deque()  # of each, how much was published until it was worked on
        self._newest_ns = 0

    @property
    def resume(self) -> Resume | None:
        """Where the publisher of the node before ended."""
        if self.begun is None:
            return None
        return Resume(self.begun.publisher, dict(zip(self._topics, self.begun.sequence, strict=False)))

    def begin(self, publisher: Publisher) -> None:
        """Note who publishes: what is not taken of it is to be distinguished from what another one publishes."""
        if self._topics:
            self._recent.append(self.begun or Progress(publisher.id))
            self._keep(self._recent[0])

    def knows(self, topic: str, message: Message) -> bool:
        """Whether the subscribers have this from the node before this one."""
        if self._answered is None or topic not in self._topics:
            return False
        if not isinstance(message, PoseRaw | PoseClean | PoseWorld):
            return False
        newest_ns, ended = self._answered.mark
        again = message.stamp_ns < self._newest_ns - BACK_NS
        self._newest_ns = message.stamp_ns
        # the grid of one that begins anew may lie elsewhere between two frames
        known = bool(ended) if message.end_of_stream else message.stamp_ns <= newest_ns + FRAME_NS / 2
        if not known or again:
            self._answered = None
        return self._answered is not None

    def published(self, publisher: Publisher, topic: str, mark: tuple[int, int]) -> None:
        """Note what was just published."""
        if topic in self._topics:
            self._untaken.append((topic, publisher.sequence(topic) - 1, mark))
            self._published += 1

    def handled(self) -> None:
        """Note that an input was worked on."""
        self._inputs.append(self._published)

    def settle(self, publisher: Publisher, timeout_s: float = 0.0) -> int:
        """Note what was taken, waiting so long for the oldest; returns how many inputs are answered by that."""
        newest: tuple[int, int] | None = None
        while self._untaken and publisher.is_taken(*self._untaken[0][:2], timeout_s=timeout_s):
            *_, newest = self._untaken.popleft()
            self._taken += 1
        if newest is not None:
            untaken = {topic: sequence for topic, sequence, _ in reversed(self._untaken)}
            following = [untaken.get(topic, publisher.sequence(topic)) for topic in self._topics]
            first, second = (*following, 0)[:2]
            self._recent.append(Progress(publisher.id, (first, second), newest))
            self._keep(self._recent[0])
        answered = 0
        while self._inputs and self._inputs[0] <= self._taken:
            self._inputs.popleft()
            answered += 1
        return answered

    @property
    def settled(self) -> bool:
        """Whether all that was published is taken."""
        return not self._untaken

    def forget(self) -> None:
        """Keep no progress any more: the stream is finished."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if self._supervisor:
            self._path.unlink(missing_ok=True)

    def _read(self) -> Progress | None:
        """Where the node before this one was; None if there was none, or it was another supervisor's."""
        try:
            supervisor, publisher, *numbers = _FORM.unpack(self._path.read_bytes())
        except (OSError, struct.error):
            return None
        if supervisor != self._supervisor:
            return None
        return Progress(publisher, (numbers[0], numbers[1]), (numbers[2], numbers[3]))

    def _keep(self, progress: Progress) -> None:
        if not self._supervisor:
            return
        if self._file is None:
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        form = _FORM.pack(self._supervisor, progress.publisher, *progress.sequence, *progress.mark)
        os.pwrite(self._file, form, 0)
