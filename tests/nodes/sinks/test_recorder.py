import errno
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from conftest import VirtualClock, walk

from steadypose.msgs import recording_writer
from steadypose.msgs.codec import encode
from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW
from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.graph.node import Node
from steadypose.nodes.sinks.recorder import AHEAD_NS, NO_ROOM, WAITING, LogTimes, RecorderNode
from steadypose.nodes.sources.recording import end_of


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    usage = SimpleNamespace(free=10**12)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    return usage


@pytest.fixture
def recorder(tmp_path: Path, make_launch, clock: VirtualClock, free: SimpleNamespace) -> RecorderNode:
    node = RecorderNode(make_launch(recorder__directory=tmp_path / "out"), clock)
    node._writer = node._settings.writer()
    return node


@pytest.mark.parametrize(("free_mb", "left"), [(500.0, 10**7), (0.0, 10**5)])
def test_messages_are_dropped_while_there_is_no_room(tmp_path, make_launch, clock, free, free_mb: float, left: int):
    node = RecorderNode(make_launch(recorder__directory=tmp_path / "out", recorder__free_mb=free_mb), clock)
    node._writer = node._settings.writer()
    for index, frame in enumerate(walk(90)):
        free.free = left if 30 <= index < 60 else 10**12
        clock.time_ns += 1_100_000_000
        node.handle(POSE_RAW, frame)
    node._writer.close()
    assert node.health.counts[NO_ROOM] == 30
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.complete
        assert [m.stamp_ns for _, _, m in reader] == [f.stamp_ns for f in [*walk(90)[:30], *walk(90)[60:]]]


def test_a_disk_that_is_full_before_it_was_noticed(tmp_path: Path, recorder: RecorderNode, monkeypatch) -> None:
    assert recorder._writer
    full_disk = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    for index, frame in enumerate(walk(90)):
        if index == 60:
            monkeypatch.setattr(recorder._writer._part._writer, "flush", full_disk)
        recorder.handle(POSE_RAW, frame)
    recorder._writer.close()
    assert 0 < recorder.health.counts[NO_ROOM] <= 30
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.count(POSE_RAW) > 30, "half a second before it at most is lost"


@pytest.mark.parametrize(("cause", "waits"), [(errno.ENOSPC, True), (errno.EROFS, False)])
def test_a_disk_that_is_full_at_the_start(tmp_path, make_launch, clock, free, monkeypatch, cause: int, waits: bool):
    node = RecorderNode(make_launch(recorder__directory=tmp_path / "out"), clock)
    monkeypatch.setattr(Node, "run", lambda self: None)
    with monkeypatch.context() as full:
        full.setattr(recording_writer, "_Part", Mock(side_effect=OSError(cause, "no")))
        if not waits:  # but asks whoever started it for another folder
            with pytest.raises(RecordingError, match="cannot record to"):
                node.run()
            return
        node.run()
        for frame in walk(90)[:30]:
            node.handle(POSE_RAW, frame)
    clock.time_ns += 1_100_000_000
    for frame in walk(90)[30:]:
        node.handle(POSE_RAW, frame)
    assert node._writer
    node._writer.close()
    assert node.health.counts[NO_ROOM] == 30
    with RecordingReader(tmp_path / "out") as reader:
        assert (reader.complete, reader.count(POSE_RAW)) == (True, 60)


def test_it_completes_the_recording_though_a_tracker_goes_on(tmp_path: Path, recorder, clock, monkeypatch) -> None:
    frames = iter(walk(200))

    def take_next(_: float) -> bool:
        clock.time_ns += 33_000_000
        recorder.handle(POSE_RAW, next(frames))
        return True

    monkeypatch.setattr(Node, "work", lambda self: None)
    monkeypatch.setattr(recorder, "take_next", take_next)
    recorder.work()
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.complete
        assert reader.count(POSE_RAW) == 61


def test_a_folder_whose_name_is_no_utf_8_is_reported(recorder: RecorderNode) -> None:
    recorder._settings = replace(recorder._settings, directory="/caf\udce9")
    assert b"/caf\\xe9\0" in encode(Diagnostics(0, "recorder", Level.OK, "", recorder.status()))


def test_reports_before_the_first_pose_have_its_time_and_fill_no_memory(tmp_path: Path, recorder) -> None:
    for number in range(3 * WAITING):
        recorder.handle(DIAGNOSTICS, Diagnostics(0, "prior", Level.OK, str(number), {}))
    recorder.handle(POSE_RAW, walk(1)[0])
    recorder._writer.close()
    with RecordingReader(tmp_path / "out") as reader:
        found = [(ns, m.message) for _, ns, m in reader.messages([DIAGNOSTICS]) if isinstance(m, Diagnostics)]
    assert found == [(walk(1)[0].stamp_ns, str(number)) for number in range(2 * WAITING, 3 * WAITING)]


def test_a_clock_that_was_set_back_keeps_nothing_from_the_disk(tmp_path: Path, recorder, clock) -> None:
    for index, frame in enumerate(walk(300)):
        clock.time_ns += 33_000_000
        back_ns = 7200 * 10**9 * (index > 100)
        recorder.handle(POSE_RAW, replace(frame, stamp_ns=frame.stamp_ns + 10**13 - back_ns, bodies=[]))
    with RecordingReader(tmp_path / "out") as reader:
        assert reader.count(POSE_RAW) >= 300 - 5.1 / 0.033


@pytest.mark.parametrize(("stamps", "expected"), [
    ([5, 7, 6, 8], [5, 7, 7, 8]),
    ([5, 2**61, 7, 8], [5, 5, 7, 8]),
    ([5, 2**61, 7, 2**61, 9], [5, 5, 7, 7, 9]),
    ([5, AHEAD_NS + 6, AHEAD_NS + 7, AHEAD_NS + 8], [5, 5, AHEAD_NS + 7, AHEAD_NS + 8]),
], ids=["back", "one wrong", "two wrong", "the clock was set"])  # fmt: skip
def test_log_times_follow_the_stamps_but_neither_back_nor_to_a_wrong_one(stamps: list[int], expected: list[int]):
    log_times = LogTimes()
    assert [log_times.next(POSE_RAW, stamp) for stamp in stamps] == expected


def test_what_a_killed_recorder_had_not_written_was_not_taken(tmp_path: Path, recorder: RecorderNode) -> None:
    settled = []
    for frame in walk(40):
        recorder.handle(POSE_RAW, frame)
        settled.append(recorder.settle())
        with RecordingReader(tmp_path / "out") as reader:
            assert not settled[-1] or reader.count(POSE_RAW) == len(settled)
    assert settled.count(True) == 3, "as often as the writer gives what it has to the system"
    recorder.handle(POSE_RAW, end_of(walk(40)[-1]))
    assert recorder.settle(), "who hears of the end may stop the recorder"
