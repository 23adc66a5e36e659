import dataclasses
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.baselines.filters import Baseline, constant_velocity, gaussian_hampel, one_euro
from steadypose.benchmarks.bench import Tuned
from steadypose.benchmarks.studies.kinect_clips import SCORED, Clip, align, deviation, learn_offset, score, summary
from steadypose.benchmarks.studies.kinect_methods import best_without, run_filter

REST = np.array(
    [[0.0, 0.0, 1.6]]
    + [[x, sign * y, z] for x, y, z in ((0, 0.2, 1.4), (0.1, 0.25, 1.1), (0.3, 0.25, 1.0)) for sign in (1, -1)]
    + [[x, sign * y, z] for x, y, z in ((0, 0.1, 0.9), (0.1, 0.1, 0.5), (0, 0.1, 0.1)) for sign in (1, -1)]
)
OFFSET = np.random.default_rng(0).normal(0, 0.03, REST.shape)


def person(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Truth and what a sensor sees of it, from elsewhere, with joints that sit elsewhere in the body; (T, 13, 3)."""
    rng = np.random.default_rng(seed)
    body = REST + np.cumsum(rng.normal(0, 0.002, (frames, len(SCORED), 3)), axis=0)
    turns = Rotation.from_rotvec((np.linspace(0, 2, frames) + rng.uniform(0, 6))[:, None] * [0, 0, 1]).as_matrix()
    truth = np.einsum("tab,tjb->tja", turns, body)
    seen = np.einsum("tab,tjb->tja", turns, body - OFFSET)
    view = Rotation.random(rng=rng).as_matrix()
    return truth, seen @ view.T + rng.normal(size=3)


def clip(seed: int, frames: int) -> Clip:
    truth, seen = person(seed, frames)
    return Clip("m01_s07_e01", "s07", np.zeros((frames, 22, 3)), seen, truth, truth)


def test_a_constant_offset_in_the_body_is_learned_on_one_subject_and_taken_from_another() -> None:
    train, validation = [clip(s, 40) for s in range(4)], [clip(s, 40) for s in range(10, 14)]
    known, asked = [c.centres for c in train], [c.centres for c in validation]
    offset = learn_offset(known, align(known, [c.raw for c in train]))
    aligned = align(asked, [c.raw for c in validation])
    without = score(asked, aligned, np.zeros_like(offset))
    corrected = score(asked, aligned, offset)
    assert without.position.mean() > 0.03
    # The trunk's frame is that of the joints as seen, which an offset tilts a little.
    assert corrected.position.mean() < 0.2 * without.position.mean()
    assert corrected.joints.shape == (len(SCORED),)


def test_scores_do_not_depend_on_where_the_sensor_stands() -> None:
    here = clip(1, 30)
    offset = np.random.default_rng(2).normal(0, 0.02, OFFSET.shape)
    turn = Rotation.random(rng=np.random.default_rng(9)).as_matrix()
    truths = [here.centres]
    a, b = (score(truths, align(truths, [seen]), offset) for seen in (here.raw, here.raw @ turn.T + 2.0))
    np.testing.assert_allclose(a.position, b.position, atol=1e-12)
    np.testing.assert_allclose(a.acceleration, b.acceleration, atol=1e-12)
    np.testing.assert_allclose(a.variation, b.variation, atol=1e-12)


def test_lost_markers_are_left_out() -> None:
    here = clip(3, 30)
    truth = here.centres.copy()
    truth[5:9, 3] = np.nan
    result = score([truth], align([truth], [here.raw]), OFFSET)
    assert np.isfinite([result.position[0], result.acceleration[0], *result.joints]).all()


@pytest.mark.parametrize(
    "run",
    [
        partial(constant_velocity, delay=3, density=1.0),
        partial(one_euro, delay=0, min_cutoff_hz=1.0, beta=2.0),
        partial(gaussian_hampel, delay=3, sigma_s=0.05, threshold=3.0),
    ],
)
def test_clips_side_by_side_are_filtered_as_if_alone(run: partial) -> None:
    clips = [clip(0, 12), clip(1, 2), clip(2, 30)]
    together = run_filter(clips, run)
    for one, answer in zip(clips, together, strict=True):
        assert answer.shape == one.raw.shape
        np.testing.assert_allclose(answer, run_filter([one], run)[0], atol=1e-12)


def test_what_is_stated_is_held_against_the_error() -> None:
    rng = np.random.default_rng(5)
    sigma = rng.uniform(0.01, 0.1, (400, len(SCORED)))
    error = np.abs(rng.normal(0, 1, sigma.shape)) * sigma * np.sqrt(3)
    error[:5, 0] = np.nan
    honest = deviation(error, sigma, np.nanmean(error, axis=1), np.arange(400) < 4)
    expected = {"rank_correlation": 0.5, "auroc_off": 0.85, "auroc_worst_anomaly": 1.0, "found_by_stated": 1.0}
    assert honest == {**honest, **{key: pytest.approx(value, abs=0.15) for key, value in expected.items()}}
    assert honest["flagged_percent"] == 1.0
    tenfold = np.where(np.arange(400) < 40, 10.0, 1.0)[:, None]
    tenth = deviation(tenfold * error, tenfold * sigma, np.zeros(400), np.zeros(400, dtype=bool))
    assert tenth["auroc_worst"] == pytest.approx(1.0, abs=0.01)
    blind = deviation(error, rng.permuted(sigma), rng.normal(size=400), np.zeros(400, dtype=bool))
    assert blind["rank_correlation"] == pytest.approx(0.0, abs=0.1)
    assert blind["auroc_off"] == pytest.approx(0.5, abs=0.1)
    assert deviation(0.001 * error, sigma, error[:, 1], np.zeros(400, dtype=bool))["auroc_off"] is None


def test_a_filter_is_chosen_by_the_others_figures() -> None:
    baseline = Baseline("filter", lambda seen, _, delay: seen, None, {"density": (0.1, 10.0)})
    tried = [
        {"density": d, **{f"{s} position_mm": p for s, p in zip(("s01", "s02", "s03"), of, strict=True)},
         **{f"{s} acceleration_mm": 0.0 for s in ("s01", "s02", "s03")}, "position_mm": 0.0, "acceleration_mm": 0.0}
        for d, of in ((0.5, (1.0, 9.0, 9.0)), (5.0, (9.0, 4.0, 8.0)))
    ]  # fmt: skip
    found = Tuned({"density": 0.5}, tried)
    assert [best_without(s, found, baseline)["density"] for s in ("s01", "s02", "s03")] == [5.0, 0.5, 0.5]
    assert best_without("s01", Tuned({}, []), baseline) == {}


def test_what_moves_is_what_is_left_without_the_clips_own_constant_offset() -> None:
    still = [clip(s, 40) for s in range(3)]
    truths = [c.centres for c in still]
    scores = score(truths, align(truths, [c.raw for c in still]), np.zeros_like(OFFSET))
    assert scores.position.mean() > 0.03
    # the trunk's frame is that of the joints as seen, which an offset tilts a little
    assert scores.moving.mean() < 0.2 * scores.position.mean()
    np.testing.assert_array_equal(scores.moving, score(truths, align(truths, [c.raw for c in still]), OFFSET).moving)


def test_who_is_out_of_step_has_figures_and_is_in_no_mean() -> None:
    clips = [clip(s, 30)._replace(subject=who, name=f"m01_{who}_e01") for s, who in enumerate(("s01", "s02", "s03"))]
    truths = [c.centres for c in clips]
    scores = score(truths, align(truths, [c.raw for c in clips]), np.zeros_like(OFFSET))
    lagged = dataclasses.replace(scores, **{
        name: np.array([9.0, *getattr(scores, name)[1:]]) for name in ("position", "moving", "acceleration")
    })  # fmt: skip
    a, b = summary(clips, scores), summary(clips, lagged)
    assert b["groups"]["s01"] == {"position_mm": 9000.0, "moving_mm": 9000.0, "acceleration_mm": 9000.0}
    for name in ("position", "moving", "acceleration"):
        assert a[f"{name}_mm"] == b[f"{name}_mm"] == pytest.approx(1e3 * getattr(scores, name)[1:].mean(), abs=1e-2)
        assert a[f"{name}_ci_mm"] == b[f"{name}_ci_mm"]
    assert a["groups"]["done right"] == b["groups"]["done right"]
