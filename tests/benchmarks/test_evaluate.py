from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from steadypose.benchmarks import results
from steadypose.benchmarks.baselines import window_vaes
from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.command import evaluate
from steadypose.benchmarks.evaluate import evaluate as run
from steadypose.benchmarks.machine import describe
from steadypose.benchmarks.studies import PROTOCOLS, SENSORS


def test_the_command_knows_every_protocol_and_asks_for_what_it_needs() -> None:
    assert set(get_args(get_type_hints(evaluate)["protocol"])) == {"all", *PROTOCOLS}
    with pytest.raises(FileNotFoundError, match="mocap"):
        evaluate("kinect_vicon")


def test_all_is_every_protocol_in_turn_without_what_is_not_here(tmp_path: Path, capsys, monkeypatch) -> None:
    ran = []

    class Module:
        @staticmethod
        def run(bench: Bench) -> Result:
            ran.append(bench)
            return Result([], {})

    monkeypatch.setattr("importlib.import_module", lambda _: Module)
    run("all", split="val", quick=True, mocap=None, data=tmp_path / "nowhere.npz", out=None)
    assert len(ran) == len(PROTOCOLS) - len(SENSORS)
    assert len(set(map(id, ran))) == 1  # what is trained for one protocol serves the others
    assert "kinect_vicon: left out" in capsys.readouterr().out


def test_every_reading_of_the_test_split_is_logged_and_no_other(tmp_path: Path, monkeypatch) -> None:
    log, data = tmp_path / "results" / "test-readings.csv", tmp_path / "prepared.npz"
    monkeypatch.setattr(results, "READINGS", log)

    class Module:
        @staticmethod
        def run(bench: Bench) -> Result:
            raise ZeroDivisionError  # scored in part, it has been read

    monkeypatch.setattr("importlib.import_module", lambda _: Module)

    def read(study: str, split: str) -> None:
        with pytest.raises(ZeroDivisionError):
            run(study, split=split, quick=True, mocap=tmp_path, data=data, out=None)

    read("world", "test")  # simulated people, as there is no prepared motion
    data.touch()
    (tmp_path / "ui_prmd.npz").touch()
    read("world", "val")
    read("kinect_vicon", "test")  # has no split
    assert not log.exists()
    read("world", "test")
    read("fidelity", "test")
    machine = describe()
    assert log.read_text().splitlines() == [
        "date,commit,study,what followed",
        f"{machine['date']},{machine['commit']},world,",
        f"{machine['date']},{machine['commit']},fidelity,",
    ]


def test_quick_writes_only_where_it_is_told(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(window_vaes, "CONFIGS", {8: window_vaes.CONFIGS[8]})  # windows of 64 frames take longer
    evaluate("reconstruction", quick=True, data=tmp_path / "nowhere.npz")
    evaluate("reconstruction", quick=True, data=tmp_path / "nowhere.npz", out=tmp_path / "out")
    assert capsys.readouterr().out.count("wrote") == 1
    assert (tmp_path / "out" / "reconstruction.json").is_file()
