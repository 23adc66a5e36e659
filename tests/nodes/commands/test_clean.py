import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import START_NS, record, walk, walked, write_npz
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import clean_body, world_body

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JointState, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.cli import main
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.commands.complete import complete
from steadypose.nodes.commands.info import info
from steadypose.nodes.commands.output import unfinished
from steadypose.nodes.commands.small import plot, repair
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sinks.plot.figure import draw
from steadypose.nodes.sinks.plot.history import history_of_path
from steadypose.nodes.sinks.plot.video import seen_from
from steadypose.nodes.sources.npz import NpzError
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.skeleton import J

FRAMES = 25


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return dict(file)


def test_npz_to_npz(tmp_path: Path) -> None:
    clean(write_npz(tmp_path / "in.npz", walked(FRAMES)), tmp_path / "out.npz")
    out = load(tmp_path / "out.npz")
    assert {name: array.shape[1:] for name, array in out.items() if name != "joint_names"} == {
        "stamp_ns": (), "positions": (22, 3), "rotations": (22, 4), "state": (22,), "sigma": (22,), "anomaly": (),
        "joint_anomaly": (22,), "anomaly_flag": (), "contacts": (8,), "root_velocity": (3,), "world_positions": (22, 3),
    }  # fmt: skip
    assert {len(array) for array in out.values()} == {FRAMES, len(out["joint_names"])} == {FRAMES, 22}
    for name in ("positions", "rotations", "sigma", "contacts", "root_velocity", "world_positions"):
        assert np.isfinite(out[name]).all(), f"{name}: both ends have poses too"
    assert (out["state"] != JointState.UNKNOWN).all()
    np.testing.assert_array_equal(out["stamp_ns"], np.round(np.arange(FRAMES) * 1e9 / 30))
    np.testing.assert_allclose(np.linalg.norm(out["rotations"], axis=-1), 1.0, atol=1e-5)


def test_a_single_frame_is_counted_as_one_and_what_was_not_used_is_said(tmp_path: Path, capsys) -> None:
    source = write_npz(tmp_path / "in.npz", walked(1))
    clean(source, tmp_path / "out.npz")
    assert "out.npz: 1 frame, " in capsys.readouterr().err
    info(str(source))
    assert "1 frame," in capsys.readouterr().out
    far = walked(30)
    far[3, J["left_wrist"]] += 40.0
    far[20, J["left_wrist"]] += 1.0
    assert clean(write_npz(tmp_path / "far.npz", far), tmp_path / "near.npz") == 0
    assert "  not used as given: joints too far (1), joints refused (1)\n" in capsys.readouterr().err


def test_a_second_call_does_not_write_into_the_first_ones_folder(tmp_path: Path) -> None:
    out = tmp_path / "out.npz"
    with unfinished(out) as part:
        part.write_text("of the first")
        with pytest.raises(LaunchError, match="another steadypose is writing it"), unfinished(out):
            pass
    assert out.read_text() == "of the first"
    (tmp_path / ".out.npz.part").mkdir()
    (tmp_path / ".out.npz.part" / ".steadypose").touch()  # of a call that was killed
    with unfinished(out) as part:
        part.write_text("of the second")
    assert out.read_text() == "of the second"


def test_a_name_that_is_not_utf_8_is_recorded_and_drawn(tmp_path: Path, capsys) -> None:
    source = write_npz(tmp_path / os.fsdecode(b"f\xfcr.npz"), walked(FRAMES))
    clean(source, tmp_path / "out")
    info(str(tmp_path / "out"))
    assert r"source f\xfcr;" in capsys.readouterr().out
    plot(source, tmp_path / "out.png")
    assert (tmp_path / "out.png").exists()


