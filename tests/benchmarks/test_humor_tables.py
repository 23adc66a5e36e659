from pathlib import Path

import numpy as np
import pytest
import torch
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips, simulated_clips
from steadypose.benchmarks.studies import humor
from steadypose.benchmarks.studies import humor_fits as fits
from steadypose.benchmarks.studies.humor import MVAE, SHIPS, VARIANTS
from steadypose.benchmarks.studies.humor_fits import Answer, load_labels, pictures, scores
from steadypose.prior.fit.observations import KeyPoints, SurfacePoints
from steadypose.prior.fit.solve import FitSettings


@pytest.fixture(scope="module")
def clips() -> MotionClips:
    return simulated_clips(20, 2, seed=0)


def test_the_truth_has_no_error_and_what_sinks_goes_through_the_floor(clips: MotionClips) -> None:
    truth, hidden = clips.positions, np.zeros(clips.positions.shape[:3], dtype=bool)
    load = load_labels(clips)
    exact = [Answer(truth[:, c], load[:, c].astype(float), 2.0) for c in range(2)]
    found = scores(exact, truth, hidden, load)
    assert found["all_mm"] == found["legs_mm"] == found["acceleration_error_m_s2"] == 0.0
    assert found["contact_accuracy"] == 1.0
    assert found["seconds"] == 2.0
    assert "hidden_mm" not in found
    sunk = [Answer(truth[:, c] - [0.0, 0.0, 0.5]) for c in range(2)]
    found = scores(sunk, truth, hidden | (truth[..., 2] < 0.9), load)
    assert found["all_mm"] == found["hidden_mm"] == pytest.approx(500.0)
    assert found["rooted_mm"] == 0.0
    assert found["penetration_percent"] > 90
    assert "contact_accuracy" not in found


def test_a_camera_sees_what_is_projected(clips: MotionClips) -> None:
    taken = pictures(clips, 0, np.random.default_rng(0))
    key_points, points, _ = taken.deep.observed
    assert isinstance(key_points, KeyPoints)
    assert isinstance(points, SurfacePoints)
    seen = key_points.pixels.numpy()
    expected = key_points.camera.project(torch.from_numpy(taken.truth).float()).numpy()
    off = np.linalg.norm(seen - expected, axis=-1)
    assert np.nanmedian(off) == pytest.approx(1.18 * fits.PIXELS, rel=0.2)
    assert np.isnan(off).mean() == pytest.approx(fits.MISSED, abs=0.05)
    middle = np.nanmean(points.points.numpy(), axis=1)
    assert np.linalg.norm(middle - taken.truth.mean(axis=1), axis=-1).max() < 0.4


@pytest.mark.timeout(900)  # minutes of fits, on a busy machine
def test_the_protocol_in_small(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(humor, "VARIANTS", {name: VARIANTS[name] for name in ("no contacts", MVAE)})
    short = FitSettings(root_steps=0, pose_steps=10, motion_steps=10)
    monkeypatch.setattr(humor, "FitSettings", lambda: short)
    monkeypatch.setattr(humor, "CAMERA", short)
    with Progress(disable=True) as progress:
        result = humor.run(Bench(quick=True, mocap=None, data=tmp_path / "nowhere.npz", progress=progress))
    assert [table.name for table in result.tables] == [
        "humor-futures", "humor-noisy", "humor-hidden", "humor-detector", "humor-depth",
    ]  # fmt: skip
    for table in result.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert any(row[0] in (SHIPS, "4 cm of noise: as it ships") for row in table.rows)
    noisy = {record["method"]: record for record in result.data["records"]["noisy"]}
    assert noisy[SHIPS]["all_mm"] < noisy["as observed"]["all_mm"]
    assert noisy["truth"]["all_mm"] == 0.0
