import io
from collections.abc import Callable
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from numpy.typing import NDArray
from tests.helpers.bvh_writer import write_bvh
from tests.prior.body.test_rigs import FAMILIES
from tests.training.data.test_motion_plug_in_gait import BENDS, STILL, recording

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.commands.prepare import prepare
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.rigs import recognise_points
from steadypose.prior.body.skeleton import JOINTS, REST_POSITIONS, J
from steadypose.prior.mocap.clip import MotionError
from steadypose.prior.mocap.files import Description, read_motion
from steadypose.prior.mocap.plug_in_gait import MARKERS, calibrate, joint_centres

HALPE = {
    "Hip": "pelvis", "RHip": "right_hip", "RKnee": "right_knee", "RAnkle": "right_ankle", "RBigToe": "right_foot",
    "LHip": "left_hip", "LKnee": "left_knee", "LAnkle": "left_ankle", "LBigToe": "left_foot", "Neck": "neck",
    "Head": "head", "RShoulder": "right_shoulder", "RElbow": "right_elbow", "RWrist": "right_wrist",
    "LShoulder": "left_shoulder", "LElbow": "left_elbow", "LWrist": "left_wrist",
}  # fmt: skip
"""As Pose2Sim names its markers."""


def points(frames: int = 4) -> NDArray[np.float64]:
    """(T, J, 3) metres, z up, of the names of `HALPE`."""
    body = REST_POSITIONS[[J[joint] for joint in HALPE.values()]] + [0.0, 0.0, 0.95]
    return body + np.arange(frames)[:, None, None] * [0.01, 0.0, 0.0]


def trc(metres: NDArray[np.float64], unit: float = 0.001, name: str = "mm") -> bytes:
    """Positions with y up, as OpenSim has it."""
    values = metres[..., [1, 2, 0]] / unit
    rows = [
        "PathFileType\t4\t(X/Y/Z)\ttake.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"60\t60\t{len(values)}\t{len(HALPE)}\t{name}\t60\t1\t{len(values)}",
        "Frame#\tTime\t" + "\t\t\t".join(HALPE) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(HALPE)) for axis in "XYZ"),
        "",
    ]
    for k, frame in enumerate(values):
        cells = ["" if np.isnan(v) else f"{v:.5f}" for v in frame.ravel()]
        rows.append("\t".join([str(k + 1), f"{k / 60:.5f}", *cells]))
    return "\n".join(rows).encode()


def c3d(path: Path, names: list[str], millimetres: NDArray[np.float64]) -> bytes:
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["data"]["points"] = np.concatenate(
        [millimetres.transpose(2, 1, 0), np.ones((1, len(names), len(millimetres)))]
    )
    file.write(str(path))
    return path.read_bytes()


@pytest.mark.parametrize(("unit", "name"), [(0.001, "mm"), (1.0, "m")])
def test_a_trc_is_read_in_metres_and_z_up(unit: float, name: str) -> None:
    truth = points()
    holed = truth.copy()
    holed[1, list(HALPE).index("LWrist")] = np.nan
    fps, body = read_motion("take.trc", trc(holed, unit, name))
    assert fps == 60
    # y up to z up by a quarter turn about x: what was to the front (+z) is then at -y.
    seen = body[:, [J[joint] for joint in HALPE.values()]]
    expected = truth[..., [1, 0, 2]] * [1, -1, 1]
    assert np.isnan(seen[1, list(HALPE).index("LWrist")]).all()
    hip = list(HALPE).index("Hip")  # the middle of the hips; the pelvis lies above
    np.testing.assert_allclose(seen[:, hip], expected[:, hip], atol=3e-3)
    keep = np.isfinite(seen)
    keep[:, hip] = False
    np.testing.assert_allclose(seen[keep], expected[keep], atol=1e-4)
    assert np.isnan(body[:, J["spine1"]]).all()


@pytest.mark.parametrize("change", [
    lambda rows: "\n".join(rows).encode("utf-16"),
    lambda rows: "\r\n".join(rows).replace(".", ",").encode(),
    lambda rows: "\n".join([*rows[:3], rows[3].replace("\tL", "\tAnna:L"), *rows[4:]]).encode(),
    lambda rows: "\n".join([*rows[:2], rows[2].replace("mm", "millimeters"), *rows[3:]]).encode(),
])  # fmt: skip
def test_a_trc_is_read_however_its_program_writes_it(change: Callable[[list[str]], bytes]) -> None:
    content = trc(points())
    np.testing.assert_array_equal(
        read_motion("x.trc", change(content.decode().split("\n"))).positions, read_motion("x.trc", content).positions
    )


