"""Recordings: rosbag2 directories with MCAP storage, which `ros2 bag`, Foxglove and rosbags also read.

In the file, a topic has its ROS name (`/pose/raw` for `pose/raw`), and a message's log time is its stamp.
"""

import heapq
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Schema
from rosbags.typesys import TypesysError, get_types_from_msg

from steadypose.msgs import Closing
from steadypose.msgs.codec import DecodeError, decode, typestore, wire_type
from steadypose.msgs.mcap_file import BROKEN, McapFile
from steadypose.msgs.recording_writer import RecordingError, RecordingWriter, definition
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.types import Message

__all__ = ["Recorded", "RecordingError", "RecordingReader", "RecordingWriter"]


class Recorded(NamedTuple):
    """A recorded message, its topic, and its stamp in the file in nanoseconds."""

    topic: str
    stamp_ns: int
    message: Message


class RecordingReader(Closing):
    """Reads a recording made by steadypose, complete or truncated, or by `ros2 bag record` with the same types.

    A context manager. Iteration yields the messages of steadypose's topics in the order of their stamps, and skips
    other topics.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a rosbag2 directory, with or without `metadata.yaml`, or a single `.mcap` file.

        Raises RecordingError if there is no recording, or it has no messages, or other message definitions.
        """
        self.path = Path(path)
        self.refused: Counter[str] = Counter()
        """number of messages skipped because they could not be decoded, by topic"""
        self._files = ExitStack()
        with ExitStack() as undo:
            undo.callback(self._files.close)
            files = [self.path] if self.path.is_file() else sorted(self.path.glob("*.mcap"), key=_in_order)
            if not files:
                raise RecordingError(f"{path}: expected a directory with .mcap files, or one such file; found none")
            self._parts = [self._open(file) for file in files]
            self._counts = self._count()
            if not self._counts:
                lost = f"{self.lost_bytes} bytes could not be read"
                raise RecordingError(f"{self.path} holds no message on any of {', '.join(TOPICS)}; {lost}")
            undo.pop_all()
        self.topics = tuple(topic for topic in TOPICS if topic in self._counts)
        filled = [part for part in self._parts if part.places]
        self.start_ns = min(part.start_ns for part in filled)
        self.end_ns = max(part.end_ns for part in filled)
        self.complete = all(part.complete for part in self._parts)
        """False if the writer was killed or a file is truncated; the readable messages are available"""

    @property
    def lost_bytes(self) -> int:
        """Number of unreadable bytes known so far. Damage is detected while messages are read."""
        return sum(part.lost_bytes for part in self._parts)

    @property
    def gaps(self) -> int:
        """Number of unreadable pieces known so far."""
        return sum(part.gaps for part in self._parts)

    @property
    def duration_s(self) -> float:
        """Time from the first stamp to the last, seconds."""
        return (self.end_ns - self.start_ns) / 1e9

    def count(self, topic: str) -> int:
        """Number of messages on a topic."""
        return self._counts[topic]

    def __iter__(self) -> Iterator[Recorded]:
        return self.messages()

    def messages(self, topics: Iterable[str] | None = None, *, start_ns: int | None = None) -> Iterator[Recorded]:
        """The messages on `topics` from `start_ns` on, in the order of their stamps, then of recording.

        Chunks that end before `start_ns` are not read. A damaged chunk is skipped, and counted in `lost_bytes`. Raises
        RecordingError if the file can no longer be read, ValueError if a topic does not exist.
        """
        wanted = set(TOPICS if topics is None else topics)
        if unknown := wanted - TOPICS.keys():
            raise ValueError(f"topics: expected some of {', '.join(TOPICS)}, got {', '.join(sorted(unknown))}")
        names = wanted | {f"/{topic}" for topic in wanted}
        parts = (part.messages(names, start_ns) for part in self._parts)
        try:
            for log_ns, channel, data in heapq.merge(*parts, key=lambda logged: logged.log_ns):
                topic = _topic(channel)
                try:
                    yield Recorded(topic, log_ns, decode(topic, data))
                except DecodeError:
                    self.refused[topic] += 1
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror}") from error

    def _open(self, path: Path) -> McapFile:
        try:
            return McapFile(self._files.enter_context(path.open("rb")), path.stat().st_size)
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error.strerror}") from error
        except BROKEN as error:
            raise RecordingError(f"{path}, of {path.stat().st_size} bytes, is not an MCAP file") from error

    def _count(self) -> Counter[str]:
        counts: Counter[str] = Counter()
        for part in self._parts:
            for channel in part.channels.values():
                topic, number = _topic(channel), part.counts[channel.id]
                if topic in TOPICS and number:
                    self._check_definition(topic, channel, part.schemas.get(channel.schema_id))
                    counts[topic] += number
        return counts

    def _check_definition(self, topic: str, channel: Channel, schema: Schema | None) -> None:
        expected = wire_type(TOPICS[topic])
        if schema is None or schema.name != expected or channel.message_encoding != "cdr":
            got = f"{schema.name if schema else 'no type'} as {channel.message_encoding or 'unknown bytes'}"
            raise RecordingError(f"{self.path}: expected {expected} as cdr on {topic}, got {got}")
        text = schema.data.decode(errors="replace")
        if text == definition(expected):
            return
        try:
            recorded = get_types_from_msg(text, expected)
        except TypesysError as error:
            raise RecordingError(f"{self.path}: cannot read the definition of {expected}") from error
        known = typestore().fielddefs
        if any(name not in known or list(known[name][1]) != list(fields) for name, (_, fields) in recorded.items()):
            raise RecordingError(f"{self.path} was recorded with another definition of {expected}: record it again")

    def close(self) -> None:
        self._files.close()


def _topic(channel: Channel) -> str:
    return channel.topic.removeprefix("/")


def _in_order(path: Path) -> list[tuple[int, str]]:
    """Sort key that orders parts by number: the tenth after the ninth."""
    return [(int(text), "") if text.isdecimal() else (-1, text) for text in re.split(r"(\d+)", path.name)]
