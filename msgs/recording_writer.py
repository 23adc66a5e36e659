"""Writing recordings: rosbag2 directories with MCAP storage, in one file or in parts.

No clock and no chance goes into the `.mcap`: the same messages make the same bytes.

A writer that is killed loses at most the last half second of what it was given, counted in stamps: MCAP's chunks
are closed, and handed to the operating system, as often as that. The file then has no index and the directory no
`metadata.yaml`; `RecordingReader` makes the index anew, and a writer that is asked to go on begins the next part.
"""

from __future__ import annotations

import os
import re
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
"""of the last part: what may be given again to a recorder that was killed before it could say that it has it"""
METADATA = "metadata.yaml"


class RecordingError(ValueError):
    """A recording that cannot be made or read. The text says why."""


@dataclass
class PartInfo:
    """What `metadata.yaml` says of one file."""

    path: Path
    counts: Counter[str] = field(default_factory=Counter)
    """messages by topic"""
    first_ns: int = 2**63 - 1
    last_ns: int = 0

    @classmethod
    def of(cls, path: Path) -> PartInfo:
        """Of a file that is there; nothing, if it cannot be read."""
        with path.open("rb") as file, suppress(*BROKEN):
            mcap = McapFile(file, path.stat().st_size)
            counts = Counter({c.topic.removeprefix("/"): mcap.counts[c.id] for c in mcap.channels.values()})
            return cls(path, +counts, mcap.start_ns, mcap.end_ns)
        return cls(path)


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
        """Make `directory`, and its parents where they are missing.

        Args:
            go_on: if a recording is there already, write its next part; what the end of its last one holds is not
                written again.
            split_bytes: begin the next part when one has so many; 0: never.
            split_ns: begin the next part when one spans so much, in stamps; 0: never.
            keep_bytes: remove the oldest parts so that all together have no more; 0: never.

        Raises:
            RecordingError: if it is there already, or cannot be made.
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
                self._done = [PartInfo.of(parts[n]) for n in sorted(parts)]
                self._tail = _tail(parts[number - 1]) if parts else set()
            else:
                self.directory.mkdir(parents=True)
            self._part = _Part(self.directory, number)
        except OSError as error:
            raise RecordingError(f"cannot record to {directory}: {error.strerror}") from error

    def write(self, topic: str, message: Message, stamp_ns: int) -> None:
        """Append a message, to be found at `stamp_ns` (0 or later); stamps need not rise.

        Raises:
            ValueError: if the message is not of the topic's type, or the stamp is negative.
            OSError: the disk is full, or gone. What was written before is kept; the next call begins another part.
        """
        check_topic(topic, message)
        if stamp_ns < 0:
            raise ValueError(f"stamp_ns: expected 0 or more, got {stamp_ns}")
        payload = encode(message)
        if (topic, payload) in self._tail:
            return
        if self._part.broken or self._is_full(stamp_ns):
            self.split()
        self._part.write(topic, payload, stamp_ns)

    @property
    def pending(self) -> bool:
        """Whether something that was written would be lost with this process."""
        return self._part.pending

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        if self.pending:
            self._part.flush()

    def sync(self) -> None:
        """Have what was written reach the disk itself, so that it outlasts a power failure."""
        self._part.sync()

    def split(self) -> None:
        """Complete this part, and begin the next."""
        self._finish()
        self._part = _Part(self.directory, self._part.number + 1)

    def _is_full(self, stamp_ns: int) -> bool:
        info = self._part.info
        if not info.counts:
            return False
        span_ns = max(stamp_ns, info.last_ns) - info.first_ns
        return 0 < self._split_bytes <= self._part.size or 0 < self._split_ns <= span_ns

    def close(self) -> None:
        """Complete the recording: the index, and `metadata.yaml`."""
        if not self._part.closed:
            self._finish()

    def _finish(self) -> None:
        """Complete this part, remove the oldest where there is a limit, and say so in the metadata."""
        self._part.close()
        self._done.append(self._part.info)
        sizes = {info.path: info.path.stat().st_size for info in self._done}
        while self._keep_bytes and len(self._done) > 1 and sum(sizes.values()) > self._keep_bytes:
            oldest = self._done.pop(0)
            oldest.path.unlink()
            del sizes[oldest.path]
        self._write_metadata()

    def _write_metadata(self) -> None:
        from ruamel.yaml import YAML  # slow to import, and only those who record need it

        counts = sum((info.counts for info in self._done), Counter[str]())
        first_ns = min(info.first_ns for info in self._done)
        last_ns = max(info.last_ns for info in self._done)
        information = {
            "version": 8,
            "storage_identifier": "mcap",
            "relative_file_paths": [info.path.name for info in self._done],
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
            "files": [
                {"path": info.path.name, **_span(info.first_ns, info.last_ns, info.counts)} for info in self._done
            ],
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
        # compression would cost more time than it saves space: floats of a noisy sensor hardly shrink
        self._writer = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library="steadypose")
        self._channels: dict[str, int] = {}
        self._written: dict[str, int] = {}
        self._flushed: dict[str, int] = {}
        self._pending = 0
        self.flush()

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
            info.first_ns = min(info.first_ns, stamp_ns)
            info.last_ns = max(info.last_ns, stamp_ns)
            self._written[topic] = stamp_ns
            self._pending += len(payload)
            self.size += len(payload)
            # by topic, because the clocks of two topics may have nothing to do with each other; and in both directions,
            # because a clock may be set back
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
            # beside the chunk that they are in as well: without one or the other, no message could be read
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
        """Write the index, unless writing failed: what is there is then found without one."""
        try:
            if not self.broken:
                self._writer.finish()
            self._file.close()
        except OSError:
            if not self.broken:
                raise
        finally:
            with suppress(OSError):
                self._file.close()  # the second call closes what the first could not write to


def recorded_parts(directory: Path) -> dict[int, Path]:
    """The files of a recording made here, by their numbers.

    Raises:
        RecordingError: there is something else in the directory.
    """
    name = re.compile(rf"{re.escape(directory.name)}_(\d+)\.mcap")
    parts: dict[int, Path] = {}
    for path in directory.iterdir():
        if match := name.fullmatch(path.name):
            parts[int(match[1])] = path
        elif path.name not in (METADATA, f"{METADATA}.tmp"):
            raise RecordingError(f"{directory} holds {path.name}: expected a new directory, or a recording")
    return parts


def _tail(part: Path) -> set[tuple[str, bytes]]:
    """The last messages of a part, encoded, with their topics; none, if it cannot be read."""
    tail: set[tuple[str, bytes]] = set()
    with part.open("rb") as file, suppress(*BROKEN):
        mcap = McapFile(file, part.stat().st_size)
        names = {channel.topic for channel in mcap.channels.values()}
        for logged in mcap.messages(names, mcap.end_ns - TAIL_NS):
            tail.add((logged.channel.topic.removeprefix("/"), bytes(logged.data)))
    return tail


def definition(name: str) -> str:
    """The text of a message definition, as it stands in a recording."""
    return typestore().generate_msgdef(name, ros_version=2)[0]


def _span(first_ns: int, last_ns: int, counts: Counter[str]) -> dict[str, Any]:
    count = counts.total()
    return {
        "starting_time": {"nanoseconds_since_epoch": first_ns if count else 0},
        "duration": {"nanoseconds": max(0, last_ns - first_ns)},
        "message_count": count,
    }
