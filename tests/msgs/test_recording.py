import contextlib
import dataclasses
import struct
import time
import tracemalloc
from collections.abc import Iterable, Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Chunk, McapRecord, MessageIndex
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from tests.helpers.msg_strategies import ANY, EXAMPLES, raw

from steadypose.msgs import recording_writer
from steadypose.msgs.codec import DEFINITIONS, decode, encode, typestore, wire_type
from steadypose.msgs.mcap_file import McapFile
from steadypose.msgs.recording import Recorded, RecordingError, RecordingReader, RecordingWriter
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD, TOPICS
from steadypose.msgs.types import Message

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 33_333_333


@cache
def stream(frames: int = 90) -> tuple[Recorded, ...]:
    """As a recorder hears it: the clean poses four frames behind the raw ones, diagnostics once a second."""
    sent = []
    for frame in range(frames):
        stamp = START_NS + frame * FRAME_NS
        sent += [(POSE_RAW, stamp), (POSE_TRUTH, stamp)]
        if frame >= 4:
            sent += [(POSE_CLEAN, stamp - 4 * FRAME_NS), (POSE_WORLD, stamp - 4 * FRAME_NS)]
        if frame % 30 == 0:
            sent += [(POSE_EVENTS, stamp), (DIAGNOSTICS, stamp)]
    return tuple(Recorded(topic, stamp, dataclasses.replace(EXAMPLES[topic], stamp_ns=stamp)) for topic, stamp in sent)


def record(directory: Path, messages: Iterable[tuple[str, int, Message]], **options: Any) -> Path:
    with RecordingWriter(directory, **options) as writer:
        for topic, stamp_ns, message in messages:
            writer.write(topic, message, stamp_ns)
    return directory


def read(path: Path) -> list[Recorded]:
    with RecordingReader(path) as reader:
        return list(reader)


def mcap_of(directory: Path) -> Path:
    (path,) = directory.glob("*.mcap")
    return path


def records_of(content: bytes) -> Iterator[McapRecord]:
    return StreamReader(BytesIO(content), emit_chunks=True).records


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recordings") / "whole", stream())


def test_what_went_in_comes_out_in_the_order_of_stamps(whole: Path):
    with RecordingReader(whole) as reader:
        assert list(reader) == sorted(stream(), key=lambda recorded: recorded.stamp_ns)
        assert reader.topics == tuple(TOPICS)
        assert [reader.count(topic) for topic in TOPICS] == [90, 86, 86, 3, 90, 3]
        assert reader.duration_s == pytest.approx(89 / 30, abs=1e-6)
        assert (reader.start_ns, reader.end_ns) == (START_NS, START_NS + 89 * FRAME_NS)
        assert reader.complete
        assert reader.lost_bytes == 0
        assert not reader.refused
        assert list(reader) == list(reader)


@given(st.lists(st.tuples(ANY, st.integers(0, 3) | st.integers(0, 2**62)), min_size=1, max_size=8))
@settings(max_examples=20)
def test_any_message_at_any_stamp_is_kept(tmp_path_factory: pytest.TempPathFactory, given_: list):
    messages = [Recorded(topic, stamp, message) for (topic, message), stamp in given_]
    directory = record(tmp_path_factory.mktemp("any") / "recording", messages)
    assert read(directory) == sorted(messages, key=lambda recorded: recorded.stamp_ns)


def test_the_same_messages_make_the_same_bytes(whole: Path, tmp_path: Path):
    again = record(tmp_path / "elsewhere", stream())
    assert mcap_of(again).read_bytes() == mcap_of(whole).read_bytes()


