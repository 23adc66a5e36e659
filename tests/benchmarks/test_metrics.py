import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks import scores
from steadypose.benchmarks.scores import interval, people_means, position_error, procrustes, ratio, sigma_ratio
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.training.data.recordings import trunk_frame


def walk(seed: int, frames: int = 12, joints: int = 5) -> np.ndarray:
    return np.cumsum(np.random.default_rng(seed).normal(0, 0.1, (frames, joints, 3)), axis=0)


def test_errors_against_loops() -> None:
    a, b = walk(1), walk(2)
    a[3, 1] = np.nan
    for t in range(len(a)):
        for j in range(a.shape[1]):
            expected = sum((a[t, j, i] - b[t, j, i]) ** 2 for i in range(3)) ** 0.5
            np.testing.assert_allclose(position_error(a, b)[t, j], expected)
    for t in range(1, len(a) - 1):
        for j in range(a.shape[1]):
            bend = [x[t + 1, j] - 2 * x[t, j] + x[t - 1, j] for x in (a, b)]
            np.testing.assert_allclose(scores.acceleration_error(a, b)[t - 1, j], np.linalg.norm(bend[0] - bend[1]))


def test_length_variation_of_a_known_bone_and_horizontal_speed_of_each_foot() -> None:
    positions = np.zeros((4, 3, 3))
    positions[:, 1, 0] = [0.9, 1.1, 0.9, 1.1]
    positions[:, 2, 1] = 0.5
    assert scores.length_variation(positions, [(0, 1)]) == pytest.approx(0.1)
    assert scores.length_variation(positions, [(0, 1), (0, 2)]) == pytest.approx(0.05)
    positions = np.zeros((4, 2, 3))
    positions[:, 0, 0] = [0.0, 0.01, 0.03, 0.03]
    positions[:, :, 2] = np.arange(4)[:, None]
    contact = np.array([[True, True], [True, False], [True, True], [False, True]])
    speed = scores.contact_speed(positions, contact, np.array([0.0, 0.1, 0.3, 0.4]))
    np.testing.assert_allclose(speed[:, 0], [0.1, 0.1, np.nan])
    np.testing.assert_allclose(speed[:, 1], [np.nan, np.nan, 0.0])


def test_rigid_alignment_is_scipys_leaves_out_what_is_missing_and_never_mirrors() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, 50, 3))
    rotation, translation = rigid_alignment(a, b)
    expected = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))[0].as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-9)
    np.testing.assert_allclose((a @ rotation.T + translation).mean(axis=0), b.mean(axis=0), atol=1e-9)
    moved = a.reshape(10, 5, 3) @ rotation.T + translation
    moved[0, 0] = np.nan
    for found, true in zip(rigid_alignment(a.reshape(10, 5, 3), moved), (rotation, translation), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)
    assert np.linalg.det(rigid_alignment(a, a * [1, 1, -1])[0]) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="at least 3 points"):
        rigid_alignment(a[:2], b[:2])


def test_trunk_frame_turns_with_the_body() -> None:
    corners = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0], [0.02, 0.2, 0.5], [0.02, -0.2, 0.5]])
    upright = trunk_frame(corners, range(4))
    np.testing.assert_allclose(upright[:, 1], [0.0, 1.0, 0.0], atol=1e-12)
    assert upright[2, 2] > 0.99
    rotation = Rotation.random(rng=np.random.default_rng(1)).as_matrix()
    np.testing.assert_allclose(trunk_frame(corners @ rotation.T + 3.0, range(4)), rotation @ upright, atol=1e-12)
    np.testing.assert_allclose(upright.T @ upright, np.eye(3), atol=1e-12)


def test_procrustes_undoes_turn_size_and_place_of_every_frame_but_no_mirror() -> None:
    truth = walk(3)
    turns = Rotation.random(len(truth), rng=np.random.default_rng(1)).as_matrix()
    seen = 1.7 * np.einsum("tab,tjb->tja", turns, truth) + np.arange(len(truth))[:, None, None]
    seen[2, 3] = np.nan
    np.testing.assert_allclose(procrustes(seen, truth), np.where(np.isnan(seen), np.nan, truth), atol=1e-9)
    mirrored = truth * [1.0, 1.0, -1.0]
    assert position_error(procrustes(mirrored, truth), truth).mean() > 0.01


def test_stated_and_found_deviations() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.01, 0.05, 20_000)
    error = np.linalg.norm(rng.normal(size=(20_000, 3)) * sigma[:, None], axis=1)
    assert sigma_ratio(error, sigma) == pytest.approx(1.0, rel=0.02)
    assert sigma_ratio(2 * error, sigma) == pytest.approx(2.0, rel=0.02)
    sigma[:100], error[100:200] = np.inf, np.nan
    bins = scores.reliability(error, sigma, bins=5)
    assert sum(count for *_, count in bins) == 19_800
    for stated, found, _ in bins:
        assert found == pytest.approx(stated, rel=0.05)
    assert [stated for stated, *_ in bins] == sorted(stated for stated, *_ in bins)


def test_every_person_counts_once_however_often_recorded() -> None:
    found = interval([1.0] * 90 + [4.0] * 3, ["much recorded"] * 90 + ["seldom"] * 3)
    assert (found.mean, found.people) == (pytest.approx(2.5), 2)
    own = np.random.default_rng(0).normal(size=8)
    people = np.array([f"p{k}" for k in range(8)])
    few, many = interval(own, people), interval(np.repeat(own, 50), np.repeat(people, 50))
    assert many == pytest.approx(few)
    # Eight people of spread 1: about 2 x 1.96 / sqrt(8), a little less by the bootstrap of so few.
    assert many.high - many.low == pytest.approx(2 * 1.96 * own.std() / np.sqrt(8), rel=0.1)


def test_the_interval_covers_the_mean_of_all_people() -> None:
    covered = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        own = rng.normal(size=20)
        clips = (own[:, None] + 0.3 * rng.normal(size=(20, 10))).ravel()
        found = interval(clips, np.repeat([f"p{k:02}" for k in range(20)], 10))
        covered += found.low <= 0.0 <= found.high
    assert 0.88 <= covered / 200 <= 0.98


def test_one_person_has_no_interval_and_nobody_no_mean() -> None:
    alone = interval([1.0, 3.0], ["a", "a"])
    assert (alone.mean, alone.people) == (2.0, 1)
    assert np.isnan([alone.low, alone.high]).all()
    nobody = interval([np.nan], ["a"])
    assert np.isnan(nobody.mean)
    assert nobody.people == 0
    np.testing.assert_array_equal(people_means([np.nan, 2.0, 4.0, np.nan], ["a", "b", "b", "b"]), [3.0])


def test_a_ratio_is_of_clips_that_both_methods_have_and_without_width_if_all_people_share_it() -> None:
    baseline = np.random.default_rng(0).uniform(1, 5, size=12)
    found = ratio(0.7 * baseline, baseline, ["a", "b", "c"] * 4)
    assert [found.mean, found.low, found.high] == pytest.approx([0.7] * 3)
    found = ratio([1.0, np.nan, 8.0], [2.0, 1.0, 2.0], ["a", "a", "b"])
    assert found.mean == pytest.approx(np.sqrt(0.5 * 4.0))
