"""The pipeline on arrays is what ``steadypose clean`` does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.conftest import walk

import steadypose
from steadypose.nodes.commands.cleaning import clean_recording
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.body.own_layouts import add_layouts

ROOT = Path(__file__).parents[2]
PROGRAMS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE | re.DOTALL)
FRAMES = 60


def walked() -> np.ndarray:
    """(T, 22, 3) metres, z up."""
    return np.array([frame.bodies[0].positions for frame in walk(FRAMES)])


def test_it_gives_what_the_command_writes(tmp_path: Path) -> None:
    joints = walked()
    joints[20:30, 21] = np.nan
    np.savez(tmp_path / "in.npz", positions=joints, skeleton="smpl22", fps=25.0)
    clean_recording(tmp_path / "in.npz", tmp_path / "out.npz", {"prior": {"delay": 2}, "trajectory": {}})
    given = steadypose.clean(joints, fps=25.0, delay=2)
    with np.load(tmp_path / "out.npz") as written:
        assert set(given) == set(written)
        for name in given:
            np.testing.assert_array_equal(given[name], written[name], err_msg=name)


def test_several_bodies() -> None:
    """As many as came, each as it is alone; one who is away for a while is not made up."""
    joints = np.stack([walked(), walked() + [3.0, 0.0, 0.0]], axis=1)
    joints[:30, 1] = np.nan
    given = steadypose.clean(joints, fps=30.0)
    assert given["body_id"].tolist() == [0, 1]
    assert given["positions"].shape == (FRAMES, 2, 22, 3)
    assert given["joint_anomaly"].shape == (FRAMES, 2, 22)
    np.testing.assert_array_equal(given["positions"][:, 0], steadypose.clean(joints[:, 0], fps=30.0)["positions"])
    assert np.isnan(given["positions"][:28, 1]).all()
    assert np.abs(given["positions"][-1, 1, :, 0] - joints[-1, 1, :, 0]).max() < 0.1


@pytest.mark.usefixtures("own_layouts")
def test_a_layout_of_ones_own(tmp_path: Path) -> None:
    """The canonical joints under other names, in another order: the same answer."""
    order = np.random.default_rng(0).permutation(22)
    names = [f"j{index}" for index in order]
    smpl = SKELETONS["smpl22"].joints
    add_layouts({"shuffled": {"joints": names, "canonical": {smpl[index]: f"j{index}" for index in order}}})
    given = steadypose.clean(walked()[:, order], fps=30.0, skeleton="shuffled")
    np.testing.assert_allclose(given["positions"], steadypose.clean(walked(), fps=30.0)["positions"], atol=1e-6)


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match="fps"):
        steadypose.clean(walked())
    with pytest.raises(ValueError, match=r"\(T, 17, 3\), or \(T, bodies, 17, 3\), for coco17"):
        steadypose.clean(walked(), fps=30, skeleton="coco17")
    with pytest.raises(AttributeError, match="cleanse"):
        steadypose.cleanse  # noqa: B018  # type: ignore[attr-defined]


def test_the_first_is_ten_lines() -> None:
    assert len([line for line in PROGRAMS[0].splitlines() if line.strip()]) <= 10