@pytest.mark.parametrize("frame", [0, 1, 15, 16, 44, 89])
def test_seek_and_topics_can_be_chosen(whole: Path, frame: int):
    start, chosen = START_NS + frame * FRAME_NS, {POSE_CLEAN, DIAGNOSTICS}
    with RecordingReader(whole) as reader:
        found = list(reader.messages(start_ns=start))
        assert found == [recorded for recorded in reader if recorded.stamp_ns >= start]
        assert found[0].stamp_ns == start
        assert list(reader.messages(start_ns=reader.end_ns + 1)) == []
        some = list(reader.messages(chosen, start_ns=start))
        assert some == [recorded for recorded in found if recorded.topic in chosen]
        with pytest.raises(ValueError, match=r"expected some of pose/raw, .*, got pose/row"):
            next(reader.messages(["pose/row"]))


def test_rosbags_reads_it(whole: Path):
    expected = sorted(stream(), key=lambda recorded: recorded.stamp_ns)
    with AnyReader([whole]) as bag:
        assert bag.message_count == len(expected)
        assert bag.duration == 89 * FRAME_NS + 1
        types = {topic: wire_type(kind) for topic, kind in TOPICS.items()}
        assert {name: info.msgtype for name, info in bag.topics.items()} == {f"/{t}": w for t, w in types.items()}
        found = []
        for connection, stamp, data in bag.messages():
            wire: Any = bag.deserialize(data, connection.msgtype)
            assert wire.header.stamp.sec * 10**9 + wire.header.stamp.nanosec == stamp
            topic = connection.topic.removeprefix("/")
            found.append(Recorded(topic, stamp, decode(topic, data)))
            if topic == POSE_WORLD:
                body, sent = wire.bodies[0], EXAMPLES[POSE_WORLD].bodies[0]  # type: ignore[union-attr]
                np.testing.assert_array_equal(body.positions.reshape(22, 3), sent.positions)
                assert (body.root_velocity.x, body.root_velocity.y, body.root_velocity.z) == (0, 1, 2)
                assert body.tracking == sent.tracking == body.TRACKING_COASTING
    key = lambda recorded: (recorded.stamp_ns, recorded.topic)  # noqa: E731
    assert sorted(found, key=key) == sorted(expected, key=key)


@pytest.mark.parametrize("set_back_s", [0, 3600])
def test_at_no_moment_more_than_the_last_second_is_not_in_the_file(set_back_s: int, tmp_path: Path):
    # a slow topic beside a fast one, whose clock has nothing to do with that of the frames
    with RecordingWriter(tmp_path / "recording") as writer:
        with pytest.raises(RecordingError, match="holds no message"):
            RecordingReader(tmp_path / "recording")
        for frame in range(100):
            stamp = (frame - 50) * FRAME_NS + (3600 - (frame > 50) * set_back_s) * 10**9 + 2 * 10**9
            writer.write(POSE_RAW, raw(joints=1), stamp)
            if frame % 7 == 0:
                writer.write(DIAGNOSTICS, EXAMPLES[DIAGNOSTICS], stamp + 10**18)
            with RecordingReader(tmp_path / "recording") as reader:
                assert reader.count(POSE_RAW) > frame + 1 - 30
                assert reader.count(DIAGNOSTICS) > frame // 7 + 1 - 30 / 7
    chunks = [r for r in records_of(mcap_of(tmp_path / "recording").read_bytes()) if isinstance(r, Chunk)]
    assert len(chunks) < 12, "a chunk for every message is no chunk"


def test_an_error_while_recording_completes_it(tmp_path: Path):
    def messages():
        yield POSE_RAW, 0, raw()
        yield POSE_RAW, 1, raw(1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "recording", messages())
    with RecordingReader(tmp_path / "recording") as reader:
        assert reader.complete
        assert reader.count(POSE_RAW) == 2
    assert (tmp_path / "recording" / "metadata.yaml").exists()


