"""Reads one MCAP file chunk by chunk, so that damage costs only the damaged chunks.

The index at the end of the file is used if its checksum is valid. Otherwise, for example after the writer was killed,
the file is scanned from its beginning; after invalid bytes the scan continues at the next bytes that look like a chunk.
A chunk with a wrong checksum is skipped and counted. The decompressed size of each chunk and of all chunks together,
and the number of records per chunk, are limited, so that a small malicious file can neither fill the memory nor keep
the processor busy.
"""

import heapq
import re
import struct
import zlib
from collections import Counter
from collections.abc import Container, Iterator
from io import BytesIO
from typing import IO, NamedTuple, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Header, MessageIndex, Schema

MAX_CHUNK = 2**26  # largest decompressed size of a chunk, bytes. Writers close their chunks at some megabytes.
MAX_RATIO = 250  # largest compression ratio of a chunk larger than `RATIO_FROM`. Skeletons reach at most 100.
RATIO_FROM = 2**20  # decompressed size of a chunk above which `MAX_RATIO` applies, bytes
FILE_RATIO_FROM = 2**24
"""Decompressed size that any file's chunks may reach together, bytes. Beyond it, `MAX_RATIO` times the file size."""
MIN_RECORD = 31
"""Size of a message record without content, bytes. It bounds the plausible number of records in a chunk."""
BROKEN = (
    McapError, struct.error, zstandard.ZstdError, ValueError, KeyError, EOFError, OSError, RuntimeError, OverflowError,
    MemoryError,
)  # fmt: skip
"""Exceptions that the libraries raise for bytes that are not MCAP."""
_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, decompressed size, its checksum, length of the compression's name
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQI")
# the head of a chunk with lengths under a terabyte and a known compression
_CHUNK_HEAD = re.compile(rb"\x06.{5}\0{3}.{16}.{5}\0{3}.{4}(?:\0{4}|\x04\0{3}zstd|\x03\0{3}lz4).{5}\0{3}", re.DOTALL)
_CHUNK_HEAD_BYTES = 9 + _CHUNK.size + 4 + 8
_WINDOW = 2**20

_Record = TypeVar("_Record", Schema, Channel, Header, MessageIndex)


class Place(NamedTuple):
    """Position in the file of a chunk, or of a message outside chunks, and the range of its log times."""

    opcode: int
    offset: int
    length: int
    start_ns: int
    end_ns: int


class Logged(NamedTuple):
    """An undecoded message."""

    log_ns: int
    channel: Channel
    data: bytes | memoryview


