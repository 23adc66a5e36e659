"""Mistakes of somebody who uses the library or the command for the first time: each error says what to do."""

import sys
import warnings
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.nodes.conftest import walked, write_npz

import steadypose
from steadypose import Pose
from steadypose.nodes.cli import main
from steadypose.nodes.driving import OfflineRun
from steadypose.nodes.library.arrays import sections, source_of

FRAMES = 50
TICKS = np.arange(FRAMES) * 33_333_333


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    """(T, 22, 3) metres, z up: what is right."""
    return walked(FRAMES)


def seconds(count: int = FRAMES) -> np.ndarray:
    return 1_700_000_000 + np.arange(count) / 30


def with_none(joints: np.ndarray) -> Any:
    """Lists, in which the third joint is no three numbers."""
    return [[None if k == 3 else row.tolist() for k, row in enumerate(frame)] for frame in joints]


def frame_by_frame(joints: np.ndarray, times: np.ndarray) -> steadypose.Filter:
    cleaner = steadypose.Filter()
    for frame, t in zip(joints, times - times[0], strict=True):
        cleaner(frame, t)
    cleaner.flush()
    return cleaner


TWICE = Pose(np.zeros(3), np.array([0.0, 0, 0, 2]))
NO_TURN = Pose(np.zeros(3), np.zeros(4))
STAMPED = {"skeleton": "smpl22", "stamp_ns": TICKS}
TWO = np.arange(22)[:, None] < 2
Filter: Any = steadypose.Filter
clean: Any = steadypose.clean
plot: Any = steadypose.plot
REFUSED: dict[str, tuple[Callable[[np.ndarray], Any], str]] = {
    "coordinates before joints": (lambda j: clean(j.transpose(0, 2, 1), fps=30), r"positions\.transpose\(0, 2, 1\)"),
    "a row a frame": (lambda j: clean(j.reshape(FRAMES, -1), fps=30), r"positions\.reshape\(len\(positions\), 22, 3\)"),
    "a single frame": (lambda j: clean(j[0], fps=30), r"positions\[None\], or steadypose\.Filter"),
    "bodies before time": (
        lambda j: clean(np.stack([j, j]).transpose(1, 2, 0, 3), fps=30),
        r"bodies come after time: positions\.transpose\(0, 2, 1, 3\)",
    ),
    "a confidence as the fourth number": (
        lambda j: clean(np.dstack([j, np.ones((FRAMES, 22))]), fps=30),
        r"positions\[\.\.\., :3\], confidence=positions\[\.\.\., 3\]",
    ),
    "pixels": (lambda j: clean(j[..., :2], fps=30), "key points of an image: steadypose fit lifts them"),
    "33 joints, no skeleton": (lambda j: clean(np.zeros((FRAMES, 33, 3)), fps=30), "33 joints: skeleton 'blazepose33'"),
    "a skeleton by another name": (lambda j: clean(j[:, :17], fps=30, skeleton="COCO_17"), "did you mean 'coco17'"),
    "a skeleton by its tracker's name": (lambda j: Filter("MediaPipe"), "did you mean 'blazepose33'"),
    "Human3.6M by its own name": (lambda j: Filter("Human3.6M"), "did you mean 'h36m17'"),
    "OpenPose by its model's name": (lambda j: Filter("BODY_25"), "did you mean 'openpose25'"),
    "no skeleton": (lambda j: Filter(None), "name of a layout, or its joints, got None"),
    "a layout without joints": (lambda j: Filter({"joints": None}), "joints: expected a list of names, .*, got None"),
    "a seed below 0": (lambda j: steadypose.complete(j, fps=30, seed=-1), "seed: expected .* 0 or more, got -1"),
    "a skeleton that nobody knows": (lambda j: Filter(skeleton="thing"), "expected one of smpl22, coco17"),
    "no rate": (lambda j: clean(j), "of a regular stream give fps, 30 for instance"),
    "stamps in seconds": (lambda j: clean(j, stamp_ns=seconds()), r"seem to be seconds: np\.round\(stamps \* 1e\+09\)"),
    "in milliseconds": (lambda j: clean(j, stamp_ns=seconds() * 1e3), r"milliseconds: np\.round\(stamps \* 1e\+06\)"),
    "stamps that are dates": (
        lambda j: clean(j, stamp_ns=TICKS.astype("datetime64[ns]")),
        r"of dates: np\.asarray\(stamps, 'datetime64\[ns\]'\)\.astype\(np\.int64\)",
    ),
    "a stamp too many": (lambda j: clean(j, stamp_ns=np.arange(51) * 33_333_333), "a frame: 50 frames, 51 stamps"),
    "an axis that is none": (lambda j: clean(j, fps=30, up="Y"), "expected one of 'z', 'y', '-y', got 'Y'"),
    "frames of two lengths": (lambda j: clean([j[0].tolist(), j[1, :9].tolist()], fps=30), "NaN there, not fewer "),
    "None for a missing joint": (lambda j: clean(with_none(j), fps=30), "NaN"),
    "a file that does not exist": (lambda j: clean("nowhere.npz"), r"nowhere\.npz does not exist: expected"),
    "a file that does not exist, and its rate": (lambda j: clean("hello", fps=30), r"hello does not exist: expected"),
    "no such setting": (lambda j: clean(j, fps=30, settings={"prior": {"delya": 2}}), r"'delya' \(did you mean 'del"),
    "a section that there is not": (
        lambda j: Filter(settings={"prior.delay": 2}),
        r"expected sections 'prior', 'trajectory', 'events'.*got 'prior\.delay' \(did you mean 'prior'",
    ),
    "a rate and stamps": (lambda j: clean(j, fps=30, stamp_ns=TICKS), "or stamp_ns, got both; leave fps out"),
    "a rate beside stamps": (lambda j: clean({**STAMPED, "positions": j}, fps=60), "stamp_ns, got both; leave fps out"),
    "joints under another name": (lambda j: clean({"joints": j}, fps=30), "expected an array 'positions'"),
    "joints to draw that are not clean": (lambda j: plot(j), r"steadypose\.plot\(steadypose\.clean"),
    "a delay of seconds": (lambda j: clean(j, fps=30, delay=0.1), "expected int such as 4, got 0.1"),
    "a frame without its time": (lambda j: Filter()(j[0]), "t in seconds or as stamp_ns, got neither"),
    "two times of a frame": (lambda j: Filter()(j[0], 0.0, stamp_ns=0), "t in seconds or as stamp_ns, got both"),
    "nanoseconds as seconds": (lambda j: Filter()(j[0], 1.7e18), "say stamp_ns= of nanoseconds"),
    "many frames at once": (lambda j: Filter()(np.concatenate([j, j, j]), 0.0), r"got 150; .* into steadypose\.clean"),
    "seconds of numpy": (lambda j: Filter()(j[0], np.timedelta64(1, "s")), r"seconds, .* t / np\.timedelta64\(1, 's'"),
    "seconds as a timedelta": (lambda j: Filter()(j[0], timedelta(seconds=1)), "t: expected a number of seconds"),
    "nanoseconds of numpy": (lambda j: Filter()(j[0], stamp_ns=np.timedelta64(1, "ns")), "expected whole nanoseconds"),
    "true for seconds": (lambda j: Filter()(j[0], True), "t: expected a number of seconds, 0 or more, got True"),
    "seconds as text": (lambda j: Filter()(j[0], "0.1"), "t: expected a number of seconds, 0 or more, got '0.1'"),
    "seconds as nanoseconds": (lambda j: Filter()(j[0], stamp_ns=1.7e9 + 0.3), "got 1700000000.3; seconds are t"),
    "an unknown stamp": (lambda j: Filter()(j[0], stamp_ns=np.nan), "expected whole nanoseconds of .*, got nan"),
    "names for ids": (lambda j: Filter()(j[:1], 0.1, ids=["anna"]), "integers of 32 bits, one a body, got .'anna'."),
    "an id that is not in a list": (lambda j: Filter()(j[0], 0.1, ids=3), "one a body, got 3"),
    "an id of 64 bits": (lambda j: Filter()(j[0], 0.1, ids=[2**31]), r"of 32 bits, .*got .2147483648."),
    "confidence in words": (lambda j: Filter()(j[0], 0.1, confidence=["high"] * 22), r"\(1, 22\) numbers .*, got <U4"),
    "a quaternion of another length": (lambda j: Filter(sensor_pose=TWICE), "of norm 2; .* and a unit quaternion xyzw"),
    "one of a frame": (lambda j: Filter()(j[0], 0.0, sensor_pose=NO_TURN), "of norm 0; .* and a unit quaternion xyzw"),
    "a place for a pose": (lambda j: Filter(sensor_pose=(0.0, 0.0, 1.4)), r"sensor_pose: expected steadypose\.Pose"),
    "a number for a section": (lambda j: clean(j, fps=30, settings={"prior": 2}), "such .*; got prior = 2"),
    "an event's threshold that there is not": (
        lambda j: clean(j, fps=30, settings={"events": {"neer": 2.0}}),
        r"\[events\] has no setting 'neer' \(did you mean 'near'",
    ),
    "all frames at once": (lambda j: Filter()(j.transpose(0, 2, 1), 0.0), r"expected \(22, 3\) metres"),
}