@given(data=st.data())
@settings(max_examples=30)
def test_a_truncated_recording_gives_what_is_there(data: st.DataObject, whole: Path, tmp_path_factory):
    content = mcap_of(whole).read_bytes()
    size = data.draw(st.integers(0, len(content) - 1))
    cut = tmp_path_factory.mktemp("cut") / "cut.mcap"
    cut.write_bytes(content[:size])
    expected = stream()
    found, complete, lost = [], False, size
    with contextlib.suppress(RecordingError), RecordingReader(cut) as reader:
        found, complete, lost = list(reader), reader.complete, reader.lost_bytes
    # what was written first, without a hole
    assert found == sorted(expected[: len(found)], key=lambda recorded: recorded.stamp_ns)
    assert lost < 4096 + max(len(record.data) for record in records_of(content) if isinstance(record, Chunk))
    assert complete == (len(found) == len(expected) and lost == 0)


@pytest.mark.parametrize("content", [None, b"", b"\x89MCAP0\r\n", b"not a recording", bytes(1000)])
def test_where_there_is_no_recording_it_is_said(content: bytes | None, tmp_path: Path):
    match = r"expected a directory with \.mcap files, .*; found none"
    if content is not None:
        (tmp_path / "bag.mcap").write_bytes(content)
        match = r"is not an MCAP file|holds no message"
    record(tmp_path / "empty" / "bag", [])
    for path, why in (
        (tmp_path, match),
        (tmp_path / "bag.mcap", match),
        (tmp_path / "empty" / "bag", "no message on any"),
    ):
        with pytest.raises(RecordingError, match=why):
            RecordingReader(path)
    with AnyReader([tmp_path / "empty" / "bag"]) as bag:
        assert bag.message_count == 0


def test_what_is_written_is_checked_and_not_overwritten(tmp_path: Path):
    with RecordingWriter(tmp_path / "recording") as writer:
        with pytest.raises(ValueError, match="pose/clean: expected PoseClean, got PoseRaw"):
            writer.write(POSE_CLEAN, raw(), 0)
        with pytest.raises(ValueError, match="stamp_ns: expected 0 or more, got -1"):
            writer.write(POSE_RAW, raw(), -1)
        writer.write(POSE_RAW, raw(), 7)
    with pytest.raises(RecordingError, match=r"cannot record to .*: File exists; expected a new name"):
        RecordingWriter(tmp_path / "recording")
    assert read(tmp_path / "recording") == [(POSE_RAW, 7, raw())]


def foreign(
    path: Path, definition: str, name="steadypose_msgs/msg/PoseRaw", topic="/pose/raw", encoding="cdr",
    payload: bytes | None = None, compression=CompressionType.NONE, stamps=(5, 5), **options: Any,
) -> Path:  # fmt: skip
    writer = Writer(str(path), compression=compression, **options)
    writer.start("ros2", "somebody")
    schema = writer.register_schema(name, "ros2msg", definition.encode())
    channel = writer.register_channel(topic, encoding, schema)
    for stamp in stamps:
        writer.add_message(channel, stamp, encode(raw()) if payload is None else payload, stamp)
    writer.finish()
    return path


def ros_definition() -> str:
    """As `ros2 bag record` writes it: the definitions' own text, comments and all."""
    rule = "=" * 80
    standard, _ = typestore().generate_msgdef("geometry_msgs/msg/Pose", ros_version=2)
    header, _ = typestore().generate_msgdef("std_msgs/msg/Header", ros_version=2)
    own = [(DEFINITIONS / f"{name}.msg").read_text() for name in ("PoseRaw", "RawBody")]
    parts = [own[0], f"MSG: steadypose_msgs/RawBody\n{own[1]}", f"MSG: geometry_msgs/Pose\n{standard}"]
    return f"\n{rule}\n".join([*parts, f"MSG: std_msgs/Header\n{header}"])


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_recording_made_by_ros_is_read(compression: CompressionType, use_chunking: bool, tmp_path: Path):
    how: Any = {"compression": compression, "use_chunking": use_chunking}
    path = foreign(tmp_path / "ros.mcap", ros_definition(), stamps=(7, 5), **how)
    assert read(path) == [(POSE_RAW, stamp, raw()) for stamp in (5, 7)]


