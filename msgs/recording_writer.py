"""Writes recordings: rosbag2 directories with MCAP storage, in one file or in several parts.

The bytes of an `.mcap` depend only on its messages, not on the clock or on chance.

A killed writer loses at most the last half second, measured in stamps, because it closes MCAP chunks and hands them to
the operating system at that interval. The file then has no index, and the directory no `metadata.yaml`.
`RecordingReader` rebuilds the index; a writer with `go_on` starts the next part.
"""

import os
import re
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from steadypose.msgs import Closing
from steadypose.msgs.codec import encode, typestore, wire_type
from steadypose.msgs.mcap_file import BROKEN, McapFile
from steadypose.msgs.topics import TOPICS, check_topic
from steadypose.msgs.types import Message

CHUNK_NS = 500_000_000
CHUNK_BYTES = 2**18
TAIL_NS = 10_000_000_000
"""Length of the last part's end that is searched for duplicates, nanoseconds.

A killed recorder may receive again messages that it had written and not yet acknowledged."""
SCAN_S = 5.0
"""Longest time for which parts without an index are scanned when a recording goes on, seconds.

On a machine that is switched off without notice there is one for each day; older ones count as empty."""
METADATA = "metadata.yaml"


class RecordingError(ValueError):
    """A recording that cannot be written or read. The text says why."""


@dataclass
class PartInfo:
    """The entries of one file in `metadata.yaml`."""

    path: Path
    counts: Counter[str] = field(default_factory=Counter)  # number of messages by topic
    first_ns: int = 2**63 - 1
    last_ns: int = 0
    first_of: dict[str, int] = field(default_factory=dict)  # log time of each topic's first message, nanoseconds


