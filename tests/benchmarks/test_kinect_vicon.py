from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from rich.progress import Progress
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from steadypose.benchmarks.baselines.filters import Baseline, constant_velocity, gaussian_hampel, one_euro
from steadypose.benchmarks.bench import Bench, Tuned
from steadypose.benchmarks.studies import kinect_methods
from steadypose.benchmarks.studies.kinect_methods import SCORED, Clip, Kinect, align, deviation, run_filter, score
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import J
from steadypose.training.data.readers import KinectPair
from steadypose.training.loop import TrainingOptions

REST = np.array(
    [[0.0, 0.0, 1.6]]
    + [[x, sign * y, z] for x, y, z in ((0, 0.2, 1.4), (0.1, 0.25, 1.1), (0.3, 0.25, 1.0)) for sign in (1, -1)]
    + [[x, sign * y, z] for x, y, z in ((0, 0.1, 0.9), (0.1, 0.1, 0.5), (0, 0.1, 0.1)) for sign in (1, -1)]
)
KALMAN = "Kalman, constant velocity"
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
    return Clip("m01_s07_e01", "s07", np.zeros((frames, 22, 3)), seen, truth)


def test_a_constant_offset_in_the_body_is_learned_on_one_subject_and_taken_from_another() -> None:
    train, validation = [clip(s, 40) for s in range(4)], [clip(s, 40) for s in range(10, 14)]
    known, asked = [c.centres for c in train], [c.centres for c in validation]
    offset = kinect_methods.learn_offset(known, align(known, [c.raw for c in train]))
    aligned = align(asked, [c.raw for c in validation])
    without = score(asked, aligned, np.zeros_like(offset))
    corrected = score(asked, aligned, offset)
    assert without.position.mean() > 0.03
    # The trunk's frame is that of the joints as seen, which an offset tilts a little.
    assert corrected.position.mean() < 0.2 * without.position.mean()
    # without the clip's own constant offset, what moves is as little, whatever offset was learned
    assert without.moving.mean() < 0.2 * without.position.mean()
    np.testing.assert_array_equal(without.moving, corrected.moving)


def test_scores_do_not_depend_on_where_the_sensor_stands_and_lost_markers_are_left_out() -> None:
    here = clip(1, 30)
    here.centres[5:9, 3] = np.nan
    offset = np.random.default_rng(2).normal(0, 0.02, OFFSET.shape)
    turn = Rotation.random(rng=np.random.default_rng(9)).as_matrix()
    truths = [here.centres]
    a, b = (score(truths, align(truths, [seen]), offset) for seen in (here.raw, here.raw @ turn.T + 2.0))
    for name in ("position", "acceleration", "variation"):
        assert np.isfinite(getattr(a, name)).all()
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)


@pytest.mark.parametrize("run", [
    partial(constant_velocity, delay=3, density=1.0),
    partial(one_euro, delay=0, min_cutoff_hz=1.0, beta=2.0),
    partial(gaussian_hampel, delay=3, sigma_s=0.05, threshold=3.0),
])  # fmt: skip
def test_clips_side_by_side_are_filtered_as_if_alone(run: partial) -> None:
    clips = [clip(0, 12), clip(1, 2), clip(2, 30)]
    together, _ = run_filter(clips, run)
    for one, answer in zip(clips, together, strict=True):
        assert answer.shape == one.raw.shape
        np.testing.assert_allclose(answer, run_filter([one], run)[0][0], atol=1e-12)


def chance_of_order(wrong: np.ndarray, stated: np.ndarray) -> float:
    """The chance that what is wrong is stated to be more so than what is not: the area under a ROC curve."""
    return round(float((stated[wrong][:, None] > stated[~wrong]).mean()), 3)


def test_what_is_stated_is_held_against_the_error() -> None:
    rng = np.random.default_rng(5)
    sigma = rng.uniform(0.01, 0.1, (400, len(SCORED)))
    error = np.abs(rng.normal(0, 1, sigma.shape)) * sigma * np.sqrt(3)
    error[:5, 0] = np.nan
    honest = deviation(error, sigma, np.nanmean(error, axis=1), np.arange(400) < 4)
    expected = {"rank_correlation": 0.5, "auroc_off": 0.85, "auroc_worst_anomaly": 1.0, "found_by_stated": 1.0}
    assert honest == {**honest, **{key: pytest.approx(value, abs=0.15) for key, value in expected.items()}}
    assert honest["flagged_percent"] == 1.0
    known = np.isfinite(error)
    assert honest["off_percent"] == round(100 * float(np.mean(error[known] > 0.1)), 2)
    assert honest["rank_correlation"] == round(float(np.asarray(spearmanr(sigma[known], error[known]))[0]), 3)
    assert honest["auroc_off"] == chance_of_order(error[known] > 0.1, sigma[known])
    mean, spread = np.nanmean(error, axis=1), np.sqrt(np.nanmean(np.where(known, sigma, np.nan) ** 2, axis=1))
    assert honest["auroc_worst"] == chance_of_order(mean > np.quantile(mean, 0.9), spread)
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
    assert [kinect_methods.best_without(s, found, baseline)["density"] for s in ("s01", "s02", "s03")] == [
        5.0, 0.5, 0.5,
    ]  # fmt: skip
    assert kinect_methods.best_without("s01", Tuned({}, []), baseline) == {}


