from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.progress import Progress

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import Baseline, raw
from steadypose.benchmarks.baselines.kalman import bank, whole_body_bank
from steadypose.benchmarks.bench import Answer, Bench, Methods
from steadypose.benchmarks.corruption import along_sight
from steadypose.benchmarks.motion import spread
from steadypose.benchmarks.studies import fidelity


def test_noise_is_three_times_as_large_along_the_line_of_sight() -> None:
    truth = np.tile(np.array([2.0, 1.0, -0.5]), (200, 10, 22, 1))
    noise = along_sight(truth, 0.01, np.random.default_rng(0)) - truth
    sight = truth[0, 0, 0] / np.linalg.norm(truth[0, 0, 0])
    along = noise @ sight
    across = noise - along[..., None] * sight
    assert along.std() == pytest.approx(0.03, rel=0.02)
    assert np.sqrt((across**2).sum(axis=-1).mean() / 2) == pytest.approx(0.01, rel=0.02)


def test_errors_are_sorted_by_the_speed_of_the_joint() -> None:
    frames = 60
    truth = np.zeros((frames, 1, 2, 3))
    truth[:, 0, 1, 0] = 3.0 * np.arange(frames) / 30
    answer = truth + np.array([[[0.0, 0.01, 0.0]], [[0.0, 0.04, 0.0]]]).reshape(1, 1, 2, 3)
    speed = np.linalg.norm(np.gradient(truth, 1 / 30, axis=0), axis=-1)
    found = fidelity._by_speed(
        Answer("m", 0, np.arange(frames) / 30, answer, {}, np.full(answer.shape[:-1], 0.01)), truth, speed
    )
    assert {name: b["position_mm"] for name, b in found["by_speed"].items()} == {
        "0-0.1 m/s": pytest.approx(10.0),
        "2-4 m/s": pytest.approx(40.0),
    }
    assert found["by_speed"]["2-4 m/s"]["found_by_stated"] == pytest.approx(4 / np.sqrt(3), abs=1e-3)


def test_clips_are_taken_evenly_from_people_as_far_as_these_go() -> None:
    people = np.array(["a"] * 50 + ["b"] * 3 + ["c"] * 20)
    taken = spread(people, 21)
    assert {s: int((people[taken] == s).sum()) for s in "abc"} == {"a": 9, "b": 3, "c": 9}
    assert (np.diff(taken) > 0).all()
    assert len(spread(people, 500)) == len(people)


def test_the_protocol_gives_tables_and_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    banks = Baseline("bank of smoothers", bank), Baseline("whole-body bank", whole_body_bank)
    baselines = (Baseline("raw", raw, (0,)), *banks, Baseline("half", lambda seen, _, delay: seen * 0.5))
    methods = Methods(baselines, {"steadypose": product.PRODUCT["steadypose"]}, (0, 4), networks=False)
    monkeypatch.setattr(fidelity, "methods", lambda _: methods)
    with Progress(disable=True) as progress:
        result = fidelity.run(Bench(quick=True, mocap=None, data=Path("nowhere.npz"), progress=progress))
    table = next(t for t in result.tables if t.name == "fidelity-speed-4")
    assert [row[0] for row in table.rows][:5] == [
        "none: raw", "none: best filter", "none: bank of smoothers", "none: whole-body bank", "none: steadypose",
    ]  # fmt: skip
    assert table.rows[0][1:] == ["0.0"] * (len(table.columns) - 1)
    sources = next(t for t in result.tables if t.name == "fidelity-sources-0")
    assert sources.columns[-2:] == ["mean over people", "of: whole-body bank"]
    ours_, bank_ = (
        next(row for row in sources.rows if row[0] == f"1 cm: {m}") for m in ("steadypose", "whole-body bank")
    )
    assert bank_[-1].startswith("1.00")
    assert float(ours_[-1].split()[0]) == pytest.approx(float(ours_[1]) / float(bank_[1]), abs=0.02)
    assert all(isinstance(figure, Figure) for figure in result.figures.values())