def test_frames_that_a_trc_leaves_out_are_frames_without_points() -> None:
    rows = trc(points(40)).replace(b"\t40\t17", b"\t30\t17").split(b"\n")
    whole, body = (read_motion("x.trc", b"\n".join(r)).positions for r in (rows, [*rows[:16], *rows[26:]]))
    assert len(body) == 40
    assert np.isnan(body[10:20]).all()
    np.testing.assert_array_equal(body[20:], whole[20:])
    other = b"\n".join(rows).replace(b"60\t60", b"30\t30")
    with pytest.raises(MotionError, match=r"DataRate of 30 Hz and times of 60 Hz: correct one .* fps with .*--rig"):
        read_motion("x.trc", other)
    fps, body = read_motion("x.trc", other, Description(fps=60.0))
    assert fps == 60
    np.testing.assert_array_equal(body, whole)


def test_a_point_at_the_origin_is_missing(tmp_path: Path) -> None:
    holed = points()
    holed[1, list(HALPE).index("LWrist")] = 0.0
    for name, content in (("x.trc", trc(holed)), ("x.c3d", c3d(tmp_path / "x.c3d", list(HALPE), 1000 * holed))):
        missing = np.isnan(read_motion(name, content).positions[:, J["left_wrist"]]).all(axis=1)
        assert missing.tolist() == [False, True, False, False]


def test_points_of_several_subjects_are_told_apart(tmp_path: Path) -> None:
    names = [f"{subject}:{name}" for subject in ("Anna", "Ben") for name in HALPE]
    both = np.concatenate([points(), points() + [2.0, 0.0, 0.0]], axis=1)
    del names[2]  # Anna lacks a knee
    content = c3d(tmp_path / "x.c3d", names, 1000 * np.delete(both, 2, axis=1))
    with pytest.raises(MotionError, match="expected one body, got points of Anna, Ben: export each body alone"):
        read_motion("x.c3d", content)
    _, body = read_motion("x.c3d", content, Description(canonical={"head": "Ben:Head"}, up="z"))
    np.testing.assert_allclose(body[:, J["head"]], points()[:, list(HALPE).index("Head")] + [2, 0, 0], atol=1e-4)


def test_a_c3d_may_have_more_than_255_points(tmp_path: Path) -> None:
    names = [*(f"M{k}" for k in range(260)), *HALPE]
    many = np.concatenate([np.ones((4, 260, 3)), points()], axis=1)
    _, body = read_motion("x.c3d", c3d(tmp_path / "x.c3d", names, 1000 * many))
    np.testing.assert_allclose(body[:, J["head"]], points()[:, list(HALPE).index("Head")], atol=1e-4)


