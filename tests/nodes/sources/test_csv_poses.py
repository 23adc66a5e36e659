import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from conftest import walk

from steadypose.msgs.types import Pose, PoseRaw
from steadypose.nodes.sources.recording import CsvError, CsvSource, open_recording
from steadypose.prior.body.skeleton import JOINTS

NOSE = "stamp,nose_x,nose_y,nose_z"
HEADER = "stamp," + ",".join(f"{joint}_{axis}" for joint in JOINTS for axis in "xyz")


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def row(stamp: float | str, positions: np.ndarray) -> str:
    return ",".join([str(stamp), *(f"{value:.6f}" for value in positions.ravel())])


def frames(path: Path) -> list[PoseRaw]:
    return [message for _, message in CsvSource(path) if isinstance(message, PoseRaw)]


def test_a_row_is_a_frame(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(3, 22, 3)).round(6)
    path = write(tmp_path / "x.csv", HEADER, *(row(i / 10, p) for i, p in enumerate(positions)))
    got = frames(path)
    assert [frame.stamp_ns for frame in got] == [0, 100_000_000, 200_000_000]
    assert {frame.skeleton for frame in got} == {"smpl22"}
    np.testing.assert_array_equal([frame.bodies[0].positions for frame in got], positions.astype(np.float32))
    assert all((frame.bodies[0].confidence == 1).all() for frame in got)