class RecordingWriter(Closing):
    """Writes messages to a rosbag2 directory. A context manager; leaving it completes the recording."""

    def __init__(
        self,
        directory: str | Path,
        *,
        go_on: bool = False,
        split_bytes: int = 0,
        split_ns: int = 0,
        keep_bytes: int = 0,
    ) -> None:
        """Create `directory` and missing parents.

        Args:
            directory: the recording's directory.
            go_on: append a part if the recording exists, without the messages at the end of its last part.
            split_bytes: size at which the next part starts, bytes; 0: never.
            split_ns: time span in stamps at which the next part starts, nanoseconds; 0: never.
            keep_bytes: total size above which the oldest parts are removed, bytes; 0: never.

        Raises:
            RecordingError: the directory exists already, or cannot be created.
        """
        self.directory = Path(directory)
        self._split_bytes, self._split_ns, self._keep_bytes = split_bytes, split_ns, keep_bytes
        typestore()
        number = 0
        self._done: list[PartInfo] = []
        self._tail: set[tuple[str, bytes]] = set()
        try:
            if go_on and self.directory.is_dir():
                parts = recorded_parts(self.directory)
                number = 1 + max(parts, default=-1)
                until = time.monotonic() + SCAN_S
                for n in sorted(parts, reverse=True):
                    newest = n == number - 1
                    scan = newest or time.monotonic() < until
                    self._done.insert(0, _existing(parts[n], self._tail if newest else None, scan=scan))
            else:
                self.directory.mkdir(parents=True)
            self._part = _Part(self.directory, number)
        except OSError as error:
            remedy = "; expected a new name" if isinstance(error, FileExistsError) else ""
            raise RecordingError(f"cannot record to {directory}: {error.strerror}{remedy}") from error

    def write(self, topic: str, message: Message, stamp_ns: int) -> None:
        """Append a message with the log time `stamp_ns` (0 or later). Stamps need not increase.

        Raises:
            ValueError: the message is not of the topic's type, or the stamp is negative.
            OSError: the disk is full, or gone. Earlier messages are kept; the next call starts another part.
        """
        check_topic(topic, message)
        if stamp_ns < 0:
            raise ValueError(f"stamp_ns: expected 0 or more, got {stamp_ns}")
        payload = encode(message)
        if (topic, payload) in self._tail:
            return
        if self._part.broken or self._part.closed or self._is_full(topic, stamp_ns):
            self.split()
        self._part.write(topic, payload, stamp_ns)

    @property
    def pending(self) -> bool:
        """Whether written messages would be lost if this process died."""
        return self._part.pending

    def flush(self) -> None:
        """Hand all written messages to the operating system."""
        if self.pending:
            self._part.flush()

    def sync(self) -> None:
        """Write all flushed messages to the disk, so that they survive a power failure."""
        self._part.sync()

    def split(self) -> None:
        """Complete this part, and start the next. If it raises OSError, as on a full disk, it can be called again."""
        self._finish()
        following = _Part(self.directory, self._part.number + 1)
        self._done.append(self._part.info)
        self._part = following

    def _is_full(self, topic: str, stamp_ns: int) -> bool:
        info = self._part.info
        if not info.counts:
            return False
        # of one topic, because a wrong stamp of one would make the span of all too long in every part
        span_ns = stamp_ns - info.first_of.get(topic, stamp_ns)
        return 0 < self._split_bytes <= self._part.size or 0 < self._split_ns <= span_ns

    def close(self) -> None:
        """Complete the recording: write the index and `metadata.yaml`."""
        if not self._part.closed:
            self._finish()

    def _finish(self) -> None:
        """Complete this part, remove the oldest parts beyond the limit, and write the metadata."""
        if not self._part.closed:
            self._part.close()
        # somebody may have removed some to make room
        parts = [info for info in (*self._done, self._part.info) if info.path.exists()]
        sizes = [info.path.stat().st_size for info in parts]
        while self._keep_bytes and len(parts) > 1 and sum(sizes) > self._keep_bytes:
            parts.pop(0).path.unlink()
            del sizes[0]
        self._write_metadata(parts)

    def _write_metadata(self, parts: list[PartInfo]) -> None:
        from ruamel.yaml import YAML  # slow to import, and needed only for recording

        counts = sum((info.counts for info in parts), Counter[str]())
        first_ns = min((info.first_ns for info in parts), default=0)
        last_ns = max((info.last_ns for info in parts), default=0)
        information = {
            "version": 8,
            "storage_identifier": "mcap",
            "relative_file_paths": [info.path.name for info in parts],
            **_span(first_ns, last_ns, counts),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": f"/{topic}",
                        "type": wire_type(TOPICS[topic]),
                        "serialization_format": "cdr",
                        "offered_qos_profiles": "",
                        "type_description_hash": typestore().hash_rihs01(wire_type(TOPICS[topic])),
                    },
                    "message_count": counts[topic],
                }
                for topic in TOPICS
                if topic in counts
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": info.path.name, **_span(info.first_ns, info.last_ns, info.counts)} for info in parts],
            "custom_data": None,
            "ros_distro": "",
        }
        yaml = YAML(typ="safe")
        yaml.default_flow_style = False
        yaml.representer.ignore_aliases = lambda *_: True
        unfinished = self.directory / f"{METADATA}.tmp"
        with unfinished.open("w") as file:
            yaml.dump({"rosbag2_bagfile_information": information}, file)
        unfinished.replace(self.directory / METADATA)


