from dataclasses import asdict, fields, is_dataclass, replace

import numpy as np

from steadypose.benchmarks.motion import simulated_clips
from steadypose.benchmarks.studies.ablations import AS_IT_SHIPS, PARTS, PARTS_OF_THE_WORLD, _record, _table
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.settings import TrajectorySettings


def test_each_row_changes_one_setting_and_every_stage_that_is_on_has_a_row() -> None:
    default = PriorSettings()
    changed = {name: _changed(default, settings) for name, settings in PARTS.items()}
    assert changed.pop(AS_IT_SHIPS) == set()
    assert all(len(change) == 1 for change in changed.values())
    stages = {f.name for f in fields(default) if is_dataclass(getattr(default, f.name))}
    switches = {f"{stage}.enabled" for stage in stages if getattr(getattr(default, stage), "enabled", False)}
    assert set.union(*changed.values()) == {"bias_sigma", "refine.enabled", *switches}


def test_the_worlds_switches_are_each_off_alone_and_both() -> None:
    changed = [_changed(TrajectorySettings(), settings) for settings in PARTS_OF_THE_WORLD.values()]
    assert changed == [set(), {"contacts"}, {"network"}, {"contacts", "network"}]


def test_a_row_has_each_source_and_a_mean_in_which_every_person_counts_once() -> None:
    clips = simulated_clips(30, 3, seed=0)
    clips = replace(clips, person=np.array(["a", "a", "b"]), data_set=np.array(["x", "x", "y"]))  # fmt: skip
    record = _record("2 cm", "as it ships", clips, np.array([0.010, 0.020, 0.045]), 0.002, 1.5)
    assert record["by_source_mm"] == {"x": 15.0, "y": 45.0}
    assert (record["mm"], record["people"]) == (30.0, 2)
    table = _table("t", "title", [record], "2 cm", clips)
    low, high = record["ci_mm"]
    assert low < 30.0 < high
    assert table.columns == ["", "x", "y", "mean over people", "acceleration error, mm/frame²", "ms a frame"]
    assert table.rows == [["as it ships", "15.0", "45.0", f"30.00 ({low:.1f}–{high:.1f})", "2.00", "1.50"]]
    alone = {**record, "ci_mm": [float("nan")] * 2}
    assert _table("t", "title", [alone], "2 cm", clips).rows[0][3] == "30.00"


def _changed(default: PriorSettings | TrajectorySettings, settings: PriorSettings | TrajectorySettings) -> set[str]:
    a, b = _flat(asdict(default)), _flat(asdict(settings))
    return {name for name in a if a[name] != b[name]}


def _flat(settings: dict[str, object], above: str = "") -> dict[str, object]:
    found: dict[str, object] = {}
    for name, value in settings.items():
        found |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return found
