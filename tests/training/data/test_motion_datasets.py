import io
import tarfile
from pathlib import Path

import numpy as np
import pytest
from tests.helpers.bvh_writer import write_bvh
from tests.helpers.motion_files import AMC, ASF
from tests.prior.body.test_rigs import FAMILIES
from tests.training.data.test_motion_plug_in_gait import BENDS, HIP, STILL, recording

from steadypose.prior.body.layouts import CANONICAL, KINECT22
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.mocap.bvh import CMU_BVH
from steadypose.prior.mocap.clip import Clip, MotionError, person_of
from steadypose.training.data.cmu import CMU_AMC
from steadypose.training.data.datasets import DATA_SETS, REPEATS
from steadypose.training.data.readers import Dropped, amc_motions, bvh_motion, load_pairs, members


def idle_bvh(frames: int = 60, fps: float = 24.0) -> str:
    """A body of ReActIdle's family that stands."""
    return write_bvh(FAMILIES["ReActIdle (Blender)"].joints(), np.array([0.0, 0.0, 0.9]), fps, frames).decode()


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
    left, right = (
        {joint: set(np.flatnonzero(rows[J[joint]])) for joint in JOINTS if joint.startswith(side)}
        for side in ("left", "right")
    )
    all_left, all_right = set().union(*left.values()), set().union(*right.values())
    for joint in left:
        other = joint.replace("left", "right")
        np.testing.assert_allclose(np.sort(rows[J[joint]]), np.sort(rows[J[other]]))
        assert left[joint] - all_right, f"{joint} has nothing of its own"
        assert right[other] - all_left, f"{other} has nothing of its own"
    # Four of a leg, three of an arm, and the collar where the family has one.
    assert len(all_left - all_right) == len(all_right - all_left) in (7, 8)


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


@pytest.mark.parametrize("first", [["5.0"], ["5.0", "0.5"]])
def test_a_rest_pose_put_in_front_and_the_way_out_of_it_are_left_out(first: list[str]) -> None:
    rows = idle_bvh(frames=40).splitlines()
    for row, place in enumerate(first, start=len(rows) - 40):
        rows[row] = rows[row].replace("0.000000", place, 1)
    bvh, skeleton, positions = bvh_motion("\n".join(rows))
    assert (bvh.fps, len(positions)) == (pytest.approx(24, rel=1e-4), 40 - len(first))
    assert skeleton.table["left_elbow"] == {"forearm.L": 1.0}


def test_a_bvh_without_a_body_says_what_was_looked_for() -> None:
    with pytest.raises(MotionError, match=r"legs and arms.*left and right.*'?pelvis.*--rig"):
        bvh_motion(idle_bvh().replace(".R", ".X"))


def test_an_amc_finds_its_skeleton_in_its_folder_whatever_the_order(tmp_path: Path) -> None:
    motions = dict(amc_motions(unpack(tmp_path, {"01/01_01.amc": AMC, "01/z.asf": ASF, "02/02_01.amc": AMC}), ignore))
    # The small skeleton of the test lacks joints that CMU's has; the other folder has no skeleton at all.
    assert "lacks" in str(motions["01/01_01.amc"])
    assert "expected an .asf file in the same folder" in str(motions["02/02_01.amc"])


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


def test_what_measures_has_nothing_to_train_on_whoever_moves() -> None:
    measures = [s for s in DATA_SETS if s.weights == "measure"]
    assert {s.name for s in measures} == {"DanceDB", "LAFAN1"}
    for source in measures:
        assert "train" not in {source.split(clip("train", subject)) for subject in ("", "train", "Anna", "subject5")}


def test_dancers_and_actors_are_told_from_the_names_of_files(tmp_path: Path) -> None:
    read = {s.name: s.read for s in DATA_SETS}
    for name, file, *told in (
        ("DanceDB", "Elena_Afraid_v2-BVH.bvh", "Elena_Afraid_v2", "DanceDB Elena", "afraid"),
        ("LAFAN1", "fallAndGetUp2_subject3.bvh", "fallAndGetUp2_subject3", "LAFAN1 subject3", "fallAndGetUp"),
        ("CMU (more)", "cmu_more/13/13_29.bvh", "13_29", "CMU 13", ""),
    ):
        [clip] = read[name](unpack(tmp_path / name, {file: idle_bvh()}), ignore)
        assert isinstance(clip, Clip)
        assert [clip.name, person_of(clip.source, clip.subject), clip.action] == told


@pytest.mark.parametrize(("name", "files", "expected"), [
    (
        "CMU (BVH)",
        {"006/006_07.bvh": idle_bvh(), "006/006_12.bvh": "x"},
        [("006_07", "repeats another"), ("006/006_12.bvh", "cannot be read")],
    ),
    (
        "CMU (more)",
        {"cmu_more/first2s/39_01_1.bvh": idle_bvh(), "cmu_more/10/10_04.bvh": idle_bvh()},
        [("10_04", "repeats another"), ("cmu_more/first2s/39_01_1.bvh", "of unknown speed")],
    ),
])  # fmt: skip
def test_repeats_and_takes_of_unknown_speed_are_left_out(tmp_path: Path, name: str, files: dict[str, str], expected):
    read = [part for s in DATA_SETS if s.name == name for part in s.read(unpack(tmp_path, files), ignore)]
    assert [(d.name, d.kind) for d in read if isinstance(d, Dropped)] == expected


MARKERS = recording(BENDS, STILL, np.zeros(3))


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    names = sorted(MARKERS)
    markers = np.stack([MARKERS[n] for n in names], axis=1)
    counts = np.round(markers * 1e4).astype(np.int16)
    counts[5, names.index("LWRA")] = -32768
    kinect = np.zeros((len(counts), 22, 3), dtype=np.int16)
    kinect[:, KINECT22.joints.index("Waist")] = [1000, 9000, -25000]  # y up, 2.5 m in front, looking along -z
    arrays = {}
    for name in ("m02_s01_e01", "m01_s01_e01_inc", "m01_s07_e01"):
        arrays[f"{name}/kinect"], arrays[f"{name}/vicon_markers"] = kinect, counts
    path = tmp_path / "ui_prmd.npz"
    np.savez(path, fps=30.0, vicon_names=np.array(names), kinect_names=np.array(KINECT22.joints), **arrays)
    return path


def test_pairs_are_metric_z_up_and_in_order(archive: Path) -> None:
    pairs = load_pairs(archive, ["s07", "s01"])
    assert [p.name for p in pairs] == ["m01_s01_e01_inc", "m02_s01_e01", "m01_s07_e01"]
    pair = pairs[1]
    assert (pair.subject, pair.movement, pair.fps) == ("s01", "m02", 30.0)
    np.testing.assert_allclose(pair.kinect[0, KINECT22.joints.index("Waist")], [0.1, 2.5, 0.9])
    np.testing.assert_allclose(pair.vicon[0, J["left_hip"]], HIP, atol=2e-4)
    lost = np.argwhere(np.isnan(pair.vicon).any(axis=-1))
    assert [(int(t), JOINTS[j]) for t, j in lost] == [(5, "left_wrist")]


def test_only_the_subjects_asked_for_are_read_and_another_npz_is_refused(archive: Path) -> None:
    assert {p.subject for p in load_pairs(archive, ["s07"])} == {"s07"}
    with pytest.raises(MotionError, match="no recordings of s09"):
        load_pairs(archive, ["s07", "s09"])
    np.savez(archive, a=1)
    with pytest.raises(MotionError, match="vicon_names"):
        load_pairs(archive, ["s01"])
