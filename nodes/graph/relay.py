"""Acknowledgements of a lossless node, so that after a crash its successor continues without loss.

An input is answered once all reliable subscribers have acknowledged everything that was published up to the end of its
processing. Only then does this node acknowledge the input to its own publisher. So whichever process dies, a process
upstream still keeps each unanswered message. A restarted node also receives the last `CONTEXT` answered inputs, so that
bodies are not initialised anew. Their outputs are not published again, because the subscribers have them.

A node's progress is a few bytes in the directory of the sockets, written whenever a message is acknowledged by all
reliable subscribers. It is valid only for nodes of the same supervisor; a new run starts from the beginning.
"""

import os
import struct
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from steadypose.msgs.publisher import Publisher, Resume
from steadypose.msgs.types import Message, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.graph.clock import FRAME_NS

_FORM = struct.Struct("<qqqqqq")


class Progress(NamedTuple):
    """What was published and acknowledged."""

    publisher: int = 0  # the publisher's number
    sequence: tuple[int, int] = (0, 0)
    """sequence number of the next message of the node's first topic, and of its second"""
    mark: tuple[int, int] = (0, 0)  # the node's own note on the last message, `Node.mark`


CONTEXT = 384
"""Number of answered inputs that a restarted node receives again: 13 seconds at 30 Hz.

This is longer than any window, any delay, and the time for which bone lengths are measured. Bones are then measured
over other frames, so poses differ from those without a restart: in `walk_turn`, observed joints by 1.7 mm (median; 45
mm in one of a thousand), hidden ones by 2.6 mm (67 mm). With 128 messages it is 2.6 mm (84 mm) and 3.4 mm (80 mm)."""
BACK_NS = 1_000_000_000  # backward step of stamps beyond which the stream counts as started anew, nanoseconds


class Relay:
    """Tracks the inputs of a node and the outputs, on at most two ``topics``, that they caused.

    The progress is stored in ``file`` for the node's successor, unless ``supervisor``, the process id of what would
    restart this node, is 0. The successor publishes ``lag`` acknowledged messages again: if a subscriber dies together
    with a source, the source must supply that subscriber's context.
    """

    def __init__(self, file: Path, topics: tuple[str, ...], supervisor: int, lag: int = 0) -> None:
        self._path, self._supervisor = file, supervisor
        self._file: int | None = None
        self._topics = topics
        self.begun = self._read() if topics and supervisor else None
        self._answered = self.begun if self.begun and any(self.begun.sequence) else None
        self.context = CONTEXT if topics and supervisor else 0
        """number of answered inputs that a restarted node receives again"""
        self._recent: deque[Progress] = deque(maxlen=lag + 1)
        self._untaken: deque[tuple[str, int, tuple[int, int]]] = deque()
        self._published = self._taken = 0
        self._inputs: deque[int] = deque()  # for each input, messages published up to the end of its processing
        self._newest_ns = 0

    @property
    def resume(self) -> Resume | None:
        """State from which the publisher resumes the predecessor's stream; None if there is no predecessor."""
        if self.begun is None:
            return None
        return Resume(self.begun.publisher, dict(zip(self._topics, self.begun.sequence, strict=False)))

    def begin(self, publisher: Publisher) -> None:
        """Record the publisher, to distinguish its unacknowledged messages from those of another publisher."""
        if self._topics:
            self._recent.append(self.begun or Progress(publisher.id))
            self._keep(self._recent[0])

    def knows(self, topic: str, message: Message) -> bool:
        """Whether the subscribers already have this message from the node's predecessor."""
        if self._answered is None or topic not in self._topics:
            return False
        if not isinstance(message, PoseRaw | PoseClean | PoseWorld):
            return False
        newest_ns, ended = self._answered.mark
        again = message.stamp_ns < self._newest_ns - BACK_NS
        self._newest_ns = message.stamp_ns
        # the 30 Hz grid of a restarted node may be shifted by up to half a frame
        known = bool(ended) if message.end_of_stream else message.stamp_ns <= newest_ns + FRAME_NS / 2
        if not known or again:
            self._answered = None
        return self._answered is not None

    def published(self, publisher: Publisher, topic: str, mark: tuple[int, int]) -> None:
        if topic in self._topics:
            self._untaken.append((topic, publisher.deliveries.sequence[topic] - 1, mark))
            self._published += 1

    def handled(self) -> None:
        self._inputs.append(self._published)

    def settle(self, publisher: Publisher, timeout_s: float = 0.0) -> int:
        """Read acknowledgements, waiting up to ``timeout_s`` for the oldest. Returns the number of answered inputs."""
        newest: tuple[int, int] | None = None
        while self._untaken and publisher.is_taken(*self._untaken[0][:2], timeout_s=timeout_s):
            *_, newest = self._untaken.popleft()
            self._taken += 1
        if newest is not None:
            untaken = {topic: sequence for topic, sequence, _ in reversed(self._untaken)}
            following = [untaken.get(topic, publisher.deliveries.sequence[topic]) for topic in self._topics]
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
        """Whether all published messages were acknowledged."""
        return not self._untaken

    def forget(self) -> None:
        """Delete the progress, because the stream is finished."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        if self._supervisor:
            self._path.unlink(missing_ok=True)

    def _read(self) -> Progress | None:
        """The predecessor's progress; None if there is none, or it belongs to another supervisor."""
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
        form = _FORM.pack(self._supervisor, progress.publisher, *progress.sequence, *progress.mark)
        with suppress(OSError):  # on a full disk, a successor knows less; it starts anew, or repeats what is known
            if self._file is None:
                self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
            os.pwrite(self._file, form, 0)
