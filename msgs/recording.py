"""Recordings: rosbag2 directories with MCAP storage, which `ros2 bag`, Foxglove and rosbags read too.

A topic has its ROS name in the file (`/pose/raw` for `pose/raw`); a message is filed under the stamp it is of. No
clock and no chance goes into the `.mcap`: the same messages make the same bytes.

A writer that is killed loses at most the last half second of what it was given, counted in stamps: MCAP's chunks
are closed, and handed to the operating system, as often as that. The file then has no index and the directory no
`metadata.yaml`; `RecordingReader` makes the index anew.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, McapRecord, Schema, Statistics
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer
from rosbags.typesys import TypesysError, get_types_from_msg

from steadypose.msgs.codec import DecodeError, decode, encode, typestore, wire_type
from steadypose.msgs.topics import TOPICS, check_topic
from steadypose.msgs.types import Message

if TYPE_CHECKING:
    from typing_extensions import Self

CHUNK_NS = 500_000_000
CHUNK_BYTES = 2**18

# what the mcap package raises, somewhere, for bytes that are not MCAP
_BROKEN = (McapError, ValueError, KeyError, EOFError, OSError, RuntimeError, OverflowError, MemoryError, struct.error)


class RecordingError(ValueError):
    """A recording that cannot be made or read. The text says why."""


class RecordingWriter:
    """Writes messages to a new rosbag2 directory. A context manager; leaving it completes the recording."""

    def __init__(self, directory: str | Path) -> None:
        """Make `directory`, and its parents where they are missing.

        Raises:
            RecordingError: if it is there already, or cannot be made.
        """
        self._directory = Path(directory)
        self._file_name = f"{self._directory.name}_0.mcap"
        typestore()
        try:
            self._directory.mkdir(parents=True)
            self._file = (self._directory / self._file_name).open("xb")
        except OSError as error:
            raise RecordingError(f"cannot record to {directory}: {error.strerror}") from error
        # compression would cost more time than it saves space: floats of a noisy sensor hardly shrink
        self._writer = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="steadypose")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._first_ns = 2**63 - 1
        self._last_ns = 0
        self._written: dict[str, int] = {}
        self._flushed: dict[str, int] = {}
        self._pending = 0
        self._flush()

    def write(self, topic: str, message: Message, stamp_ns: int) -> None:
        """Append a message, to be found at `stamp_ns` (0 or later); stamps need not rise.

        Raises:
            ValueError: if the message is not of the topic's type, or the stamp is negative.
        """
        check_topic(topic, message)
        if stamp_ns < 0:
            raise ValueError(f"stamp_ns: expected 0 or more, got {stamp_ns}")
        payload = encode(message)
        self._writer.add_message(
            self._channel(topic), log_time=stamp_ns, publish_time=stamp_ns, data=payload, sequence=self._counts[topic]
        )
        self._counts[topic] += 1
        self._first_ns = min(self._first_ns, stamp_ns)
        self._last_ns = max(self._last_ns, stamp_ns)
        self._written[topic] = stamp_ns
        self._pending += len(payload)
        # by topic, because the clocks of two topics may have nothing to do with each other; and in both directions,
        # because a clock may be set back
        flushed = self._flushed.get(topic)
        if flushed is None or abs(stamp_ns - flushed) >= CHUNK_NS or self._pending >= CHUNK_BYTES:
            self._flush()

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            name = wire_type(TOPICS[topic])
            if name not in self._schemas:
                definition = _definition(name).encode()
                self._schemas[name] = self._writer.register_schema(name, "ros2msg", definition)
            self._channels[topic] = self._writer.register_channel(
                f"/{topic}",
                "cdr",
                self._schemas[name],
                {"offered_qos_profiles": "", "topic_type_hash": typestore().hash_rihs01(name)},
            )
        return self._channels[topic]

    def _flush(self) -> None:
        self._writer.flush()
        self._flushed = dict(self._written)
        self._pending = 0

    def close(self) -> None:
        """Complete the recording: the index, and `metadata.yaml`."""
        if self._file.closed:
            return
        self._writer.finish()
        self._file.close()
        self._write_metadata()

    def _write_metadata(self) -> None:
        from ruamel.yaml import YAML  # slow to import, and only those who record need it

        count = self._counts.total()
        start = {"nanoseconds_since_epoch": self._first_ns if count else 0}
        duration = {"nanoseconds": max(0, self._last_ns - self._first_ns)}
        information = {
            "version": 8,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._file_name],
            "starting_time": start,
            "duration": duration,
            "message_count": count,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": f"/{topic}",
                        "type": wire_type(TOPICS[topic]),
                        "serialization_format": "cdr",
                        "offered_qos_profiles": "",
                        "type_description_hash": typestore().hash_rihs01(wire_type(TOPICS[topic])),
                    },
                    "message_count": self._counts[topic],
                }
                for topic in self._channels
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._file_name, "starting_time": start, "duration": duration, "message_count": count}],
            "custom_data": None,
            "ros_distro": "",
        }
        yaml = YAML(typ="safe")
        yaml.default_flow_style = False
        yaml.representer.ignore_aliases = lambda *_: True
        unfinished = self._directory / "metadata.yaml.tmp"
        with unfinished.open("w") as file:
            yaml.dump({"rosbag2_bagfile_information": information}, file)
        unfinished.replace(self._directory / "metadata.yaml")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class Recorded(NamedTuple):
    """A message of a recording: its topic, and the stamp it is filed under, in nanoseconds."""

    topic: str
    stamp_ns: int
    message: Message


class RecordingReader:
    """Reads a recording: one made here, complete or cut short, or one of `ros2 bag record` with the same types.

    A context manager. Iterating gives every message of the project's topics, in the order of their stamps; other
    topics are passed over.
    """

    def __init__(self, path: str | Path) -> None:
        """Open a rosbag2 directory, with or without `metadata.yaml`, or one `.mcap`.

        Raises:
            RecordingError: if there is no recording, no message in it, or it was made with other definitions.
        """
        self.path = Path(path)
        self.refused: Counter[str] = Counter()
        """messages passed over because they could not be decoded, by topic"""
        self._files = ExitStack()
        with ExitStack() as undo:
            undo.callback(self._files.close)
            self._readers = [self._open(file) for file in self._find()]
            summaries = [reader.get_summary() for reader in self._readers]
            self._counts = self._count(summaries)
            if not self._counts:
                unread = sum(reader.lost_bytes for reader in self._readers)
                raise RecordingError(
                    f"{self.path} holds no message on any of {', '.join(TOPICS)}; {unread} bytes could not be read"
                )
            undo.pop_all()
        self.topics = tuple(topic for topic in TOPICS if topic in self._counts)
        statistics = [s.statistics for s in summaries if s.statistics and s.statistics.message_count]
        self.start_ns = min(s.message_start_time for s in statistics)
        self.end_ns = max(s.message_end_time for s in statistics)
        self.complete = all(reader.complete for reader in self._readers)
        """False if the writer was killed or the file cut short: what could be read is here"""
        self.lost_bytes = sum(reader.lost_bytes for reader in self._readers)
        """bytes at the end of the files that could not be read"""

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    def count(self, topic: str) -> int:
        """How many messages there are on a topic."""
        return self._counts[topic]

    def __iter__(self) -> Iterator[Recorded]:
        return self.messages()

    def messages(self, topics: Iterable[str] | None = None, *, start_ns: int | None = None) -> Iterator[Recorded]:
        """The messages on `topics`, from `start_ns` on, in the order of their stamps, then of recording.

        Seeking reads no more of the file than what comes at and after `start_ns`.

        Raises:
            RecordingError: on coming to bytes that are damaged.
            ValueError: for a topic that does not exist.
        """
        wanted = set(TOPICS if topics is None else topics)
        if unknown := wanted - TOPICS.keys():
            raise ValueError(f"topics: expected of {', '.join(TOPICS)}, got {', '.join(sorted(unknown))}")
        names = wanted | {f"/{topic}" for topic in wanted}
        try:
            streams = [reader.iter_messages(names, starting_at=start_ns) for reader in self._readers]
            for _, channel, record in heapq.merge(*streams, key=lambda found: found[2].log_time):
                topic = _topic(channel)
                try:
                    yield Recorded(topic, record.log_time, decode(topic, record.data))
                except DecodeError:
                    self.refused[topic] += 1
        except _BROKEN as error:
            raise RecordingError(f"{self.path} is damaged: {error}") from error

    def _find(self) -> list[Path]:
        files = [self.path] if self.path.is_file() else sorted(self.path.glob("*.mcap"))
        if not files:
            raise RecordingError(f"{self.path}: expected a directory with .mcap files, or one such file; found none")
        return files

    def _open(self, path: Path) -> _Reader:
        try:
            file = self._files.enter_context(path.open("rb"))
            return _Reader(file, path.stat().st_size)
        except OSError as error:
            raise RecordingError(f"cannot read {path}: {error.strerror}") from error
        except _BROKEN as error:
            raise RecordingError(f"{path}, of {path.stat().st_size} bytes, is not an MCAP file") from error

    def _count(self, summaries: list[Summary]) -> Counter[str]:
        counts: Counter[str] = Counter()
        for summary in summaries:
            for channel in summary.channels.values():
                topic = _topic(channel)
                number = summary.statistics.channel_message_counts.get(channel.id, 0) if summary.statistics else 0
                if topic in TOPICS and number:
                    self._check_definition(topic, channel, summary.schemas.get(channel.schema_id))
                    counts[topic] += number
        return counts

    def _check_definition(self, topic: str, channel: Channel, schema: Schema | None) -> None:
        expected = wire_type(TOPICS[topic])
        if schema is None or schema.name != expected or channel.message_encoding != "cdr":
            got = f"{schema.name if schema else 'no type'} as {channel.message_encoding or 'unknown bytes'}"
            raise RecordingError(f"{self.path}: expected {expected} as cdr on {topic}, got {got}")
        text = schema.data.decode(errors="replace")
        if text == _definition(expected):
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class _Reader(SeekingReader):
    """An MCAP reader that makes the index anew where the writer did not come to it."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        super().__init__(file, validate_crcs=True, record_size_limit=size)
        self._file = file
        self._size = size
        self._index: Summary | None = None
        self.complete = True
        self.lost_bytes = 0

    def get_summary(self) -> Summary:
        if self._index is None:
            try:
                self._index = super().get_summary()
            except _BROKEN:
                self._index = None
            if self._index is None or self._index.statistics is None:
                self._index = self._scan()
        return self._index

    def _scan(self) -> Summary:
        index = Summary()
        counts: Counter[int] = Counter()
        stamps: list[int] = []
        self.complete = False
        self._file.seek(0)
        records = StreamReader(self._file, emit_chunks=True, record_size_limit=self._size).records
        while True:
            offset = self._file.tell()
            try:
                record = next(records)
                inside: list[McapRecord] = [record]
                if isinstance(record, Chunk):
                    inside = breakup_chunk(record, validate_crc=True)
            except (StopIteration, *_BROKEN):
                break
            if isinstance(record, DataEnd | Footer):
                self.complete = True
                break
            for item in inside:
                if isinstance(item, Schema):
                    index.schemas[item.id] = item
                elif isinstance(item, Channel):
                    index.channels[item.id] = item
                elif isinstance(item, Record):
                    counts[item.channel_id] += 1
                    stamps.append(item.log_time)
            if isinstance(record, Chunk):
                index.chunk_indexes.append(_chunk_index(record, offset, self._file.tell() - offset))
        self.lost_bytes = 0 if self.complete else self._size - offset
        index.statistics = Statistics(
            attachment_count=0,
            channel_count=len(index.channels),
            channel_message_counts=dict(counts),
            chunk_count=len(index.chunk_indexes),
            message_count=counts.total(),
            message_end_time=max(stamps, default=0),
            message_start_time=min(stamps, default=0),
            metadata_count=0,
            schema_count=len(index.schemas),
        )
        return index


def _chunk_index(chunk: Chunk, offset: int, length: int) -> ChunkIndex:
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


def _definition(name: str) -> str:
    return typestore().generate_msgdef(name, ros_version=2)[0]


def _topic(channel: Channel) -> str:
    return channel.topic.removeprefix("/")
