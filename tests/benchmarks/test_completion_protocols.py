from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.baselines import inbetween
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import as_set, simulated_clips
from steadypose.benchmarks.scores import npss, quaternion_distance
from steadypose.benchmarks.studies import completion, interpolation, interpolation_noise
from steadypose.benchmarks.studies.interpolation import BEFORE, Truth, measure, relate


@pytest.fixture(scope="module")
def truth() -> Truth:
    return Truth.of(simulated_clips(interpolation.FRAMES, 4, 0), 15)


def test_the_same_rotations_are_no_distance_apart_and_npss_is_how_much_power_has_to_move() -> None:
    q = Rotation.random(30, rng=np.random.default_rng(0)).as_quat().reshape(5, 6, 4)
    assert np.allclose(quaternion_distance(-q, q), 0.0)
    other = q.copy()
    other[2, 3] = Rotation.from_quat(q[2, 3]).inv().as_quat()
    found = quaternion_distance(other, q)
    nearer = min(np.linalg.norm(other[2, 3] - q[2, 3]), np.linalg.norm(other[2, 3] + q[2, 3]))
    assert np.allclose(found, np.array([0.0, 0.0, nearer, 0.0, 0.0]))
    t = np.arange(32) / 32
    slow, fast = (np.sin(2 * np.pi * k * t)[None, :, None] for k in (2, 5))
    assert npss(slow, slow) == 0.0
    assert npss(3.0 * slow, slow) == pytest.approx(0.0, abs=1e-9)  # of shares, not of power
    # half of the power from bin 2 to bin 5, the other half from bin 30 to 27: three bins each
    assert npss(fast, slow) == pytest.approx(0.5 * 3 + 0.5 * 3)
    both = np.concatenate([slow, 0.1 * slow], axis=2)
    assert npss(np.concatenate([slow, 0.1 * fast], axis=2), both) == pytest.approx(3.0 * 0.01 / 1.01)


def test_every_peer_leaves_what_is_known(truth: Truth) -> None:
    train = as_set(simulated_clips(90, 6, 1))
    for method in (inbetween.slerp_and_lerp, inbetween.cubic_spline, inbetween.NearestWindow(train)):
        rotations, root = method(truth.given, truth.rotations, truth.offsets)
        for known in (slice(0, BEFORE), slice(-1, None)):
            assert np.allclose(rotations[:, known], truth.rotations[:, known], atol=1e-5)
            assert np.allclose(root[:, known], truth.positions[:, known, 0], atol=1e-6)
    rotations, root = inbetween.zero_velocity(truth.given, truth.rotations, truth.offsets)
    assert np.allclose(root[:, BEFORE : BEFORE + 15], truth.positions[:, BEFORE - 1, None, 0])


def test_who_was_in_training_is_found_again() -> None:
    clips = simulated_clips(interpolation.FRAMES, 6, 3)
    truth = Truth.of(clips, 15)
    nearest = inbetween.NearestWindow(as_set(clips), step=1)
    rotations, root = nearest(truth.given, truth.rotations, truth.offsets)
    assert np.abs(rotations - truth.rotations).max() < 1e-4
    assert np.abs(root - truth.positions[:, :, 0]).max() < 1e-4
    given = clips.positions.swapaxes(0, 1)[:, :50].copy()
    hidden = [7, 8]
    given[:, :, hidden] = np.nan
    yaw = interpolation.heading(clips.rotations[0, :, 0])
    filled = inbetween.NearestPose(as_set(clips), 50, step=1)(given, yaw, hidden)
    assert np.abs(filled - clips.positions.swapaxes(0, 1)[:, :50]).max() < 1e-4


def test_the_truth_has_no_error_and_slerp_is_the_unit(truth: Truth) -> None:
    deviation = np.ones((22, 3))
    own = measure(truth, truth.rotations, truth.positions[:, :, 0], deviation)
    assert own["l2q"] == own["l2p"] == own["npss"] == own["position_mm"] == own["acceleration_mm"] == 0.0
    line = measure(truth, *inbetween.slerp_and_lerp(truth.given, truth.rotations, truth.offsets), deviation)
    records = [{"method": "truth", "gap": 15, **own}, {"method": "slerp and lerp", "gap": 15, **line}]
    relate(records)
    assert records[1]["l2q_of_line"] == records[1]["l2p_of_line"] == records[0]["acceleration_of_true"] == 1.0
    moved = measure(truth, truth.rotations, truth.positions[:, :, 0] + [0.03, 0.0, 0.04], deviation)
    assert moved["position_mm"] == pytest.approx(50.0)
    assert moved["local_mm"] == 0.0
    assert moved["l2p"] == pytest.approx(0.05 * np.sqrt(22), abs=1e-4)


def test_both_protocols_run_without_any_data(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(interpolation, "GAPS", (5, 15))
    monkeypatch.setattr(interpolation_noise, "GAPS", (15,))
    monkeypatch.setattr(completion, "HIDDEN", {"legs": completion.HIDDEN["legs"]})
    with Progress(disable=True) as progress:
        bench = Bench(quick=True, mocap=None, data=tmp_path / "nowhere.npz", progress=progress)
        between, parts = interpolation.run(bench), completion.run(bench)
    assert [table.name for table in between.tables] == ["interpolation", "interpolation-search", "interpolation-noise"]
    assert len(between.tables[0].rows) == 2 * 9
    assert [row[:2] for row in between.tables[1].rows[2:]] == [
        ["HM-VAE searched from there", "15"], ["HM-VAE searched from random latents", "15"]
    ]  # fmt: skip
    noisy = {(r["method"], r["away"]): r["hidden_mm"] for r in between.data["noisy"] if r["noise"] == "white, 1 cm"}
    for away in interpolation_noise.AWAY:
        assert noisy["complete", away] < 0.5 * noisy["complete, joints not smoothed first", away]
        assert noisy["whole-body bank, cubic spline", away] < 0.5 * noisy["cubic spline", away]
    assert {record["method"] for record in parts.data["records"]} >= {"complete", "HG-VAE's completion"}
    assert all(np.isfinite(record["hidden_mm"]) for record in parts.data["records"])


def test_a_cubic_motion_is_found_again_by_its_spline() -> None:
    t = np.linspace(-1.0, 1.0, 30)[:, None, None, None]
    truth = t**3 + np.arange(2 * 22 * 3).reshape(2, 22, 3) * t
    seen = truth.copy()
    seen[10:20, 1] = np.nan
    np.testing.assert_allclose(interpolation_noise.through(seen), truth, atol=1e-9)
