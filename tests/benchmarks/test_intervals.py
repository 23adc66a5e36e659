import numpy as np
import pytest

from steadypose.benchmarks.scores import interval, people_means, ratio


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


def test_a_person_without_a_value_is_left_out() -> None:
    np.testing.assert_array_equal(people_means([np.nan, 2.0, 4.0, np.nan], ["a", "b", "b", "b"]), [3.0])


def test_a_ratio_is_of_clips_that_both_methods_have_and_without_width_if_all_people_share_it() -> None:
    baseline = np.random.default_rng(0).uniform(1, 5, size=12)
    found = ratio(0.7 * baseline, baseline, ["a", "b", "c"] * 4)
    assert [found.mean, found.low, found.high] == pytest.approx([0.7] * 3)
    found = ratio([1.0, np.nan, 8.0], [2.0, 1.0, 2.0], ["a", "a", "b"])
    assert found.mean == pytest.approx(np.sqrt(0.5 * 4.0))