def test_jittered_stamps_come_back_as_they_were(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    stamps = START_NS + np.cumsum(rng.integers(25_000_000, 42_000_000, FRAMES))
    clean(write_npz(tmp_path / "in.npz", walked(FRAMES), stamp_ns=stamps), tmp_path / "out.npz")
    out = load(tmp_path / "out.npz")
    np.testing.assert_array_equal(out["stamp_ns"], stamps)
    assert np.isfinite(out["positions"]).all()


def test_a_recording_and_its_npz_give_the_same_numbers(tmp_path: Path) -> None:
    frames = walk(FRAMES, bodies=2)
    record(tmp_path / "in", frames)
    clean(tmp_path / "in", tmp_path / "out")
    clean(tmp_path / "in", tmp_path / "out.npz")
    out = load(tmp_path / "out.npz")
    assert out["body_id"].tolist() == [0, 1]
    assert out["positions"].shape == (FRAMES, 2, 22, 3)
    with RecordingReader(tmp_path / "out") as reader:
        messages = list(reader)
    raws = [m.message for m in messages if m.topic == POSE_RAW]
    assert raws[:-1] == frames
    cleans = [m.message for m in messages if isinstance(m.message, PoseClean) and not m.message.end_of_stream]
    assert [m.topic for m in messages if m.topic in (POSE_CLEAN, POSE_WORLD)].count(POSE_CLEAN) == len(cleans) + 1
    # the first grid time is the first stamp, so there nothing is interpolated
    np.testing.assert_array_equal(out["positions"][0, 1], cleans[0].bodies[1].positions)


def test_settings_reach_the_stages(tmp_path: Path) -> None:
    source = write_npz(tmp_path / "in.npz", walked(FRAMES))
    clean(source, tmp_path / "a.npz")
    clean(source, tmp_path / "b.npz", settings=("person.enabled=false",))
    clean(source, tmp_path / "c.npz", delay=0)
    a, b, c = (load(tmp_path / f"{name}.npz")["positions"] for name in "abc")
    assert np.abs(a - b).max() > 1e-3
    assert np.abs(a - c).max() > 1e-3


@pytest.mark.parametrize(("arguments", "expected"), [
    ({"settings": ("refine.enabeld=false",)}, "did you mean 'refine.enabled'"),
    ({"settings": ("trajectory.contact=false",)}, "contacts"),
    ({"settings": ("delay",)}, "expected section.key=value"),
    ({"delay": 99}, "delay: expected 0 to 16"),
    ({"settings": ("smooth.weights=nothing",)}, "no weights 'nothing'"),
    ({"out": Path("in.npz")}, "another path"),
    ({"source": Path("broken.npz")}, "cannot be read as .npz"),
])  # fmt: skip
def test_what_cannot_be_done_is_said(tmp_path: Path, monkeypatch, arguments: dict, expected: str) -> None:
    monkeypatch.chdir(tmp_path)
    write_npz(Path("in.npz"), walked(FRAMES))
    Path("broken.npz").touch()
    asked: dict[str, Any] = {"source": Path("in.npz"), "out": Path("out.npz")} | arguments
    with pytest.raises((LaunchError, NpzError), match=expected):
        clean(**asked)
    assert not Path("out.npz").exists()


def outputs(stamp_ns: int, position: float, turn: Rotation, body: int = 0) -> tuple[PoseClean, PoseWorld]:
    positions = np.full((22, 3), position)
    rotations = np.tile(turn.as_quat(), (22, 1))
    state = np.full(22, JointState.SEEN if position < 0.5 else JointState.IMPUTED)
    same = {"id": body, "state": state}
    made = clean_body(positions, rotations=rotations, sigma=np.full(22, position), anomaly=position, **same)
    placed = world_body(positions, rotations, root_velocity=np.full(3, position), **same)
    return (
        PoseClean(stamp_ns, "camera", "test", Pose.identity(), True, 4, [made]),
        PoseWorld(stamp_ns, "world", "test", np.array([0.0, 0.0, 1.0, 0.0]), [placed]),
    )


def collect(*stamped: tuple[PoseClean, PoseWorld]) -> NpzCollector:
    return NpzCollector(("", message) for pair in stamped for message in pair)


@settings(max_examples=30)
@given(share=st.floats(-0.9, 1.9), seed=st.integers(0, 1000))
def test_between_two_grid_times_it_interpolates_and_beyond_them_the_body_moves_on(share: float, seed: int) -> None:
    turns = Rotation.random(2, rng=np.random.default_rng(seed))
    period = round(FRAME_NS)
    collector = collect(outputs(START_NS, 0.0, turns[0]), outputs(START_NS + period, 1.0, turns[1]))
    stamp = START_NS + round(share * period)
    out = collector.arrays(np.array([stamp]))
    exact = (stamp - START_NS) / period
    for name in ("positions", "world_positions"):
        np.testing.assert_allclose(out[name], exact, atol=1e-6)
    for name in ("root_velocity", "sigma", "anomaly"):
        np.testing.assert_allclose(out[name], min(max(exact, 0.0), 1.0), atol=1e-6)
    expected = turns[0] * Rotation.from_rotvec(exact * (turns[0].inv() * turns[1]).as_rotvec())
    got = Rotation.from_quat(out["rotations"][0, 5])
    assert (got * expected.inv()).magnitude() < 1e-3
    assert (out["state"][0] == (JointState.SEEN if exact <= 0.5 else JointState.IMPUTED)).all()


def test_a_gap_is_not_filled_and_a_body_that_comes_later_is_unknown_before() -> None:
    still, second = Rotation.identity(), 10**9
    end = START_NS + second
    collector = collect(outputs(START_NS, 0.0, still), outputs(end, 1.0, still), outputs(end, 0.75, still, 7))
    out = collector.arrays(START_NS + np.array([-second, -20_000_000, 20_000_000, second // 2, second]))
    assert out["body_id"].tolist() == [0, 7]
    np.testing.assert_array_equal(out["positions"][:, 0, 0, 0], [np.nan, 0.0, 0.0, np.nan, 1.0])
    np.testing.assert_array_equal(out["positions"][:, 1, 0, 0], [np.nan] * 4 + [0.75])
    assert out["state"][3, 0].tolist() == out["state"][0, 1].tolist() == [JointState.UNKNOWN] * 22
    assert not out["anomaly_flag"].any()
    nobody = NpzCollector().arrays(np.array([START_NS, START_NS + 1]))
    assert nobody["positions"].shape == (2, 22, 3), "still a row for each stamp"
    assert np.isnan(nobody["positions"]).all()
    assert "body_id" not in nobody


def test_of_a_damaged_recording_what_is_left_is_saved_and_what_is_lost_is_said(tmp_path: Path, capsys) -> None:
    damaged = record(tmp_path / "in", walk(60))
    file = next(damaged.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    assert repair(damaged, tmp_path / "out") == 1
    assert "bytes in 1 place\n" in capsys.readouterr().out
    with RecordingReader(tmp_path / "out") as recording:
        assert recording.complete
        assert 60 - 16 <= recording.count(POSE_RAW) < 60
    assert repair(tmp_path / "out", tmp_path / "again") == 0
    assert info(str(damaged)) == 0
    assert "steadypose repair" in capsys.readouterr().out
    assert clean(damaged, tmp_path / "out.npz") == 1
    assert (tmp_path / "out.npz").exists()


WRITTEN = 36
WRIST = J["left_wrist"]


@pytest.fixture(scope="module")
def cleaned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a walk of which the wrist is hidden for a while, cleaned into all three formats."""
    folder = tmp_path_factory.mktemp("cleaned")
    frames = walk(WRITTEN)
    for frame in frames[15:30]:
        frame.bodies[0].positions[WRIST] = np.nan
    record(folder / "in", frames)
    for out in ("walk", "walk.npz", "walk.csv"):
        assert main(["clean", str(folder / "in"), str(folder / out)]) == 0
    return folder


@pytest.mark.parametrize("name", ["walk.npz", "walk.csv"])
def test_as_an_input_it_has_the_observed_joints_in_the_world(cleaned: Path, name: str) -> None:
    with np.load(cleaned / "walk.npz") as file:
        out = dict(file)
    source = open_recording(cleaned / name)
    raws = [message for _, message in source if isinstance(message, PoseRaw)]
    assert len(source) == WRITTEN
    assert raws[0].skeleton == "smpl22"
    np.testing.assert_allclose(raws[0].sensor_pose.orientation, [0, 0, 0, 1])
    np.testing.assert_allclose([raw.stamp_ns for raw in raws], out["stamp_ns"], atol=500)
    observed = np.isin(out["state"], (JointState.SEEN, JointState.REFINED))
    assert not observed[20, WRIST]
    sure = np.array([raw.bodies[0].confidence for raw in raws])
    np.testing.assert_array_equal(sure, observed.astype(float))
    joints = np.array([raw.bodies[0].positions for raw in raws])
    np.testing.assert_allclose(joints[observed], out["world_positions"][observed], atol=1e-5)


@pytest.mark.parametrize("name", ["walk.npz", "walk.csv"])
def test_it_is_completed_where_it_was_imputed(cleaned: Path, name: str, tmp_path: Path) -> None:
    assert complete(cleaned / name, tmp_path / "whole.csv") == 0
    assert complete(cleaned / name, tmp_path / "whole.npz") == 0
    with np.load(tmp_path / "whole.npz") as whole, np.load(cleaned / "walk.npz") as out:
        assert (whole["state"][20] == JointState.IMPUTED)[WRIST]
        assert (whole["state"][5] == JointState.SEEN)[WRIST]
        seen = out["state"][5] != JointState.IMPUTED
        np.testing.assert_allclose(whole["positions"][5][seen], out["world_positions"][5][seen], atol=1e-3)
    assert len(open_recording(tmp_path / "whole.csv")) == WRITTEN


def test_arrays_without_what_was_observed_show_no_corrections(cleaned: Path) -> None:
    shown = {name: [ax.get_title("left") for ax in draw(history_of_path(cleaned / name)).axes if ax.axison]
             for name in ("walk", "walk.npz", "walk.csv")}  # fmt: skip
    corrections = "mean distance between raw and clean, cm"
    assert [corrections in titles for titles in shown.values()] == [True, False, False]


def test_info_says_what_is_in_it_and_tells_of_problems_anywhere_in_a_file(cleaned: Path, tmp_path: Path, capsys):
    assert main(["info", str(cleaned / "walk.npz")]) == 0
    printed = capsys.readouterr().out
    arrays = f"world_positions ({WRITTEN}, 22, 3) float32"
    for text in ("an output of clean, complete or fit", arrays, "skeleton smpl22", "imputed"):
        assert text in printed
    assert main(["info", str(cleaned / "walk.csv")]) == 0
    of_table = capsys.readouterr().out
    assert f"{WRITTEN} frames" in of_table
    assert re.search(r"\d+% of their joints observed", of_table)[0] in printed  # type: ignore[index]
    assert "100% of" not in printed
    millimetres = np.full((240, 22, 3), np.nan)
    millimetres[:60] = 1000 * walked(60)
    assert main(["info", str(write_npz(tmp_path / "in.npz", millimetres))]) == 0
    assert "millimetres, expected metres; divide by 1000" in capsys.readouterr().out


def test_several_bodies_have_a_row_each(tmp_path: Path) -> None:
    frames = walk(30, bodies=2)
    for frame in frames[:10]:
        del frame.bodies[1]
    record(tmp_path / "in", frames)
    assert main(["clean", str(tmp_path / "in"), str(tmp_path / "two.csv")]) == 0
    raws = [message for _, message in open_recording(tmp_path / "two.csv") if isinstance(message, PoseRaw)]
    assert [body.id for body in raws[-1].bodies] == [0, 1]
    assert [body.id for body in raws[0].bodies] == [0]


def test_a_view_has_up_above_and_the_bodys_left_on_the_viewers_right() -> None:
    view = seen_from(np.array([1.0, 0.0, 0.0]))  # in canonical axes the body's left is +y
    origin, up, left = np.array([[0.0, 0, 0], [0, 0, 1], [0, 1, 0]]) @ view
    assert up[1] > origin[1] + 0.9
    assert left[0] > origin[0] + 0.8