def test_columns_may_be_missing_and_in_any_order_and_cells_empty(tmp_path: Path) -> None:
    header = "nose_z, nose_x, left_ear_x, left_ear_y, left_ear_z, nose_y, left_ear_confidence, stamp"
    lines = ["# made by hand", "# up: -y", header, "", "3,1,4,,6,2,0.25,1700000000.5"]
    (frame,) = frames(write(tmp_path / "x.csv", *lines))
    assert frame.stamp_ns == 1_700_000_000_500_000_000
    assert frame.skeleton == "coco17"
    np.testing.assert_array_equal(frame.bodies[0].positions[0], [1, 2, 3])
    np.testing.assert_array_equal(frame.bodies[0].positions[3], [4, np.nan, 6])
    assert frame.bodies[0].confidence[[0, 3]].tolist() == [1.0, 0.25]
    assert np.isnan(frame.bodies[0].positions[5:]).all()
    assert (frame.bodies[0].confidence[5:] == 0).all()
    np.testing.assert_allclose(frame.sensor_pose.orientation, [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_several_bodies_have_a_row_each_and_a_whole_number_that_fits(tmp_path: Path) -> None:
    header, named = "stamp,body,nose_x,nose_y,nose_z", ["2.0", "1.5", "inf", "", "nan", "1e30", "-7"]
    path = write(tmp_path / "x.csv", header, "0.0,4,1,1,1", "0.0,7,2,2,2", "0.1,7,3,3,3", "0.2,4,5,5,5")
    assert [[body.id for body in frame.bodies] for frame in frames(path)] == [[4, 7], [7], [4]]
    source = CsvSource(write(tmp_path / "y.csv", header, *(f"0.{k},{body},1,1,1" for k, body in enumerate(named))))
    assert [body.id for _, message in source if isinstance(message, PoseRaw) for body in message.bodies] == [2, -7]
    assert source.refused == {"rows of which the body is no whole number of 32 bits, first row 3, column body: 1.5": 5}


def test_a_skeleton_may_be_named(tmp_path: Path) -> None:
    header = "stamp,left_wrist_x,left_wrist_y,left_wrist_z"
    assert frames(write(tmp_path / "x.csv", header, "0,1,2,3"))[0].skeleton == "smpl22"
    named = frames(write(tmp_path / "y.csv", "# skeleton: blazepose33", header, "0,1,2,3"))[0]
    assert named.skeleton == "blazepose33"
    np.testing.assert_array_equal(named.bodies[0].positions[15], [1, 2, 3])


def test_rows_that_are_no_frames_are_counted_and_left_out(tmp_path: Path) -> None:
    bad = ["1,2", "x,1,2,3", "nan,1,2,3", "-1,1,2,3", "1e300,1,2,3", "1,2,3,4,5", "0.1,1,two,3", "", "0.5,1,2,3"]
    source = CsvSource(write(tmp_path / "x.csv", "# up: y", "", NOSE, *bad, "0.6,1e300,inf,3"))
    assert len(source) == 2
    assert len(list(source)) == 2
    assert source.refused == {
        "rows of another length than the header, first row 4: 2 cells for 4 columns": 2,
        "rows with something else than numbers, first row 5, column stamp: 'x'": 2,
        "rows without a stamp of 0 s or more, first row 6, column stamp: nan": 3,
    }
    unused = CsvSource(write(tmp_path / "y.csv", "stamp,person_name,nose_x,nose_y,nose_z", "", "0,bob,1,2,3"))
    assert (len(unused), unused.refused) == (1, {}), "columns that are not used may contain text"


@pytest.mark.parametrize("cell", ["null", "N/A", "nan", "-", "None", "#N/A", " "])
def test_words_for_a_missing_number_leave_its_joint_unobserved(tmp_path: Path, cell: str) -> None:
    (frame,) = frames(write(tmp_path / "x.csv", "stamp,nose_x,nose_y,nose_z,nose_confidence", f"0,1,{cell},3,{cell}"))
    np.testing.assert_array_equal(frame.bodies[0].positions[0], [1, np.nan, 3])
    assert frame.bodies[0].confidence[0] == 0


@pytest.mark.parametrize(("start", "step", "expected"), [
    (0, 100 / 3, "got 0, 33, 67: these look like milliseconds; divide by 1000$"),
    (1_750_000_000_000, 100 / 12, "got 1750000000000, 1750000000008, .*milliseconds; divide by 1000$"),
    (0, 1e5 / 3, ".*microseconds; divide by 1000000$"),
    (0, 1e8 / 3, ".*nanoseconds; divide by 1000000000$"),
    (1_750_000_000 * 10**9, 1e9, ".*nanoseconds; divide by 1000000000$"),
])  # fmt: skip
def test_stamps_in_another_unit_are_refused_and_whole_seconds_read(tmp_path: Path, start, step, expected: str) -> None:
    lines = [f"{start + round(k * step)},{body},1,2,3" for k in range(9) for body in (1, 2)]
    with pytest.raises(CsvError, match=f"stamp: expected seconds, {expected}"):
        CsvSource(write(tmp_path / "x.csv", "stamp,body,nose_x,nose_y,nose_z", *lines))
    for slow_s in (1, 2, 5, 10):
        assert len(CsvSource(write(tmp_path / "x.csv", NOSE, *(f"{slow_s * k},1,2,3" for k in range(9))))) == 9


def test_remarks_are_no_settings_and_what_seems_one_is_warned_of(tmp_path: Path, caplog) -> None:
    lines = ["# recorded by hand: the first take", "# UP: y", "# unit: mm", NOSE, "0,1,2,3"]
    (frame,) = frames(write(tmp_path / "x.csv", *lines))
    np.testing.assert_array_equal(frame.sensor_pose.orientation, Pose.from_up("y").orientation)
    (record,) = caplog.records
    assert "'# unit: mm' is not used: expected '# skeleton: NAME' or '# up: AXIS'" in record.getMessage()


@pytest.mark.parametrize(("lines", "expected"), [
    ([], "has no rows: expected a header, stamp, JOINT_x"),
    (["time,nose_x,nose_y,nose_z"], "expected a header with a column 'stamp', in seconds; got time, nose_x"),
    (["stamp"], "JOINT_z for each joint; got none among stamp"),
    (["stamp;nose_x;nose_y;nose_z", "0;1;2;3"], "by commas, got ';' in 'stamp;nose_x.*save it with commas"),
    (["stamp,Nose_X"], "for each joint; got none among stamp, Nose_X"),
    (["stamp,nose_x,nose_y"], "missing: nose_z"),
    (["stamp,nose_x,nose_y,nose_z,nose_x"], "each column once, got nose_x again"),
    (["stamp,nose_x,nose_y,nose_z,tail_x,tail_y,tail_z"], "is closest, but has no tail"),
    (["stamp,LeftWrist_x,LeftWrist_y,LeftWrist_z"], "smpl22 is closest, but has no LeftWrist .left_wrist.; rename"),
    (["# skelton: smpl22", NOSE], "expected a line '# skeleton: NAME' .* got '# skelton: smpl"),
    (["# skeleton: smpl", NOSE], "skeleton: expected one of smpl22, .* got 'smpl'"),
    (["# skeleton: smpl22", NOSE], "smpl22 is closest, but has no nose"),
    (["# up: x", NOSE, "0,1,2,3"], "up: expected one of"),
    ([NOSE], "has a header, but no rows"),
    ([NOSE, "a,b,c,d"], "expected a row of numbers.*row 2, column stamp: 'a'"),
    ([NOSE, "0,1,2," + "3" * 200_000], "cannot be read as CSV: field larger"),
])  # fmt: skip
def test_a_csv_that_is_not_poses_says_what_was_expected(tmp_path: Path, lines: list[str], expected: str) -> None:
    with pytest.raises(CsvError, match=expected):
        CsvSource(write(tmp_path / "x.csv", *lines))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le"])
def test_bytes_that_are_no_text_say_so(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "x.csv").write_text("stamp,nose_x,nose_y,nose_z\n0,1,2,3\n", encoding)
    with pytest.raises(CsvError, match=r"cannot be read as text: .*; save it as UTF-8"):
        open_recording(tmp_path / "x.csv")


def test_a_csv_is_played_as_an_npz_of_the_same_poses(tmp_path: Path) -> None:
    stream = walk(45)
    positions = np.stack([frame.bodies[0].positions for frame in stream]).astype(np.float64).round(6)
    stamps = np.array([frame.stamp_ns for frame in stream]) - stream[0].stamp_ns
    write(tmp_path / "x.csv", HEADER, *(row(f"{ns / 1e9:.9f}", p) for ns, p in zip(stamps, positions, strict=True)))
    np.savez(tmp_path / "x.npz", positions=positions, stamp_ns=stamps, skeleton="smpl22")
    played = open_recording(tmp_path / "x.csv")
    assert len(played) == len(stream)
    assert list(played) == list(open_recording(tmp_path / "x.npz"))


def test_a_long_file_is_not_held_as_text(tmp_path: Path) -> None:
    rows = (row(k / 100, np.full((22, 3), k / 1000)) for k in range(2000))
    path = write(tmp_path / "x.csv", HEADER, *rows)
    tracemalloc.start()
    try:
        assert len(CsvSource(path)) == 2000
        assert tracemalloc.get_traced_memory()[1] < 3 * path.stat().st_size
    finally:
        tracemalloc.stop()