WARNED: dict[str, tuple[Callable[[np.ndarray], Any], str]] = {
    "millimetres": (lambda j: clean(1000 * j, fps=30), "millimetres, expected metres; divide by 1000"),
    "milliseconds, frame by frame": (lambda j: frame_by_frame(j, 1e3 * seconds()), "converted as if they were seconds"),
    "shorter than the delay": (lambda j: clean(j[:4], fps=30), "lasts 0.10 s, less than the delay of 4 frames"),
    "of a map, frame by frame": (lambda j: frame_by_frame(j + [35.0, 0.0, 0.0], seconds()), "expected at most 30 m"),
    "a clock set back": (lambda j: clean(j, stamp_ns=TICKS + 500 * 10**9 * (TICKS < 10**9)), "go back by 500.0 s"),
    "nobody": (lambda j: clean(np.full((FRAMES, 2, 22, 3), np.nan), fps=30), "nobody: no frame has a body"),
    "nobody, frame by frame": (lambda j: frame_by_frame(np.empty((9, 0, 22, 3)), seconds()[:9]), "^nobody: "),
    "bodies of two joints": (lambda j: clean(np.where(TWO, j, np.nan), fps=30), "nobody_recognised: no body in any f"),
}


FILES = {
    "in.csv": "",
    "blank.csv": "\n",
    "numbers.csv": "0.0, 1.0, 2.0, 3.0\n",
    "hip.csv": "stamp,left_hip_x,left_hip_y,left_hip_z\n0,0,0,0\n",
    "mine.toml": "[input]\nrecording = 'walk_turn'\n[prior.gate]\njmup = 2",
    "in.bvh": "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\nEnd Site\n{\nOFFSET"
    " 0 1 0\n}\n}\nMOTION\nFrames: 2\nFrame Time: 0.03\n0 0 0\n0 0 0\n",
    "own.toml": "[skeletons.own]\njoints = ['left_hip', 'right_hip']\ncanonical = {left_wrist = 'HandL'}",
    "in.npy": "x", "in.png": "x", "in.txt": "x", "in.fbx": "x",
}  # fmt: skip
ANSWERED = {
    "clean nowhere.npz out.npz": "nowhere.npz does not exist: expected",
    "clean in.csv nowhere/out.npz": "to exist; make it first",
    "clean blank.csv out.npz": "blank.csv: has no rows: expected a header",
    "clean numbers.csv out.npz": "rename another program's columns to stamp, JOINT_x",
    "run mine.toml": "[prior.gate] has no setting 'jmup' (did you mean 'jump'?)",
    "clean in.npy out.npz": "in.npy: cannot be read",
    "clean in.png out.npz": "or a video, got '.png'",
    "clean in.fbx out.npz": "got '.fbx'; export its animation as .bvh",
    "plot in.txt": "in.txt: expected a rosbag2 directory, an .mcap",
    "clean hip.csv /proc/out.npz": "expected a folder that can be written to",
    "clean in.csv out.json": "expected .npz or .csv for arrays, or a name without ending for a recording",
    "clean in.csv out.vrma": "`steadypose export` makes .bvh, .glb, .vrma and .trc",
    "clean in.csv out.npz --skeletons own.toml": "left_wrist: expected names of joints, got ['HandL']",
    "clean in.csv out.npz --skeletons mine.toml": "mine.toml: expected sections [skeletons.NAME] with joints, got none",
    "export in.csv out.bvh": "clean it first: steadypose clean in.csv in.npz",
    "clean in.csv out.npz --events events.json": "events.json: expected a name ending in .csv",
    "clean . ../out --events ../events.csv": "--events: expected a single recording as IN",
    "clean walk_tern out.npz": "or a video (did you mean 'walk_turn'?)",
    "info in.bvh": "in.bvh: expected a body: legs and arms",  # a command without --rig
    "complete in.csv out.npz --samples -1": "--samples: expected 0 or more, got -1",
    "add webcam": "to add an extra: ",  # where steadypose is installed by pip
    "claen": "did you mean 'clean'?",
    "xyzzy": "there are run, node",
    "run nolaunch": "no launch file 'nolaunch'",
    "run --input nowhere": "does not exist",
    "run --set input.rat=3": "did you mean 'input.rate'",
    "node priro": "did you mean 'prior'",
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_what_cannot_be_used_is_refused_with_what_to_do(mistake: str, joints: np.ndarray) -> None:
    make, match = REFUSED[mistake]
    with pytest.raises(ValueError, match=match):
        make(joints)


@pytest.mark.parametrize("mistake", WARNED)
def test_what_can_be_used_is_warned_of_once(mistake: str, joints: np.ndarray) -> None:
    make, match = WARNED[mistake]
    with pytest.warns(steadypose.InputWarning, match=match) as caught:
        result = make(joints)
    assert {Path(warning.filename).name for warning in caught} == {Path(__file__).name}, "the program is to blame"
    assert sorted(str(warning.message) for warning in caught) == sorted(result.problems)


@pytest.mark.parametrize("command", ANSWERED)
def test_the_command_answers_with_what_to_do(command: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)
    assert main(command.split()) == 2
    out, printed = capsys.readouterr()
    assert ANSWERED[command] in printed
    assert not out
    assert "Traceback" not in printed


def test_what_is_right_is_not_warned_of(joints: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        poses = steadypose.clean(joints[:25].tolist(), fps=30)
        frame_by_frame(joints[:25], seconds()[:25])
    assert poses.problems == ()
    assert np.isfinite(poses.positions).all()


def test_confidences_below_what_the_gate_takes_are_named(joints: np.ndarray) -> None:
    confidence = np.full(joints.shape[:-1], 0.05)
    with pytest.warns(steadypose.InputWarning, match="confidence_low: confidence is 0.05 at most"):
        steadypose.clean(joints, fps=30, confidence=confidence)
    lower = {"prior": {"gate": {"min_confidence": 0.01}}}
    assert not steadypose.clean(joints, fps=30, confidence=confidence, settings=lower).problems


def test_without_torch_a_fit_says_what_to_install(joints: np.ndarray, monkeypatch) -> None:
    monkeypatch.setattr("steadypose.nodes.extras.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"torch, .* extra 'train'"):
        steadypose.fit(joints, fps=30)


@pytest.mark.parametrize("library", ["pandas", "xarray"])
def test_without_a_library_of_tables_its_form_says_what_to_install(library: str, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    poses = steadypose.Poses({}, (), {})
    with pytest.raises(ModuleNotFoundError, match=f"not installed: pip install {library}"):
        getattr(poses, f"to_{library}")()


@pytest.mark.parametrize(("command", "extra"), [
    ("export in.npz out.glb", "export"),
    ("retarget in.csv out.csv --urdf robot.urdf", "retarget"),
    ("fit in.csv out.npz", "train"),
    ("clean in.mp4 out.npz", "webcam"),
    ("run webcam", "webcam"),
    ("run replay --view", "view"),
    ("clean in out --ray", "ray"),
])  # fmt: skip
def test_a_missing_extra_is_said_once(command: str, extra: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("steadypose.nodes.extras.find_spec", lambda name: None)
    Path("in").mkdir()
    for name in ("in.csv", "in.mp4", "in.npz", "robot.urdf", "in/in.csv"):
        Path(name).touch()
    assert main(command.split()) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"steadypose {command.split()[0]}: needs ")
    assert f"the extra {extra!r}" in printed


@pytest.mark.slow
def test_a_recording_with_nobody_in_it_is_not_clean(tmp_path: Path, capsys) -> None:
    (tmp_path / "in").mkdir()
    write_npz(tmp_path / "in" / "empty.npz", np.full((60, 1, 22, 3), np.nan))
    assert main(["clean", str(tmp_path / "in" / "empty.npz"), str(tmp_path / "out.npz")]) == 1
    printed = capsys.readouterr().err
    assert "all_missing: " in printed
    assert "the output has no pose, because of the problems above" in printed
    assert "nobody_recognised" not in printed, "that all joints are missing says more"
    for _ in ("the first time", "done already"):
        assert main(["clean", str(tmp_path / "in"), str(tmp_path / "out"), "--jobs", "1"]) == 1
        assert "0 of 1 recordings are clean; 1 without anybody in it" in capsys.readouterr().err


@pytest.mark.parametrize(("factor", "order", "cause"), [(1000.0, (0, 1, 2), "unit: "), (1.0, (1, 2, 0), "up_axis: ")])
def test_what_cannot_be_trusted_has_status_1(factor: float, order: Any, cause: str, joints, tmp_path, capsys):
    write_npz(tmp_path / "in.npz", factor * joints[..., order])
    assert main(["clean", str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]) == 1
    printed = capsys.readouterr().err
    assert cause in printed
    assert ("the output cannot be trusted" in printed) != ("the output has no pose" in printed)
    assert (tmp_path / "out.npz").exists()


def test_who_lies_for_a_while_is_no_reason_to_distrust_a_recording(joints: np.ndarray) -> None:
    lying = joints[..., (1, 2, 0)]

    def run(*parts: np.ndarray) -> OfflineRun:
        run = OfflineRun(source_of(np.concatenate(parts), fps=30), sections(None, 4))
        run.arrays()
        return run

    fell = run(joints, joints, lying)
    assert list(fell.diagnosis.problems) == ["up_axis"]
    assert fell.diagnosis.trusted
    assert not run(lying, lying, lying, joints).diagnosis.trusted


def test_a_recording_most_of_whose_frames_give_no_pose_is_not_trusted(joints: np.ndarray) -> None:
    """Each frame is minutes from the next: all but the first and the last are taken for wrong stamps."""
    stamps = np.arange(FRAMES) * 300_500_000_000
    run = OfflineRun(source_of(joints, stamp_ns=stamps), sections(None, 4))
    run.arrays()
    assert not run.diagnosis.trusted
    assert run.diagnosis.problems["few_poses"].text.startswith(f"2 of {FRAMES} frames with a body gave a pose")


def test_a_misspelt_array_is_named(tmp_path: Path, joints: np.ndarray, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "in.npz", joints=joints, fps=30)
    assert main(["clean", str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]) == 2
    assert "got joints, fps; needed are positions" in capsys.readouterr().err
    np.savez(tmp_path / "up.npz", positions=joints, skeleton="smpl22", fps=30, upp="-y", scores=np.zeros(5))
    assert main(["clean", str(tmp_path / "up.npz"), str(tmp_path / "out.npz")]) == 2
    assert "expected an array 'up', or none of a similar name; it has 'upp'" in capsys.readouterr().err