def test_other_definitions_of_our_types_are_refused_and_topics_of_others_are_passed_over(whole: Path, tmp_path: Path):
    text: Any = {"definition": "string data", "name": "std_msgs/msg/String"}
    other = ros_definition().replace("float32[] confidence", "float64[] confidence")
    wrong: Any
    for wrong, match in (
        ({"definition": other}, "another definition of steadypose_msgs/msg/PoseRaw"),
        ({"definition": "float32 !"}, "cannot read the definition"),
        (text, r"expected .*PoseRaw as cdr on pose/raw, got std_msgs/msg/String as cdr"),
        ({"definition": ros_definition(), "encoding": "json"}, "got steadypose_msgs/msg/PoseRaw as json"),
        (text | {"topic": "/camera"}, "holds no message on any of"),
    ):
        with pytest.raises(RecordingError, match=match):
            RecordingReader(foreign(tmp_path / "camera.mcap", **wrong))
    (tmp_path / "whole.mcap").write_bytes(mcap_of(whole).read_bytes())
    assert read(tmp_path) == read(whole)


def test_a_recording_in_several_files_is_read_in_order(tmp_path: Path):
    everything = stream()
    record(tmp_path / "a", everything[::2])
    record(tmp_path / "b", everything[1::2])
    for name in ("a", "b"):
        mcap_of(tmp_path / name).rename(tmp_path / f"{name}.mcap")
    with RecordingReader(tmp_path) as reader:
        found = list(reader)
        assert reader.count(POSE_RAW) == 90
    assert [r.stamp_ns for r in found] == sorted(r.stamp_ns for r in everything)
    assert len(found) == len(everything)


def test_messages_that_cannot_be_decoded_are_counted(tmp_path: Path):
    with RecordingReader(foreign(tmp_path / "bad.mcap", ros_definition(), payload=b"\0\1\0\0bad")) as reader:
        assert list(reader) == []
        assert reader.refused == {POSE_RAW: 2}


@given(data=st.data())
@settings(max_examples=20)
def test_one_flipped_bit_costs_one_chunk_at_most(data: st.DataObject, whole: Path, tmp_path_factory):
    content = bytearray(mcap_of(whole).read_bytes())
    finished = data.draw(st.booleans())
    if not finished:  # as its writer leaves it when it is killed: without index
        content = content[: max(chunk_ends(bytes(content)))]
    at = data.draw(st.one_of(st.integers(0, 5000), st.integers(0, len(content) - 1), st.integers(-9000, -1)))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    flipped = tmp_path_factory.mktemp("flipped") / "flipped.mcap"
    flipped.write_bytes(content)
    chunks = chunks_of(mcap_of(whole))
    with RecordingReader(flipped) as reader:
        found = [(recorded.topic, encode(recorded.message)) for recorded in reader]
        assert reader.lost_bytes < max(len(chunk.data) for chunk in chunks) + 4096
        assert reader.gaps <= 1
        assert not reader.refused
    assert set(found) <= {(topic, encode(message)) for topic, _, message in stream()}, "never another message"
    of_chunks = [sum(isinstance(record, Record) for record in breakup_chunk(chunk)) for chunk in chunks]
    assert len(found) >= len(stream()) - max(of_chunks)
    assert len(found) == len(stream()) or reader.gaps


@cache
def chunks_of(path: Path) -> list[Chunk]:
    return [record for record in records_of(path.read_bytes()) if isinstance(record, Chunk)]


