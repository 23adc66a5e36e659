"""CSV files of poses: what they may say, what comes of it, and what is told of those that hold none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import walk

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.sources.recording import CsvError, CsvSource, open_recording
from steadypose.prior.body.skeleton import JOINTS

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
    path = write(
        tmp_path / "x.csv",
        "# made by hand",
        "# up: -y",
        "nose_z, nose_x, left_ear_x, left_ear_y, left_ear_z, nose_y, left_ear_confidence, stamp",
        "",
        "3,1,4,,6,2,0.25,1700000000.5",
    )
    (frame,) = frames(path)
    assert frame.stamp_ns == 1_700_000_000_500_000_000
    assert frame.skeleton == "coco17"
    np.testing.assert_array_equal(frame.bodies[0].positions[0], [1, 2, 3])
    np.testing.assert_array_equal(frame.bodies[0].positions[3], [4, np.nan, 6])
    assert frame.bodies[0].confidence[[0, 3]].tolist() == [1.0, 0.25]
    assert np.isnan(frame.bodies[0].positions[5:]).all()
    assert (frame.bodies[0].confidence[5:] == 0).all()
    np.testing.assert_allclose(frame.sensor_pose.orientation, [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_several_bodies_have_a_row_each(tmp_path: Path) -> None:
    path = write(
        tmp_path / "x.csv",
        "stamp,body,nose_x,nose_y,nose_z",
        "0.0,4,1,1,1", "0.0,7,2,2,2", "0.1,7,3,3,3", "0.2,4,5,5,5",
    )  # fmt: skip
    assert [[body.id for body in frame.bodies] for frame in frames(path)] == [[4, 7], [7], [4]]


def test_a_body_is_a_whole_number_that_fits(tmp_path: Path) -> None:
    rows = [f"0.{k},{body},1,1,1" for k, body in enumerate(["2.0", "1.5", "inf", "", "nan", "1e30", "-7"])]
    source = CsvSource(write(tmp_path / "x.csv", "stamp,body,nose_x,nose_y,nose_z", *rows))
    assert [body.id for _, message in source if isinstance(message, PoseRaw) for body in message.bodies] == [2, -7]
    assert source.refused == {
        "rows of which the body is no whole number": 4,
        "rows with something else than numbers": 1,
    }


def test_a_skeleton_may_be_named(tmp_path: Path) -> None:
    header = "stamp,left_wrist_x,left_wrist_y,left_wrist_z"
    assert frames(write(tmp_path / "x.csv", header, "0,1,2,3"))[0].skeleton == "smpl22"
    named = frames(write(tmp_path / "y.csv", "# skeleton: blazepose33", header, "0,1,2,3"))[0]
    assert named.skeleton == "blazepose33"
    np.testing.assert_array_equal(named.bodies[0].positions[15], [1, 2, 3])


def test_rows_that_are_no_frames_are_counted_and_left_out(tmp_path: Path) -> None:
    good = "0.5,1,2,3"
    bad = ["1,2", "x,1,2,3", "nan,1,2,3", "-1,1,2,3", "1e300,1,2,3", "1,2,3,4,5", "0.1,1,two,3", good]
    source = CsvSource(write(tmp_path / "x.csv", "stamp,nose_x,nose_y,nose_z", *bad, "0.6,1e300,inf,3"))
    assert len(source) == 2
    assert len(list(source)) == 2
    assert source.refused == {
        "rows of another length than the header": 2,
        "rows with something else than numbers": 2,
        "rows without a stamp of 0 s or more": 3,
    }


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ([], "has no rows: expected a header, stamp, JOINT_x"),
        (["time,nose_x,nose_y,nose_z"], "expected a header with a column 'stamp', in seconds; got time, nose_x"),
        (["stamp"], "JOINT_z for each joint; got none"),
        (["stamp,nose_x,nose_y"], "missing: nose_z"),
        (["stamp,nose_x,nose_y,nose_z,nose_x"], "each column once, got nose_x again"),
        (["stamp,nose_x,nose_y,nose_z,tail_x,tail_y,tail_z"], "is closest, but has no tail"),
        (["# skeleton: smpl", "stamp,nose_x,nose_y,nose_z"], "skeleton: expected one of smpl22, .* got 'smpl'"),
        (["# skeleton: smpl22", "stamp,nose_x,nose_y,nose_z"], "smpl22 is closest, but has no nose"),
        (["# up: x", "stamp,nose_x,nose_y,nose_z", "0,1,2,3"], "up: expected one of"),
        (["stamp,nose_x,nose_y,nose_z"], "has a header, but no rows"),
        (["stamp,nose_x,nose_y,nose_z", "a,b,c,d"], "at least one row"),
        (["stamp,nose_x,nose_y,nose_z", "0,1,2," + "3" * 200_000], "cannot be read as CSV: field larger"),
    ],
)
def test_a_csv_that_is_not_poses_says_what_was_expected(tmp_path: Path, lines: list[str], expected: str) -> None:
    with pytest.raises(CsvError, match=expected):
        CsvSource(write(tmp_path / "x.csv", *lines))


def test_bytes_that_are_no_text_say_so(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00stamp")
    with pytest.raises(CsvError, match="cannot be read as text"):
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