def test_a_file_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    whole = c3d(tmp_path / "x.c3d", list(HALPE), 1000 * points(40))
    cut = {"take.trc": trc(points(40)).rpartition(b"\n")[0], "take.c3d": whole[: len(whole) * 7 // 10]}
    for name, content in cut.items():
        with pytest.raises(MotionError, match=r"expected 40 frames, as its header says, got \d+; .* is cut short"):
            read_motion(name, content)


def test_a_c3d_is_of_joints_or_of_markers_on_the_skin(tmp_path: Path) -> None:
    fps, body = read_motion("take.C3D", c3d(tmp_path / "x.c3d", [f"Anna:{n}" for n in HALPE], points() * 1000))
    assert fps == 100
    seen = np.delete(body[:, [J[joint] for joint in HALPE.values()]], list(HALPE).index("Hip"), axis=1)
    np.testing.assert_allclose(seen, np.delete(points(), list(HALPE).index("Hip"), axis=1), atol=1e-4)
    markers = recording(BENDS[:5], STILL, np.zeros(3))
    markers |= {"LTIB": markers["LANK"], "RTIB": markers["RANK"]}
    millimetres = 1000 * np.stack(list(markers.values()), axis=1)
    _, body = read_motion("x.c3d", c3d(tmp_path / "x.c3d", list(markers), millimetres))
    np.testing.assert_allclose(body, joint_centres(markers, calibrate([markers])), atol=1e-4)


def test_metres_under_a_header_of_millimetres_are_named(tmp_path: Path) -> None:
    """Markers as well: with a joint's width of centimetres beside them, no body would be left to be measured."""
    for names in (list(HALPE), [*MARKERS]):
        content = c3d(tmp_path / "x.c3d", names, np.ones((4, len(names), 3)))
        with pytest.raises(MotionError, match=r"unit, mm, .* seem to be metres; .* metres = 1\.0 with .*--rig"):
            read_motion("x.c3d", content)
    _, body = read_motion("x.c3d", c3d(tmp_path / "x.c3d", list(HALPE), points()), Description(metres=1.0))
    np.testing.assert_allclose(body[:, J["head"]], points()[:, list(HALPE).index("Head")], atol=1e-4)


def test_points_are_known_by_side_and_part_however_they_are_written() -> None:
    for names in (
        ["L_Hip", "R_Hip", "L_Shoulder", "R_Shoulder"],
        ["HIP_LEFT", "HIP_RIGHT", "leftShoulder", "rightShoulder"],
        ["LHJC", "RHJC", "LSHOULDER", "rshoulder"],
    ):
        sided = {f"{side}_{part}" for side in ("left", "right") for part in ("hip", "shoulder")}
        table = recognise_points([*names, "l.ear", "r.ear", "nose"]).table
        assert set(table) == {*sided, "pelvis", "neck", "head"}
    with pytest.raises(MotionError, match=r"left_hip.*M1.*--rig"):
        recognise_points(["M1", "M2"])


def test_arrays_need_to_be_described(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, REST_POSITIONS[None].repeat(3, axis=0) * 100)
    with pytest.raises(MotionError, match="fps"):
        read_motion("x.npy", buffer.getvalue())
    fps, body = read_motion("x.npy", buffer.getvalue(), Description(fps=25.0, metres=0.01))
    assert fps == 25
    np.testing.assert_allclose(body[0], REST_POSITIONS, atol=1e-9)


def test_a_table_without_tabs_says_so() -> None:
    with pytest.raises(MotionError, match=r"DataRate in the second line .*separated by tabs; got 'DataRate "):
        read_motion("x.trc", trc(points()).replace(b"\t", b" "))


@pytest.mark.parametrize("name", ["x.bvh", "x.trc", "x.c3d", "x.npy", "x.npz"])
@pytest.mark.parametrize("content", [b"", b"HIERARCHY\n", b"PathFileType\n1\n2\n3\n4\n5\nx", bytes(600)])
def test_what_cannot_be_read_is_refused(name: str, content: bytes) -> None:
    with pytest.raises(MotionError):
        read_motion(name, content)


def test_a_file_of_motion_is_a_recording(tmp_path: Path) -> None:
    take = tmp_path / "take.bvh"
    take.write_bytes(write_bvh(FAMILIES["Mixamo"].joints(), np.array([0.0, 95.0, 0.0]), 60.0, frames=7))
    source = open_recording(take)
    frames = [message for _, message in source if isinstance(message, PoseRaw)]
    assert len(source) == len(frames) == 7
    assert frames[0].skeleton == "smpl22"
    assert frames[6].stamp_ns == pytest.approx(1e8, rel=1e-4)
    assert frames[0].bodies[0].positions[J["head"], 2] == pytest.approx(1.56, abs=0.001)


def test_a_folder_of_any_name_is_prepared_each_folder_a_person(tmp_path: Path) -> None:
    for person in ("anna", "val/bob"):
        (tmp_path / "takes" / person).mkdir(parents=True)
        content = write_bvh(FAMILIES["Xsens"].joints(), np.array([0.0, 99.0, 0.0]), 60.0, frames=90)
        (tmp_path / "takes" / person / "stand.bvh").write_bytes(content)
    prepare(tmp_path / "takes", tmp_path / "data")
    with np.load(tmp_path / "data" / "prepared.npz") as z:
        assert dict(zip(z["subject"].tolist(), z["split"].tolist(), strict=True)) == {"anna": "train", "val/bob": "val"}
        assert z["positions"].shape[1] == len(JOINTS)


def test_motion_is_prepared_once_at_each_speed(tmp_path: Path) -> None:
    (tmp_path / "takes").mkdir()
    content = write_bvh(FAMILIES["Xsens"].joints(), np.array([0.0, 99.0, 0.0]), 60.0, frames=180)
    (tmp_path / "takes" / "stand.bvh").write_bytes(content)
    prepare(tmp_path / "takes", tmp_path / "data", (1.0, 1.0, 2.0))
    with np.load(tmp_path / "data" / "prepared.npz") as z:
        assert z["name"].tolist() == ["stand.bvh", "stand.bvh x2"]
    with pytest.raises(LaunchError, match="--speeds: expected numbers above 0, got 1, 0"):
        prepare(tmp_path / "takes", tmp_path / "data", (1.0, 0.0))
    (tmp_path / "takes" / "stand.bvh").write_bytes(b"unreadable")
    with pytest.raises(LaunchError, match=r"cannot write to .*stand\.bvh to be a folder"):
        prepare(tmp_path / "takes", tmp_path / "takes" / "stand.bvh" / "data")