def chunk_ends(content: bytes) -> Iterator[int]:
    """Where each chunk of a file ends, and the indexes of its messages."""
    file = BytesIO(content)
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk | MessageIndex):
            yield file.tell()


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_what_a_chunk_becomes_has_a_limit(compression: CompressionType, tmp_path: Path):
    bomb = foreign(tmp_path / "bomb.mcap", ros_definition(), payload=bytes(100 * 2**20), compression=compression)
    assert bomb.stat().st_size < 4 * 2**20
    tracemalloc.start()
    try:
        with RecordingReader(bomb) as reader:
            assert list(reader) == []
            assert reader.gaps == 2, "the index speaks of them, and they are not read"
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_a_file_of_empty_records_takes_no_time(tmp_path: Path):
    """Each chunk of a few hundred bytes is a mebibyte of records of nine."""
    data = bytes([Opcode.SCHEMA]) + bytes(8)
    inner = data * (2**20 // len(data))
    packed = zstandard.compress(inner)
    body = struct.pack("<QQQII", 0, 0, len(inner), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    chunk = struct.pack("<BQ", Opcode.CHUNK, len(body)) + body
    path = tmp_path / "hostile.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + chunk * (36_000 // len(chunk)))
    started = time.process_time()
    with pytest.raises(RecordingError):
        RecordingReader(path)
    assert time.process_time() - started < 2.0, "it took 27 s to go through them all"


def test_all_chunks_of_a_file_become_no_more_than_it_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = foreign(tmp_path / "ros.mcap", ros_definition(), payload=bytes(2**18), compression=CompressionType.ZSTD)
    monkeypatch.setattr(McapFile, "_budget", 2**17)
    with RecordingReader(path) as reader:
        assert list(reader) == []
        assert reader.gaps


@pytest.mark.parametrize("compression", list(CompressionType))
def test_damage_to_compressed_chunks_is_counted(compression: CompressionType, tmp_path: Path):
    path = foreign(tmp_path / "ros.mcap", ros_definition(), compression=compression)
    content = bytearray(path.read_bytes())
    chunk = content.index(b"\x06", 9 + 8 + 12)
    content[chunk + 120] ^= 0x10
    path.write_bytes(content)
    with RecordingReader(path) as reader:
        assert list(reader) == []
        assert reader.gaps == 1


def test_a_recording_goes_on_in_the_next_part(tmp_path: Path):
    everything = stream()
    directory = tmp_path / "recording"
    record(directory, everything[:100])
    mcap_of(directory).write_bytes(mcap_of(directory).read_bytes()[:-3000])  # killed
    (directory / "metadata.yaml").unlink()
    before = read(directory)
    for part in (everything[100:200], everything[200:]):
        record(directory, part, go_on=True)
    assert sorted(path.name for path in directory.iterdir()) == [
        "metadata.yaml", "recording_0.mcap", "recording_1.mcap", "recording_2.mcap",
    ]  # fmt: skip
    found = read(directory)
    assert len(found) == len(before) + len(everything) - 100
    assert len(before) > 60
    metadata = (directory / "metadata.yaml").read_text()
    assert f"message_count: {len(found)}\n" in metadata


def test_parts_without_an_index_are_not_scanned_at_every_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    directory, scanned = tmp_path / "recording", []
    scan = McapFile._scan
    monkeypatch.setattr(McapFile, "_scan", lambda self: (scanned.append(self._file.name), scan(self)))
    monkeypatch.setattr(recording_writer, "SCAN_S", 0.0)
    for part in range(4):
        killed = RecordingWriter(directory, go_on=True)
        killed.write(POSE_RAW, raw(), part * 10**10)
    assert [Path(name).name for name in scanned] == [f"recording_{number}.mcap" for number in range(3)]


def test_what_the_last_part_holds_is_not_written_again(tmp_path: Path):
    frames = [Recorded(POSE_RAW, i, raw(i)) for i in range(60)]
    killed = RecordingWriter(tmp_path / "out")
    for topic, stamp_ns, message in frames[:40]:
        killed.write(topic, message, stamp_ns)
    killed.flush()
    assert not killed.pending
    record(tmp_path / "out", frames[30:], go_on=True)
    assert read(tmp_path / "out") == frames


def test_nothing_is_added_to_what_is_no_recording_of_that_name(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(RecordingError, match=r"holds notes.txt: expected a new directory, or a recording"):
        RecordingWriter(tmp_path, go_on=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("limits", [{"split_bytes": 50_000}, {"split_ns": 10**9}])
def test_parts_are_split_by_size_and_by_time(limits: dict[str, Any], tmp_path: Path):
    record(tmp_path / "recording", stream(), **limits)
    assert len(list((tmp_path / "recording").glob("*.mcap"))) > 2
    assert read(tmp_path / "recording") == sorted(stream(), key=lambda recorded: recorded.stamp_ns)
    with AnyReader([tmp_path / "recording"]) as bag:
        assert bag.message_count == len(stream())


def test_a_topic_of_another_time_splits_no_part(tmp_path: Path):
    """As after one wrong stamp: the recorder's log times do not go back."""
    far_ns = START_NS + 10**18
    messages = [(topic, far_ns if topic == POSE_RAW else stamp_ns, m) for topic, stamp_ns, m in stream()]
    record(tmp_path / "recording", messages, split_ns=3600 * 10**9)
    assert len(list((tmp_path / "recording").glob("*.mcap"))) == 1


def test_the_oldest_parts_go_where_there_is_a_limit_and_those_that_somebody_removes_may(tmp_path: Path) -> None:
    directory = tmp_path / "recording"
    record(directory, stream(), split_bytes=50_000, keep_bytes=200_000)
    assert sum(path.stat().st_size for path in directory.glob("*.mcap")) <= 200_000
    found = read(directory)
    assert found[-1].stamp_ns == max(recorded.stamp_ns for recorded in stream())
    assert 20 < len(found) < len(stream())
    with AnyReader([directory]) as bag:
        assert bag.message_count == len(found)
    directory = tmp_path / "removed"
    with RecordingWriter(directory, split_bytes=50_000, keep_bytes=10**9) as writer:
        for topic, stamp_ns, message in stream():
            (directory / "removed_1.mcap").unlink(missing_ok=True)
            writer.write(topic, message, stamp_ns)
    assert len(list(directory.glob("*.mcap"))) > 2
    with AnyReader([directory]) as bag:
        assert bag.message_count == len(read(directory))


def test_a_full_disk_keeps_what_was_written_and_the_next_part_comes_when_there_is_room(tmp_path: Path, monkeypatch):
    directory, everything, full = tmp_path / "recording", stream(), []
    with RecordingWriter(directory) as writer:
        flush = writer._part._writer.flush
        for index, (topic, stamp_ns, message) in enumerate(everything):
            if index == 100:
                full_disk = Mock(side_effect=OSError(28, "No space left on device"))
                monkeypatch.setattr(writer._part._writer, "flush", full_disk)
            try:
                writer.write(topic, message, stamp_ns)
            except OSError:
                full.append(index)
                monkeypatch.setattr(writer._part._writer, "flush", flush)
    assert len(full) == 1, "the next part takes what follows"
    found = read(directory)
    assert len(found) > len(everything) - 60
    assert found[-1].stamp_ns == max(recorded.stamp_ns for recorded in everything)


@pytest.mark.parametrize("limits", [{"split_bytes": 50_000}, {"split_ns": 5 * 10**8}])
def test_a_disk_that_is_full_between_two_parts(limits: dict[str, Any], tmp_path: Path):
    directory, everything = tmp_path / "recording", stream()
    with RecordingWriter(directory, **limits) as writer:
        for index, (topic, stamp_ns, message) in enumerate(everything):
            if index % 100 == 0:
                (directory / "metadata.yaml.tmp").symlink_to("/dev/full")
            elif index % 100 == 50:
                (directory / "metadata.yaml.tmp").unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                writer.write(topic, message, stamp_ns)
    with AnyReader([directory]) as bag:
        assert bag.message_count == len(read(directory)) > len(everything) // 2
