from dataclasses import asdict, fields, is_dataclass, replace

import numpy as np

from steadypose.benchmarks import product
from steadypose.benchmarks.corruption import correlated, gaussian, sides_exchanged
from steadypose.benchmarks.motion import simulated_clips
from steadypose.benchmarks.studies.ablations import AS_IT_SHIPS, PARTS, PARTS_OF_THE_WORLD, _record, _table
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.settings import TrajectorySettings

REPLACED = {
    "without putting sides back",
    "without the whole-body experts",
    "without the share of white noise",
    "without denoising time-correlated noise",
    "without straight paths",
    "with paths low-passed at 2 Hz",
}


def test_each_row_changes_one_setting_and_every_stage_that_is_on_has_a_row() -> None:
    default = PriorSettings()
    changed = {name: _changed(default, part.settings) for name, part in PARTS.items()}
    assert {name for name, change in changed.items() if not change} == {AS_IT_SHIPS, *REPLACED}
    assert all(len(change) <= 1 for change in changed.values())
    stages = {f.name for f in fields(default) if is_dataclass(getattr(default, f.name))}
    switches = {f"{stage}.enabled" for stage in stages if getattr(getattr(default, stage), "enabled", False)}
    assert set.union(*changed.values()) == {"bias_sigma", "refine.enabled", *switches}
    changed = [_changed(TrajectorySettings(), settings) for settings in PARTS_OF_THE_WORLD.values()]
    assert changed == [set(), {"contacts"}, {"network"}, {"contacts", "network"}]


def test_what_has_no_setting_is_replaced_only_while_it_is_measured() -> None:
    clips, rng = simulated_clips(60, 1, seed=0), np.random.default_rng(0)
    seen = sides_exchanged(gaussian(correlated(clips.positions, 0.02, rng), 0.01, rng), rng)
    seen[:, :, :, 2] += 0.1 * np.sin(20.0 * clips.stamps_s)[:, None, None]  # the camera bounces

    def positions() -> np.ndarray:
        return product.run(PriorSettings(), seen, clips.stamps_s, 4).positions

    shipped = positions()
    for name in REPLACED:
        with PARTS[name].replaced():
            assert np.nanmax(np.abs(positions() - shipped)) > 1e-4
    np.testing.assert_array_equal(positions(), shipped)


def test_a_row_is_in_units_of_what_ships_and_every_person_counts_once() -> None:
    clips = replace(simulated_clips(30, 3, seed=0), person=np.array(["a", "a", "b"]))
    acceleration = np.full(3, 1e-3)
    records = [
        _record("2 cm", AS_IT_SHIPS, np.array([0.010, 0.020, 0.045]), acceleration),
        _record("2 cm", "without it", np.array([0.020, 0.040, 0.045]), acceleration),
    ]
    rows = _table("t", "title", "mm", records, {AS_IT_SHIPS: 2.0, "without it": 1.5}, clips).rows
    assert rows[0][1].startswith("30.0 (")
    assert rows[1][1].startswith("1.414 (1.000–2.000)")
    assert [row[2] for row in rows] == ["2.00", "-0.50"]


def _changed(default: PriorSettings | TrajectorySettings, settings: PriorSettings | TrajectorySettings) -> set[str]:
    a, b = _flat(asdict(default)), _flat(asdict(settings))
    return {name for name in a if a[name] != b[name]}


def _flat(settings: dict[str, object], above: str = "") -> dict[str, object]:
    found: dict[str, object] = {}
    for name, value in settings.items():
        found |= _flat(value, f"{above}{name}.") if isinstance(value, dict) else {above + name: value}
    return found
