"""The depth lifting benchmark: what is promised of it, on a few pictures, and that its figures mean something."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from steadypose.benchmarks.systems import depth_lifting
from steadypose.benchmarks.systems.depth_lifting import Args, Picture, main, measure, median, ours, pictures


@pytest.fixture(scope="module")
def at_three_metres() -> list[Picture]:
    return pictures(40, 3.0, seed=7)


def test_joints_are_within_three_centimetres_and_none_is_on_the_background(at_three_metres: list[Picture]) -> None:
    found = measure(at_three_metres, ours, noise=1.5)
    assert found["mean"] < 0.03
    assert found["root"] < 0.04
    assert found["on_background"] == 0
    assert found["seen_given"] > 0.95


def test_the_pictures_are_hard_enough(at_three_metres: list[Picture]) -> None:
    assert measure(at_three_metres, median, noise=1.5)["mean"] > 0.05
    hidden = np.mean([~picture.seen for picture in at_three_metres])
    assert 0.1 < hidden < 0.6


def test_a_lifter_that_knows_the_truth_has_no_error(at_three_metres: list[Picture]) -> None:
    truths = iter(at_three_metres)
    found = measure(at_three_metres, lambda *_: next(truths).truth, noise=0.0)
    assert [found["mean"], found["root"], found["on_background"]] == pytest.approx([0, 0, 0])
    behind = iter(at_three_metres)
    found = measure(at_three_metres, lambda *_: next(behind).truth + np.array([0.0, 0.0, 0.3]), noise=0.0)
    assert found["mean"] == pytest.approx(0.3)
    assert found["on_background"] == found["joints"]


def test_figures_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_lifting, "DISTANCES", (3.0,))
    monkeypatch.setattr(depth_lifting, "KEYPOINT_NOISE", (0.0,))
    main(Args(pictures=5, out=tmp_path))
    written = json.loads((tmp_path / "depth_lifting.json").read_text())
    assert [figures["lifter"] for figures in written["depth_lifting"]] == list(depth_lifting.LIFTERS)
    assert len(written["tables"][0]["rows"]) == 2
