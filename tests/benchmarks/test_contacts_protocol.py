from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.studies import contacts
from steadypose.prior.body.skeleton import J

NAMES = [f"{side}_{part}" for side in ("left", "right") for part in ("ankle", "heel", "toe")]


@pytest.fixture
def plates(tmp_path: Path) -> Path:
    """4 s at 100 Hz: the left foot stands throughout, the right one from second 2 on."""
    count = 400
    feet = np.zeros((count, 6, 3))
    feet[:, :, 2] = [0.1, 0.05, 0.06] * 2
    feet[:, [2, 5], 0] = 0.15
    feet[:, 3:, 1] = -0.2
    lifted = np.arange(count) < 200
    feet[lifted, 3:, 2] += 0.2
    feet[lifted, 3:, 0] += 0.4 * np.sin(np.arange(200) / 10)[:, None]
    force = np.stack([np.full(count, 700.0), np.where(lifted, 0.0, 350.0)], axis=1)
    path = tmp_path / "contacts_grf.npz"
    np.savez(path, fps=100.0, names=np.array(NAMES), **{
        "Somebody/walking1/feet": feet.astype(np.float32),
        "Somebody/walking1/force": force.astype(np.float32),
        "Somebody/walking1/valid": np.ones((count, 2), dtype=bool),
    })  # fmt: skip
    return path


def test_streams_are_read_at_30_hz_on_the_floor(plates: Path) -> None:
    trials = contacts.read_trials(plates)
    assert len(trials) == contacts.PHASES
    for trial in trials:
        assert trial.kind == "walking"
        assert len(trial.joints) == pytest.approx(120, abs=2)
        np.testing.assert_allclose(trial.joints[:, J["left_ankle"], 2], 0.07, atol=1e-6)
        np.testing.assert_allclose(trial.joints[-1, J["right_foot"], 2], 0.015, atol=1e-6)
        assert trial.loaded[:, 0].all()
        assert trial.loaded[:, 1].mean() == pytest.approx(0.5, abs=0.02)
        assert np.isnan(trial.joints[:, J["pelvis"]]).all()


def test_all_methods_are_scored(plates: Path) -> None:
    bench = Bench(quick=True, mocap=plates.parent, data=Path("nowhere.npz"), progress=Progress(disable=True))
    result = contacts.run(bench)
    found = {(r["method"], r["noise_m"]): r["walking"]["f1"] for r in result.data["records"]}
    assert len(found) == 3 * len(contacts.NOISES)
    assert found["network", 0.0] > 0.9
    assert len(result.tables[0].rows) == len(found)