class McapFile:
    """The content of an MCAP file, intact or damaged: ``file``, open for reading, of ``size`` bytes.

    ``scan`` says whether to scan a file without a valid index. Raises ValueError if that is missing and not scanned
    for, or nothing in the file looks like MCAP.
    """

    def __init__(self, file: IO[bytes], size: int, *, scan: bool = True) -> None:
        self._file, self._size = file, size
        self.channels: dict[int, Channel] = {}
        """by id"""
        self.schemas: dict[int, Schema] = {}
        """by id"""
        self.counts: Counter[int] = Counter()
        """number of messages by channel; those from the index include messages in damaged chunks"""
        self.places: list[Place] = []
        """positions of the chunks"""
        self.complete = True
        """whether the writer finished the file"""
        self._lost: dict[int, int] = {}
        self._left = 0  # bytes that may still be decompressed in this pass over the file
        begins = file.read(len(_MAGIC)) == _MAGIC
        try:
            indexed = begins and self._read_index()
        except BROKEN:
            indexed = False
        if not indexed and not scan:
            raise ValueError("it has no valid index")
        if not indexed:
            self._scan()
        if not begins and not self.places:
            raise ValueError("it does not begin as MCAP files do, and holds no chunk")

    @property
    def lost_bytes(self) -> int:
        """Number of unreadable bytes known so far; complete once all messages were read."""
        return sum(self._lost.values())

    @property
    def gaps(self) -> int:
        """Number of unreadable pieces known so far."""
        return len(self._lost)

    @property
    def start_ns(self) -> int:
        """First log time, nanoseconds; 0 if there is none."""
        return min((place.start_ns for place in self.places), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time, nanoseconds; 0 if there is none."""
        return max((place.end_ns for place in self.places), default=0)

    def messages(self, topics: Container[str], start_ns: int | None = None) -> Iterator[Logged]:
        """The messages on ``topics`` (names as in the file) from ``start_ns`` on, by log time, then in file order."""
        self._left = self._budget
        wanted = {channel.id for channel in self.channels.values() if channel.topic in topics}
        waiting: list[tuple[int, int, int, Logged]] = []  # the offset and index make each one comparable
        for place in sorted(self.places, key=lambda place: (place.start_ns, place.offset)):
            if start_ns is not None and place.end_ns < start_ns:
                continue
            while waiting and waiting[0][0] < place.start_ns:
                yield heapq.heappop(waiting)[-1]
            try:
                found = [
                    (log_ns, place.offset, index, Logged(log_ns, self.channels[channel], data))
                    for index, (channel, log_ns, data) in enumerate(self._messages_at(place))
                    if channel in wanted and (start_ns is None or log_ns >= start_ns)
                ]
            except BROKEN:
                self._lost[place.offset] = place.length
                continue
            for item in found:
                heapq.heappush(waiting, item)
        while waiting:
            yield heapq.heappop(waiting)[-1]

    @property
    def _budget(self) -> int:
        return max(FILE_RATIO_FROM, MAX_RATIO * self._size)

    def _messages_at(self, place: Place) -> Iterator[tuple[int, int, bytes | memoryview]]:
        """Channel id, log time and data of each message in a chunk."""
        opcode, body = self._record_at(place.offset)
        if opcode != place.opcode or _RECORD.size + len(body) != place.length:
            raise ValueError("not the record that the index says")
        for inner, data in self._inside(opcode, body):
            if inner == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(data)
                yield channel, log_ns, data[_MESSAGE.size :]

    def _record_at(self, offset: int) -> tuple[int, bytes]:
        """Opcode and content of the record at ``offset``. Raises ValueError if it extends beyond the file's end."""
        self._file.seek(offset)
        opcode, length = _RECORD.unpack(self._file.read(_RECORD.size))
        if offset + _RECORD.size + length > self._size:
            raise ValueError("a record beyond the end of the file")
        return opcode, self._file.read(length)

    def _inside(self, opcode: int, body: bytes) -> Iterator[tuple[int, memoryview]]:
        """The records in a chunk. A record that is not a chunk is returned as it is."""
        if opcode != Opcode.CHUNK:
            yield opcode, memoryview(body)
            return
        data = memoryview(_decompressed(body, self._left))
        self._left -= len(data)
        at = records = 0
        while at < len(data):
            records += 1
            if records > 100 + at // MIN_RECORD:
                raise ValueError(f"{records} records in {at} bytes of a chunk")
            inner, length = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if at + length > len(data):
                raise ValueError("a record beyond the end of its chunk")
            yield inner, data[at : at + length]
            at += length

    def _read_index(self) -> bool:
        """Read the chunks' positions from the index; False if the index is missing or invalid."""
        tail = _FOOTER.size + len(_MAGIC)
        self._file.seek(max(self._size - tail, 0))
        end = self._file.read()
        if len(end) < tail or end[-len(_MAGIC) :] != _MAGIC:
            return False
        opcode, _, start, _, checksum = _FOOTER.unpack_from(end)
        if opcode != Opcode.FOOTER or not 0 < start <= self._size - tail:
            return False
        if checksum:
            self._file.seek(start)
            summed = self._file.read(self._size - tail - start) + end[: _FOOTER.size - 4]
            if zlib.crc32(summed) != checksum:
                return False
        self._file.seek(0)
        summary = SeekingReader(self._file, record_size_limit=self._size).get_summary()
        if summary is None or summary.statistics is None:
            return False
        if summary.statistics.message_count and not summary.chunk_indexes:
            return False
        self.channels, self.schemas = summary.channels, summary.schemas
        self.counts.update({k: n for k, n in summary.statistics.channel_message_counts.items() if n})
        self.places = [
            Place(Opcode.CHUNK, c.chunk_start_offset, c.chunk_length, c.message_start_time, c.message_end_time)
            for c in summary.chunk_indexes
        ]
        return True

    def _scan(self) -> None:
        """Find the readable chunks by scanning the file from its beginning."""
        self.complete = False
        self._left = self._budget
        found: list[tuple[Place, Counter[int]]] = []
        at = len(_MAGIC)
        while at < self._size and not self.complete:
            try:
                at = self._take(at, found)
            except BROKEN:
                after = self._next_chunk(at + 1)
                self._lost[at] = after - at
                at = after
        # messages outside chunks have no checksum: in a file with chunks, they are damage that looks like a message
        chunked = any(place.opcode == Opcode.CHUNK for place, _ in found)
        for place, counts in found:
            if not chunked or place.opcode == Opcode.CHUNK:
                self.places.append(place)
                self.counts += counts

    def _take(self, at: int, places: list[tuple[Place, Counter[int]]]) -> int:
        """Register the record at ``at``; returns the offset of the next. Raises one of `BROKEN` if it is none, or
        damaged.
        """
        opcode, body = self._record_at(at)
        length = _RECORD.size + len(body)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            self.complete = True
        elif opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            stamps, counts = [], Counter[int]()
            channels, schemas = {}, {}
            for inner, data in self._inside(opcode, body):
                if inner == Opcode.MESSAGE:
                    channel, _, log_ns, _ = _MESSAGE.unpack_from(data)
                    stamps.append(log_ns)
                    counts[channel] += 1
                elif inner == Opcode.CHANNEL:
                    channels |= {(found := _parse(Channel, data)).id: found}
                elif inner == Opcode.SCHEMA:
                    schemas |= {(schema := _parse(Schema, data)).id: schema}
            # definitions inside a chunk are covered by a checksum, so they replace those outside
            self.channels |= channels
            self.schemas |= schemas
            if stamps:
                places.append((Place(opcode, at, length, min(stamps), max(stamps)), counts))
        elif opcode == Opcode.CHANNEL:
            self.channels.setdefault((found := _parse(Channel, body)).id, found)
        elif opcode == Opcode.SCHEMA:
            self.schemas.setdefault((schema := _parse(Schema, body)).id, schema)
        elif opcode == Opcode.HEADER:
            _parse(Header, body)
        elif opcode == Opcode.MESSAGE_INDEX:
            _parse(MessageIndex, body)
        elif opcode not in (Opcode.ATTACHMENT, Opcode.METADATA):
            raise ValueError(f"no record of the data section has opcode {opcode}")
        return at + length

    def _next_chunk(self, at: int) -> int:
        """Offset of the next bytes that look like a chunk; the size of the file if there are none."""
        while at < self._size:
            self._file.seek(at)
            window = self._file.read(_WINDOW)
            if found := _CHUNK_HEAD.search(window):
                return at + found.start()
            if len(window) < _WINDOW:
                break
            at += _WINDOW - _CHUNK_HEAD_BYTES
        return self._size


def _parse(kind: type[_Record], body: bytes | memoryview) -> _Record:
    """Parse a record. A leftover byte reveals a damaged length."""
    stream = ReadDataStream(BytesIO(body))
    record = kind.read(stream)
    if stream.count != len(body):
        raise ValueError(f"{kind.__name__}: expected {stream.count} bytes, got {len(body)}")
    return record


def _decompressed(body: bytes, most: int) -> bytes | memoryview:
    """The decompressed content of a chunk's record. Raises one of `BROKEN` if its checksum or a size is wrong."""
    _, _, size, checksum, name_length = _CHUNK.unpack_from(body)
    at = _CHUNK.size + name_length
    name = body[_CHUNK.size : at].decode()
    (length,) = struct.unpack_from("<Q", body, at)
    packed = memoryview(body)[at + 8 :]
    if length != len(packed):
        raise ValueError("a chunk of another length than its record")
    if size > min(MAX_CHUNK, most) or size > max(RATIO_FROM, MAX_RATIO * len(packed)):
        raise ValueError(f"a chunk of {len(packed)} bytes that decompresses to {size}")
    data: bytes | memoryview = packed
    if name == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1)
    elif name == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(bytes(packed), max_length=size + 1)
    elif name:
        raise ValueError(f"compression {name!r} is not known")
    if len(data) != size:
        raise ValueError("a chunk that decompresses to another size than it states")
    if checksum and zlib.crc32(data) != checksum:
        raise ValueError("a chunk with a wrong checksum")
    return data