def test_a_filter_of_whole_bodies_gets_all_joints_and_its_scored_ones_are_kept() -> None:
    kinect = np.random.default_rng(0).normal(0, 0.4, (9, 22, 3))
    one = clip(0, 9)._replace(kinect=kinect)
    (answer,), _ = run_filter([one], lambda seen, stamps_s: seen + stamps_s[:, None, None, None], whole_body=True)
    expected = to_canonical(KINECT22, kinect)[0][:, [J[name] for name in SCORED]]
    np.testing.assert_allclose(answer, expected + (np.arange(9) / 30)[:, None, None])


def test_a_search_has_each_persons_figures_and_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    people = ("s07", "s08", "s08")
    clips = [clip(n, 20 + n)._replace(subject=who, name=f"{n}") for n, who in enumerate(people)]
    baseline = Baseline("filter", lambda seen, _, delay, by: seen + delay * by, None, {"by": (0.1, 10.0)})
    kinect = Kinect(cast(Bench, None), Path("nowhere.npz"), clips, clips)
    monkeypatch.setattr(kinect_methods, "tune", lambda bench, evaluate, *_: evaluate(baseline, 2, {"by": 0.5}))
    found: dict = kinect.tuned(clips)
    own = {who: [c for c in clips if c.subject == who] for who in ("s07", "s08")}
    for name in ("position_mm", "acceleration_mm"):
        each = [kinect_methods.quick_score(some, [c.raw + 1.0 for c in some])[name] for some in own.values()]
        assert [found[f"s07 {name}"], found[f"s08 {name}"]] == pytest.approx(each)
        assert found[name] == pytest.approx(np.mean(each), abs=1e-3)


def test_what_is_the_same_for_all_is_run_once_and_each_clip_gets_its_own() -> None:
    clips = [clip(n, 12)._replace(name=f"{n}") for n in range(3)]
    kinect, asked = Kinect(cast(Bench, None), Path("nowhere.npz"), clips, clips), []

    def run(some: Sequence[Clip], stated: bool) -> tuple[list[np.ndarray], list[kinect_methods.Stated] | None]:
        asked.append(len(some))
        told = [kinect_methods.Stated(one.raw[..., 0], one.raw[:, 0, 0], one.raw[:, 0, 0] > 0) for one in some]
        return [one.raw for one in some], told if stated else None

    for stated in (True, False, True):
        found, told = kinect._once(clips[2:0:-1], (stated,), partial(run, stated=stated))
        assert [answer is one.raw for answer, one in zip(found, clips[2:0:-1], strict=True)] == [True, True]
        assert (told is not None) == stated
        assert told is None or np.array_equal(told[0].sigma, clips[2].raw[..., 0])
    assert asked == [3, 3]


@pytest.mark.parametrize(("quick", "steps"), [(True, 40), (False, 4000)])
def test_a_correction_is_learned_of_the_others_once(quick: bool, steps: int, tmp_path: Path, monkeypatch) -> None:
    asked: list[tuple] = []

    def train(options: TrainingOptions, subjects: tuple[str, ...]) -> None:
        asked.append((options.data, options.iterations, subjects))
        (path := options.path("correction")).parent.mkdir(parents=True)
        path.touch()

    monkeypatch.setattr(kinect_methods, "ROOT", tmp_path)
    monkeypatch.setattr(kinect_methods, "train_correction", train)
    (data := tmp_path / "pairs.npz").touch()
    bench = Bench(quick=quick, mocap=None, data=data, progress=Progress(disable=True))
    clips = [clip(n, 12)._replace(subject=who) for n, who in enumerate(("s03", "s01", "s02", "s01"))]
    kinect = Kinect(bench, data, clips, clips)
    assert kinect.correction("s01").is_file()
    assert kinect.correction("s01") == kinect.correction("s01") != kinect.correction("s02")
    assert asked == [(data, steps, ("s03", "s02")), (data, steps, ("s03", "s01"))]


def test_every_nth_clip_of_each_person_is_read(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    pairs = [
        KinectPair(f"{who} {take}", who, "m01", 30.0, *rng.normal(size=(2, 5, 22, 3)))
        for who in ("s01", "s02") for take in range(5)
    ]  # fmt: skip
    monkeypatch.setattr(kinect_methods, "load_pairs", lambda path, who: [pair for pair in pairs if pair.subject in who])
    found = kinect_methods.read_clips(Path("pairs.npz"), ("s02", "s01"), 3)
    assert [one.name for one in found] == ["s02 0", "s02 3", "s01 0", "s01 3"]
    assert [one.subject for one in found] == ["s02", "s02", "s01", "s01"]
    pair, one, wrist = pairs[3], found[3], SCORED.index("left_wrist")
    np.testing.assert_array_equal(one.kinect, pair.kinect)
    np.testing.assert_array_equal(one.raw[:, wrist], to_canonical(KINECT22, pair.kinect)[0][:, J["left_wrist"]])
    np.testing.assert_array_equal(one.centres[:, wrist], pair.vicon[:, J["left_wrist"]])


def test_regressions_learn_and_run_on_clips_smoothed_for_their_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, regression = [], kinect_methods.kinect_regression
    monkeypatch.setattr(regression, "smoothed", lambda clips, scored, *given: asked.append(given) or [None])
    monkeypatch.setattr(regression, "ridge", lambda *_: lambda one: one)
    monkeypatch.setattr(regression, "temporal_convolution", lambda *given, seed: asked.append(given[3:]) or given[0])
    ridge, _ = kinect_methods.learners([clip(0, 12)], 8, 2.0, steps=7)
    ridge.run([clip(1, 12)])
    assert asked == [(8, 0, 2.0), (8, 4, 2.0), (4, 7), (8, 0, 2.0)]