class _Part:
    """One file of a recording."""

    def __init__(self, directory: Path, number: int) -> None:
        self.number = number
        self.info = PartInfo(directory / f"{directory.name}_{number}.mcap")
        self.broken = False
        self.size = 0
        self._file = self.info.path.open("xb")
        # uncompressed, because a noisy sensor's floats hardly compress
        self._writer = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="steadypose")
        self._channels: dict[str, int] = {}
        self._written: dict[str, int] = {}
        self._flushed: dict[str, int] = {}
        self._pending = 0
        try:
            self.flush()
        except OSError:
            self.close()
            self.info.path.unlink()  # the next attempt makes it again
            raise

    @property
    def closed(self) -> bool:
        return self._file.closed

    @property
    def pending(self) -> bool:
        return self._pending > 0 and not self.broken and not self.closed

    def write(self, topic: str, payload: bytes, stamp_ns: int) -> None:
        info = self.info
        try:
            channel = self._channel(topic)
            self._writer.add_message(
                channel, log_time=stamp_ns, publish_time=stamp_ns, data=payload, sequence=info.counts[topic]
            )
            info.counts[topic] += 1
            info.first_of.setdefault(topic, stamp_ns)
            info.first_ns = min(info.first_ns, stamp_ns)
            info.last_ns = max(info.last_ns, stamp_ns)
            self._written[topic] = stamp_ns
            self._pending += len(payload)
            self.size += len(payload)
            # per topic, whose clocks may be unrelated; in both directions, because a clock may be set back
            flushed = self._flushed.get(topic)
            if flushed is None or abs(stamp_ns - flushed) >= CHUNK_NS or self._pending >= CHUNK_BYTES:
                self.flush()
        except OSError:
            self.broken = True
            raise

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            name = wire_type(TOPICS[topic])
            schema = self._writer.register_schema(name, "ros2msg", definition(name).encode())
            about = {"offered_qos_profiles": "", "topic_type_hash": typestore().hash_rihs01(name)}
            channel = self._writer.register_channel(f"/{topic}", "cdr", schema, about)
            # written outside the chunk as well, so that a damaged chunk does not make all messages unreadable
            outside = RecordBuilder()
            Schema(id=schema, name=name, encoding="ros2msg", data=definition(name).encode()).write(outside)
            self._file.write(outside.end())
            Channel(channel, f"/{topic}", "cdr", about, schema).write(outside)
            self._file.write(outside.end())
            self._channels[topic] = channel
        return self._channels[topic]

    def flush(self) -> None:
        try:
            self._writer.flush()
        except OSError:
            self.broken = True
            raise
        self._flushed = dict(self._written)
        self._pending = 0

    def sync(self) -> None:
        if not self.broken:
            os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Write the index, unless writing failed before; the file is then readable without an index."""
        try:
            if not self.broken:
                self._writer.finish()
            self._file.close()
        except OSError:
            if not self.broken:
                raise
        finally:
            with suppress(OSError):
                self._file.close()  # if the first close failed to write, the second one closes the file


def recorded_parts(directory: Path) -> dict[int, Path]:
    """The files of steadypose's recording, by number. Raises RecordingError if the directory holds something else."""
    name = re.compile(rf"{re.escape(directory.name)}_(\d+)\.mcap")
    parts: dict[int, Path] = {}
    for path in directory.iterdir():
        if match := name.fullmatch(path.name):
            parts[int(match[1])] = path
        elif path.name not in (METADATA, f"{METADATA}.tmp"):
            raise RecordingError(f"{directory} holds {path.name}: expected a new directory, or a recording")
    return parts


def _existing(path: Path, tail: set[tuple[str, bytes]] | None, *, scan: bool) -> PartInfo:
    """The entries of an existing part; empty if it cannot be read, or has no index and is not to be scanned.

    ``tail`` receives the topics and encoded bytes of its last messages.
    """
    with path.open("rb") as file, suppress(*BROKEN):
        mcap = McapFile(file, path.stat().st_size, scan=scan)
        topics = {channel.id: channel.topic for channel in mcap.channels.values()}
        if tail is not None:
            for logged in mcap.messages(set(topics.values()), mcap.end_ns - TAIL_NS):
                tail.add((logged.channel.topic.removeprefix("/"), bytes(logged.data)))
        counts = Counter({topic.removeprefix("/"): mcap.counts[id] for id, topic in topics.items()})
        return PartInfo(path, +counts, mcap.start_ns, mcap.end_ns)
    return PartInfo(path)


def definition(name: str) -> str:
    """The text of a message definition as stored in a recording."""
    return typestore().generate_msgdef(name, ros_version=2)[0]


def _span(first_ns: int, last_ns: int, counts: Counter[str]) -> dict[str, Any]:
    count = counts.total()
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns if count else 0},
        "duration": {"nanoseconds": max(0, last_ns - first_ns)},
        "message_count": count,
    }
