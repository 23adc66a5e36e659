"""HuMoR's tables: scores of answers that are known, and the whole protocol in small."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.progress import Progress

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips, simulated_clips
from steadypose.benchmarks.studies import humor, humor_credit, humor_rollout
from steadypose.benchmarks.studies import humor_fits as fits
from steadypose.benchmarks.studies.humor import MVAE, SHIPS, VARIANTS
from steadypose.benchmarks.studies.humor_fits import Answer, load_labels, pictures, scores
from steadypose.prior.fit.humor_network import roll_out
from steadypose.prior.fit.observations import KeyPoints, SurfacePoints
from steadypose.prior.fit.solve import FitSettings, Start


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
    for module in (humor, fits):
        monkeypatch.setattr(module, "FitSettings", lambda: FitSettings(root_steps=0, pose_steps=10, motion_steps=10))
    with Progress(disable=True) as progress:
        result = humor.run(Bench(quick=True, mocap=None, data=tmp_path / "nowhere.npz", progress=progress))
    assert [table.name for table in result.tables] == [
        "humor-futures", "humor-noisy", "humor-hidden", "humor-detector", "humor-depth",
    ]  # fmt: skip
    for table in result.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)
        assert any(row[0] in (SHIPS, "4 cm of noise: as it ships") for row in table.rows)
    noisy = {record["method"]: record for record in result.data["records"]["noisy"]}
    assert noisy[SHIPS]["all_mm"] < noisy["as seen"]["all_mm"]
    assert noisy["truth"]["all_mm"] == 0.0


def test_what_a_fit_owes_to_the_model_is_paired_by_clip(tmp_path: Path, monkeypatch) -> None:
    def brief(settings: FitSettings) -> FitSettings:
        return replace(settings, root_steps=0, pose_steps=10, motion_steps=10)

    monkeypatch.setattr(humor_credit, "FitSettings", lambda **given: brief(FitSettings(**given)))
    monkeypatch.setattr(humor_credit, "VARIANTS", {name: brief(one) for name, one in humor_credit.VARIANTS.items()})
    monkeypatch.setattr(humor_credit, "SMOOTH", (4.0,))
    monkeypatch.setattr(humor_credit, "camera_settings", lambda: brief(fits.camera_settings()))
    some = (humor_credit.FULL, "no E_init", "no E_env")
    monkeypatch.setattr(humor_credit, "ROLLED", 1)
    monkeypatch.setattr(humor_credit, "TERMS", {name: humor_credit.TERMS[name] for name in some})
    with Progress(disable=True) as progress:
        result = humor_credit.run(Bench(quick=True, mocap=None, data=tmp_path / "nowhere.npz", progress=progress))
    records = result.data["records"]
    owed = {(record["condition"], record["method"]): record for record in records["credit"]}
    assert owed["4 cm of noise", humor_credit.AS_IT_SHIPS]["more_mm"][0] == 0.0
    for (condition, _), record in owed.items():
        more = np.subtract(record["clips_mm"], owed[condition, humor_credit.AS_IT_SHIPS]["clips_mm"])
        assert record["mm"][0] == pytest.approx(np.mean(record["clips_mm"]), abs=0.01)
        assert record["more_mm"][0] == pytest.approx(np.mean(more), abs=0.01)
    for condition in humor_credit.CONDITIONS:
        clean, ours = (owed[condition, name]["mm"][0] for name in (humor_credit.CLEANED, humor_credit.AS_IT_SHIPS))
        assert clean != ours
    assert [record["method"] for record in records["terms"]] == list(some)
    assert len({str(record["clips_mm"]) for record in records["terms"]}) == 3
    full, free = records["rolled"]
    assert full["more_mm"][0] == 0.0 != free["more_mm"][0]
    for table in result.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)


def test_what_is_rolled_out_follows_from_the_first_state_and_comes_nearer(clips: MotionClips) -> None:
    model, settings = fits.shipped(), FitSettings(root_steps=10, pose_steps=20)
    seen = fits.corrupted(clips.positions[:12], 0.02, 0.0, 0)
    starts = [Start.of_joints(seen[:, c], ground_known=True) for c in range(2)]
    observed = [fits.seen_joints(seen[:, c]) for c in range(2)]
    far, near = (
        humor_rollout.fit_rolled_out(model, starts, observed, settings, phases) for phases in ([(0, True)], [(1, True)])
    )
    for motion in (*far, *near):
        assert isinstance(motion.latents, torch.Tensor)
        rolled = roll_out(model, motion.states[0], motion.latents, motion.offsets)
        torch.testing.assert_close(rolled.states.joints, motion.states[1:].joints, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(rolled.contacts, motion.predicted[1], atol=1e-2, rtol=1e-3)
    truth = clips.positions[:12]
    for c in range(2):
        off = [np.linalg.norm(m[c].world_joints.numpy() - truth[:, c], axis=-1).mean() for m in (far, near)]
        assert off[1] < 0.5 * off[0]
