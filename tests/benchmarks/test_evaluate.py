from pathlib import Path
from types import SimpleNamespace
from typing import Literal, get_args

import pytest

from steadypose.benchmarks import results
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.evaluate import Name, evaluate
from steadypose.benchmarks.provenance import machine
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.studies import PREPARED, SENSORS, STUDIES
from steadypose.benchmarks.systems import SYSTEMS


def test_the_command_knows_every_protocol_and_asks_for_what_it_needs() -> None:
    assert set(get_args(Name)) == {"all", *STUDIES, *SYSTEMS}
    with pytest.raises(FileNotFoundError, match="mocap"):
        evaluate("kinect_vicon")


def test_all_is_every_protocol_in_turn_without_what_is_not_here(tmp_path: Path, capsys, monkeypatch) -> None:
    ran: list[Bench] = []
    study = SimpleNamespace(run=lambda bench: ran.append(bench) or Result([], {}))
    monkeypatch.setattr("importlib.import_module", lambda _: study)
    evaluate("all", quick=True, data=tmp_path / "nowhere.npz")
    assert len(ran) == len(STUDIES) - len(SENSORS) - len(PREPARED)
    assert len(set(map(id, ran))) == 1  # what is trained for one protocol serves the others
    assert "kinect_vicon: left out" in capsys.readouterr().out


def test_every_reading_of_the_test_split_is_logged_and_no_other(tmp_path: Path, monkeypatch) -> None:
    log, data = tmp_path / "results" / "test-readings.csv", tmp_path / "prepared.npz"
    monkeypatch.setattr(results, "READINGS", log)

    # scored in part, it has been read
    monkeypatch.setattr("importlib.import_module", lambda _: SimpleNamespace(run=lambda bench: 1 / 0))

    def read(study: str, split: Literal["val", "test"]) -> None:
        with pytest.raises(ZeroDivisionError):
            evaluate(study, split, quick=True, mocap=tmp_path, data=data)

    read("world", "test")  # simulated people, as there is no prepared motion
    data.touch()
    for name in ("ui_prmd.npz", "dancedb.tar.xz"):
        (tmp_path / name).touch()
    read("world", "val")
    read("kinect_vicon", "test")  # has no split
    assert not log.exists()
    read("world", "test")
    read("rotations", "test")  # has one, beside a sensor's recordings
    found = machine()
    assert log.read_text().splitlines() == [
        "date,commit,study,what followed",
        f"{found['date']},{found['commit']},world,",
        f"{found['date']},{found['commit']},rotations,",
    ]


def test_quick_writes_only_where_it_is_told(tmp_path: Path, capsys, monkeypatch) -> None:
    study = SimpleNamespace(
        __name__="steadypose.benchmarks.studies.completion",
        DEPENDS_ON=(),
        run=lambda bench: Result([], {}, wrong=["lost"]),
    )
    monkeypatch.setattr("importlib.import_module", lambda _: study)
    assert evaluate("completion", quick=True, data=tmp_path / "nowhere.npz") == 1, "what is wrong fails the command"
    evaluate("completion", quick=True, data=tmp_path / "nowhere.npz", out=tmp_path / "out")
    assert capsys.readouterr().out.count("wrote") == 1
    assert (tmp_path / "out" / "completion.json").is_file()
