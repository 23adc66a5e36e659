"""The pipeline on arrays is what ``steadypose clean`` does, and its page runs as it is printed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.conftest import walk

import steadypose
from steadypose.nodes.commands.cleaning import clean_recording
from steadypose.prior.body.layouts import SKELETONS

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


def test_what_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match="fps"):
        steadypose.clean(walked())
    with pytest.raises(ValueError, match=r"\(T, 17, 3\) for coco17"):
        steadypose.clean(walked(), fps=30, skeleton="coco17")
    with pytest.raises(AttributeError, match="cleanse"):
        steadypose.cleanse  # noqa: B018  # type: ignore[attr-defined]


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_pages_programs_run(program: str, tmp_path: Path) -> None:
    joints = np.zeros((FRAMES, 17, 3))
    for index, name in enumerate(SKELETONS["coco17"].joints):
        found = [i for i, joint in enumerate(SKELETONS["smpl22"].joints) if joint == name]
        joints[:, index] = walked()[:, found[0] if found else 15]
    forward, left, up = np.moveaxis(joints, -1, 0)
    np.save(tmp_path / "walk.npy", np.stack([-left, -up, forward + 3.0], axis=-1))
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) >= 3


def test_the_first_is_ten_lines() -> None:
    assert len([line for line in PROGRAMS[0].splitlines() if line.strip()]) <= 10
