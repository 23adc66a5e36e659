"""From files to clips: archives and folders, families of skeletons, and the splits."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.training.data.test_motion_amc import AMC, ASF

from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.mocap.bvh import CMU_BVH
from steadypose.prior.mocap.clip import Clip, MotionError
from steadypose.training.data.cmu import CMU_AMC
from steadypose.training.data.datasets import DATA_SETS, REPEATS
from steadypose.training.data.readers import Dropped, amc_motions, bvh_motion, members

# A body of ReActIdle's family, y up, facing +z, left +x: name, depth, offset, end site.
BODY: list[tuple[str, int, tuple[float, float, float], tuple[float, float, float] | None]] = [
    ("pelvis", 0, (0, 0, 0), None),
    ("spine.001", 1, (0, 0.23, 0), None),
    ("neck", 2, (0, 0.23, 0), None),
    ("face", 3, (0, 0.18, 0), (0, 0.03, 0)),
    ("upper_arm.L", 2, (0.17, 0.23, 0), None),
    ("forearm.L", 3, (0, -0.27, 0), (0, -0.2, 0.1)),
    ("upper_arm.R", 2, (-0.17, 0.23, 0), None),
    ("forearm.R", 3, (0, -0.27, 0), (0, -0.2, 0.1)),
    ("thigh.L", 1, (0.1, 0, 0), None),
    ("shin.L", 2, (0, -0.4, 0.02), None),
    ("foot.L", 3, (0, -0.4, -0.02), (0, -0.06, 0.15)),
    ("thigh.R", 1, (-0.1, 0, 0), None),
    ("shin.R", 2, (0, -0.4, 0.02), None),
    ("foot.R", 3, (0, -0.4, -0.02), (0, -0.06, 0.15)),
]


def idle_bvh(frames: int = 60, fps: float = 24.0, sway: float = 0.02) -> str:
    """The body above, standing at 0.9 m and swaying sideways."""
    lines, depth = ["HIERARCHY"], -1
    for name, level, offset, end in BODY:
        lines += ["}"] * (depth - level + 1)
        channels = "6 Xposition Yposition Zposition Xrotation Yrotation Zrotation" if level == 0 else "0"
        lines += [
            f"{'JOINT' if level else 'ROOT'} {name}",
            "{",
            "OFFSET {} {} {}".format(*offset),
            f"CHANNELS {channels}",
        ]
        if end:
            lines += ["End Site", "{", "OFFSET {} {} {}".format(*end), "}"]
        depth = level
    lines += ["}"] * (depth + 1)
    lines += ["MOTION", f"Frames: {frames}", f"Frame Time: {1 / fps:.6f}"]
    lines += [f"{sway * np.sin(t / fps):.6f} 0.9 0 0 0 0" for t in range(frames)]
    return "\n".join(lines)


def pack(path: Path, files: dict[str, str]) -> Path:
    with tarfile.open(path, "w:xz") as archive:
        for name, text in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(text.encode())
            archive.addfile(entry, io.BytesIO(text.encode()))
    return path


def unpack(path: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(text)
    return path


def ignore(_: float) -> None:
    pass


@pytest.mark.parametrize("rig", [CMU_AMC, CMU_BVH], ids=lambda r: r.skeleton.name)
def test_every_family_gives_a_complete_and_even_body(rig) -> None:
    skeleton = rig.skeleton
    assert skeleton.observable.all()
    rows = skeleton.to_canonical
    left = {name for joint in JOINTS if joint.startswith("left") for name in np.flatnonzero(rows[J[joint]])}
    right = {name for joint in JOINTS if joint.startswith("right") for name in np.flatnonzero(rows[J[joint]])}
    for joint in JOINTS:
        if joint.startswith("left"):
            other = rows[J[joint.replace("left", "right")]]
            np.testing.assert_allclose(np.sort(rows[J[joint]]), np.sort(other))
            assert set(np.flatnonzero(rows[J[joint]])) - right, f"{joint} has nothing of its own"
            assert set(np.flatnonzero(other)) - left, f"{joint}'s counterpart has nothing of its own"
    # Four of a leg, three of an arm, and the collar where the family has one.
    assert len(left - right) == len(right - left) in (7, 8)


def test_an_archive_a_folder_and_a_file_read_alike(tmp_path: Path) -> None:
    files = {"a/1.bvh": "one", "b/2.bvh": "two", "b/notes.txt": "no"}
    expected = [("a/1.bvh", b"one"), ("b/2.bvh", b"two")]
    told: list[float] = []
    assert list(members(pack(tmp_path / "x.tar.xz", files), (".bvh",), told.append)) == expected
    assert list(members(unpack(tmp_path / "x", files), (".bvh",), ignore)) == expected
    assert list(members(tmp_path / "x" / "b" / "2.bvh", (".bvh",), ignore)) == [("2.bvh", b"two")]
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


def test_an_archive_cut_short_is_refused_in_words(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = pack(tmp_path / "x.tar.xz", {f"{i}.bvh": rng.bytes(20_000).hex() for i in range(4)})
    path.write_bytes(path.read_bytes()[:30_000])
    with pytest.raises(MotionError, match="whole"):
        list(members(path, (".bvh",), ignore))


def test_a_bvh_is_recognised_and_stands_upright_with_its_left_on_the_left() -> None:
    bvh, skeleton, positions = bvh_motion(idle_bvh())
    assert skeleton.table["left_elbow"] == {"forearm.L": 1.0}
    assert bvh.fps == pytest.approx(24, rel=1e-4)
    clip = Clip("x", "", "", "", "", bvh.fps, skeleton, positions).canonical()
    body: NDArray[np.float64] = clip.positions[0]
    assert body[J["head"], 2] > body[J["pelvis"], 2] > body[J["left_foot"], 2]
    # The file faces +z, which a quarter turn about x takes to -y; left is then +x.
    assert body[J["left_hip"], 0] > 0 > body[J["right_hip"], 0]
    assert body[J["left_foot"], 1] < body[J["left_ankle"], 1] - 0.1
    assert body[J["left_wrist"], 2] == pytest.approx(0.9 + 0.46 - 0.27 - 0.2, abs=1e-6)


def test_a_rest_pose_put_in_front_is_left_out() -> None:
    rows = idle_bvh(frames=40).splitlines()
    rows[rows.index("Frames: 40") + 2] = "0 0.9 5 0 0 0"
    assert len(bvh_motion("\n".join(rows))[2]) == 39
    assert len(bvh_motion(idle_bvh(frames=40))[2]) == 40


def test_the_way_out_of_a_rest_pose_is_left_out_too() -> None:
    rows = idle_bvh(frames=40).splitlines()
    first = rows.index("Frames: 40") + 2
    rows[first : first + 2] = ["0 0.9 5 0 0 0", "0 0.9 0.5 0 0 0"]
    assert len(bvh_motion("\n".join(rows))[2]) == 38


def test_a_bvh_without_a_body_says_what_was_looked_for() -> None:
    with pytest.raises(MotionError, match=r"legs and arms.*left and right.*'?pelvis.*--rig"):
        bvh_motion(idle_bvh().replace(".R", ".X"))


def test_an_amc_finds_its_skeleton_in_its_folder_whatever_the_order(tmp_path: Path) -> None:
    motions = dict(amc_motions(unpack(tmp_path, {"01/01_01.amc": AMC, "01/z.asf": ASF, "02/02_01.amc": AMC}), ignore))
    # The small skeleton of the test lacks joints that CMU's has; the other folder has no skeleton at all.
    assert "lacks" in str(motions["01/01_01.amc"])
    assert "no" in str(motions["02/02_01.amc"])
    assert ".asf" in str(motions["02/02_01.amc"])


def clip(name: str, subject: str) -> Clip:
    return Clip(name, "", "", subject, "", 30, CANONICAL, np.zeros((1, 22, 3)))


def test_the_splits_are_those_of_the_data_sets() -> None:
    split = {s.name: s.split for s in DATA_SETS}
    assert split["UI-PRMD (Vicon)"](clip("m01_s06_e01", "s06")) == "train"
    assert split["UI-PRMD (Vicon)"](clip("m01_s07_e01", "s07")) == "val"
    assert {split["CMU (AMC)"](clip(name, "02")) for name in ("02_01", "02_05", "02_10")} == {"val"}
    assert split["CMU (AMC)"](clip("01_05", "01")) == "train"
    assert {split["CMU (expmap)"](clip(f"{kind}_walking_2", "unknown")) for kind in ("train", "test")} == {"train"}
    kinds = ("salsa", "martial", "indian")
    assert [split["CMU (dance)"](clip(f"{kind}_01", kind)) for kind in kinds] == ["train", "test", "test"]
    assert split["CMU (BVH)"](clip("006_12", "06")) == "train"
    assert split["ReActIdle"](clip("014_acted", "014")) == "val"
    assert split["CMU (more)"](clip("13_29", "13")) == "train"
    dancers = ("Andria", "Elena", "Anna", "Olivia", "Theodora")
    assert [split["DanceDB"](clip("x", name)) for name in dancers] == ["val", "val", "test", "test", "test"]
    assert [split["LAFAN1"](clip("x", f"subject{k}")) for k in (1, 2, 3, 4)] == ["val", "test", "test", "test"]
    own = ("me/1.bvh", "val/me/1.bvh", "test/you/1.bvh")
    assert [split["own"](clip(name, "")) for name in own] == ["train", "val", "test"]
    # Whoever validates is not trained on under another name: of what subject 02 did, the AMC recordings are kept.
    assert all(kept.startswith("02_") for left_out, kept in REPEATS.items() if left_out.startswith("002_"))


def test_a_recording_that_is_there_twice_is_left_out_by_name(tmp_path: Path) -> None:
    bvh = next(s for s in DATA_SETS if s.name == "CMU (BVH)")
    read = list(bvh.read(unpack(tmp_path, {"006/006_07.bvh": idle_bvh(), "006/006_12.bvh": "x"}), ignore))
    assert [d.kind for d in read if isinstance(d, Dropped)] == ["repeats another", "cannot be read"]
    assert isinstance(read[0], Dropped)
    assert "test_basketball_1" in read[0].cause


def test_what_measures_has_nothing_to_train_on_whoever_moves() -> None:
    measures = [s for s in DATA_SETS if s.weights == "measure"]
    assert {s.name for s in measures} == {"DanceDB", "LAFAN1"}
    for source in measures:
        assert "train" not in {source.split(clip("train", subject)) for subject in ("", "train", "Anna", "subject5")}


def test_dancers_and_actors_are_told_from_the_names_of_files(tmp_path: Path) -> None:
    read = {s.name: s.read for s in DATA_SETS}
    [dance] = read["DanceDB"](unpack(tmp_path / "dancedb", {"Elena_Afraid_v2-BVH.bvh": idle_bvh()}), ignore)
    [fall] = read["LAFAN1"](unpack(tmp_path / "lafan1", {"fallAndGetUp2_subject3.bvh": idle_bvh()}), ignore)
    [walk] = read["CMU (more)"](unpack(tmp_path / "cmu_more", {"cmu_more/13/13_29.bvh": idle_bvh()}), ignore)
    assert isinstance(dance, Clip)
    assert isinstance(fall, Clip)
    assert isinstance(walk, Clip)
    assert (dance.name, dance.person, dance.action) == ("Elena_Afraid_v2", "DanceDB Elena", "afraid")
    assert (fall.person, fall.action) == ("LAFAN1 subject3", "fallAndGetUp")
    assert walk.person == "CMU 13"
    assert "research" in dance.licence


def test_takes_of_unknown_speed_and_repeats_are_left_out_of_more_of_cmu(tmp_path: Path) -> None:
    more = next(s for s in DATA_SETS if s.name == "CMU (more)")
    files = {"cmu_more/first2s/39_01_1.bvh": idle_bvh(), "cmu_more/10/10_04.bvh": idle_bvh()}
    read = list(more.read(unpack(tmp_path, files), ignore))
    assert [(d.name, d.kind) for d in read if isinstance(d, Dropped)] == [
        ("10_04", "repeats another"),
        ("cmu_more/first2s/39_01_1.bvh", "of unknown speed"),
    ]
