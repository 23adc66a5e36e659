import re
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.conftest import record, walk, walked, write_npz

from steadypose.msgs.types import JointState, PoseRaw
from steadypose.nodes.cli import main
from steadypose.nodes.commands.complete import complete
from steadypose.nodes.sinks.plot.figure import draw
from steadypose.nodes.sinks.plot.history import history_of_path
from steadypose.nodes.sinks.plot.video import seen_from
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.skeleton import J

FRAMES = 36
WRIST = J["left_wrist"]


@pytest.fixture(scope="module")
def cleaned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a walk of which the wrist is hidden for a while, cleaned into all three formats."""
    folder = tmp_path_factory.mktemp("cleaned")
    frames = walk(FRAMES)
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
    assert len(source) == FRAMES
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
    assert len(open_recording(tmp_path / "whole.csv")) == FRAMES


def test_arrays_without_what_was_observed_show_no_corrections(cleaned: Path) -> None:
    shown = {name: [ax.get_title("left") for ax in draw(history_of_path(cleaned / name)).axes if ax.axison]
             for name in ("walk", "walk.npz", "walk.csv")}  # fmt: skip
    corrections = "mean distance between raw and clean, cm"
    assert [corrections in titles for titles in shown.values()] == [True, False, False]


def test_info_says_what_is_in_it_and_tells_of_problems_anywhere_in_a_file(cleaned: Path, tmp_path: Path, capsys):
    assert main(["info", str(cleaned / "walk.npz")]) == 0
    told = capsys.readouterr().out
    arrays = f"world_positions ({FRAMES}, 22, 3) float32"
    for said in ("an output of clean, complete or fit", arrays, "skeleton smpl22", "imputed"):
        assert said in told
    assert main(["info", str(cleaned / "walk.csv")]) == 0
    of_table = capsys.readouterr().out
    assert f"{FRAMES} frames" in of_table
    assert re.search(r"\d+% of their joints observed", of_table)[0] in told  # type: ignore[index]
    assert "100% of" not in told
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
