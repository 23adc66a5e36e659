"""Too little data is said before a training starts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from steadypose.nodes.commands.train import little_data
from steadypose.nodes.graph.settings import LaunchError


def prepared(path: Path, *minutes: float, sets: tuple[str, ...] = ("default", "research")) -> Path:
    """A clip of so many minutes for each set, beside one to validate on."""
    frames = [*(round(1800 * m) for m in minutes), 100_000]
    split = [*("train" for _ in minutes), "val"]
    start = np.concatenate([[0], np.cumsum(frames)])
    np.savez(path, clip_start=start, split=np.array(split), set=np.array([*sets[: len(minutes)], "default"]))
    return path


def test_enough_is_not_spoken_of(tmp_path: Path) -> None:
    assert little_data(prepared(tmp_path / "a.npz", 31.0), "default") == ""
    np.savez(tmp_path / "other.npz", joints=np.zeros(3))
    assert little_data(tmp_path / "other.npz", "default") == ""
    assert little_data(tmp_path, "default") == ""


def test_little_is_said_and_next_to_nothing_refused(tmp_path: Path) -> None:
    path = prepared(tmp_path / "b.npz", 0.2, 12.0)
    assert "has 12.2 minutes of motion to train the 'research' weights on, which is little" in little_data(
        path, "research"
    )
    with pytest.raises(LaunchError, match=r"has 0\.2 minutes of motion .* expected 30 or more; prepare more"):
        little_data(path, "default")
