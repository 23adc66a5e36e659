from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.evaluate import evaluate as run
from steadypose.benchmarks.peers import window_vaes
from steadypose.benchmarks.protocols import PROTOCOLS, SENSORS
from steadypose.nodes.commands.evaluate import evaluate


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


def test_quick_writes_only_where_it_is_told(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(window_vaes, "CONFIGS", {8: window_vaes.CONFIGS[8]})  # windows of 64 frames take longer
    evaluate("reconstruction", quick=True, data=tmp_path / "nowhere.npz")
    evaluate("reconstruction", quick=True, data=tmp_path / "nowhere.npz", out=tmp_path / "out")
    assert capsys.readouterr().out.count("wrote") == 1
    assert (tmp_path / "out" / "reconstruction.json").is_file()
