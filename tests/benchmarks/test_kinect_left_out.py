"""Nothing that is learned of a Kinect reaches the person who is left out, whoever learns and whoever that is.

What is learned is held against the same with other recordings of that person: not a bit may differ. And it must differ
with other recordings of somebody else, or nothing was learned.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from rich.progress import Progress
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from steadypose.benchmarks.baselines import filters
from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE, Baseline, gaussian_hampel, one_euro
from steadypose.benchmarks.bench import Bench, Tuned
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.scores import interval, position_error
from steadypose.benchmarks.studies import kinect_methods, kinect_vicon
from steadypose.benchmarks.studies.kinect_methods import KNOWN, SCORED, TCN, UNKNOWN, Clip, Kinect, align, deviation
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.settings import PriorSettings
from steadypose.training.data.readers import KinectPair
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes import sensor_bias
from steadypose.training.recipes.sensor_bias import SensorTake, leave_one_person_out

PEOPLE = ("s01", "s02", "s03")
FRAMES = 20
STANDING = np.random.default_rng(7).normal(0.0, 0.4, (22, 3))


def pair(subject: str, take: int, corrupted: str) -> KinectPair:
    """A clip of a body that sways, as both systems have it; another where the person is the one corrupted."""
    rng = np.random.default_rng((int(subject[1:]), take, subject == corrupted))
    sway = np.sin(np.linspace(0, 3, FRAMES)[:, None, None] + rng.uniform(0, 6, (22, 3)))
    kinect = STANDING + 0.1 * sway
    vicon = to_canonical(KINECT22, kinect)[0] + rng.normal(0, 0.05, (22, 3))
    return KinectPair(f"m01_{subject}_e{take:02}", subject, "m01", 30.0, kinect, vicon)


def clip(subject: str, take: int, corrupted: str) -> Clip:
    one = pair(subject, take, corrupted)
    scored = [J[name] for name in kinect_methods.SCORED]
    raw = to_canonical(KINECT22, one.kinect)[0][:, scored]
    truth = np.nan_to_num(one.vicon[:, scored])
    return Clip(one.name, subject, one.kinect, raw, truth)


def clips(corrupted: str) -> list[Clip]:
    return [clip(subject, take, corrupted) for subject in PEOPLE for take in range(2)]


def load_pairs(path: Path, subjects: Collection[str]) -> list[KinectPair]:
    return [pair(subject, take, path.stem) for subject in sorted(subjects) for take in range(2)]


def tuned(corrupted: str) -> dict[tuple[str, int], Tuned]:
    """A search of two points a filter, of which each person prefers one."""
    found = {}
    for baseline in FILTERS:
        tried = []
        for side in (0, 1):
            figures = {
                f"{who} {key}": float((n + (who == corrupted)) % 2 == side) * (1 + n)
                for n, who in enumerate(PEOPLE)
                for key in ("position_mm", "acceleration_mm")
            }
            tried.append({**{name: ends[side] for name, ends in baseline.space.items()}, **figures})
        for delay in (0, 4):
            found[baseline.name, delay] = Tuned(dict.fromkeys(baseline.space, 1.0), tried if baseline.space else [])
    return found


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(sensor_bias, "load_pairs", load_pairs)
    monkeypatch.setattr(kinect_methods, "ROOT", tmp_path)
    # a step or two show whom something is learned of
    monkeypatch.setattr(
        kinect_methods,
        "train_correction",
        lambda options, subjects: sensor_bias.train_correction(replace(options, iterations=2), subjects),
    )
    convolution = kinect_methods.kinect_regression.temporal_convolution
    monkeypatch.setattr(
        kinect_methods.kinect_regression,
        "temporal_convolution",
        lambda train, truths, mirror, ahead, steps, seed: convolution(train, truths, mirror, ahead, 2, seed),
    )
    made = Bench(quick=True, mocap=tmp_path, data=tmp_path / "none.npz", progress=Progress(disable=True))
    made.__dict__["smoothnets"] = []  # they learn from motion capture, and from no Kinect
    return made


def learned(bench: Bench, left_out: str, corrupted: str) -> dict[tuple[str, int], bytes]:
    """What each method has learned: its parameters, its answer to one clip, or the weights of its correction."""
    assert bench.mocap is not None
    data = bench.mocap / f"{corrupted}.npz"
    data.write_text(corrupted)
    asked = [clip("s09", 0, "")]
    kinect = Kinect(bench, data, [*clips(corrupted), *asked], clips(corrupted))
    found: dict[tuple[str, int], bytes] = {}
    for method in kinect.methods(left_out, tuned(corrupted)):
        if method.name == UNKNOWN:
            continue
        if method.name == KNOWN:
            found[method.name, method.delay] = kinect.correction(left_out).read_bytes()
            continue
        found[method.name, method.delay] = repr(method.parameters).encode() + method.run(asked)[0][0].tobytes()
    return found


@pytest.mark.parametrize("left_out", PEOPLE)
def test_no_left_out_person_reaches_what_is_learned(bench: Bench, left_out: str) -> None:
    plain, others = learned(bench, left_out, ""), learned(bench, left_out, left_out)
    assert {kinect_methods.RIDGE, TCN, KNOWN, *(baseline.name for baseline in FILTERS)} == {name for name, _ in plain}
    assert [key for key in plain if plain[key] != others[key]] == []
    taught = learned(bench, left_out, next(who for who in PEOPLE if who != left_out))
    assert [name for name in (kinect_methods.RIDGE, TCN, KNOWN) if plain[name, 4] == taught[name, 4]] == []


def test_each_clip_gets_its_own_frames_of_the_scored_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    some = [clip("s01", 0, ""), clip("s02", 0, "")]
    some[1] = some[1]._replace(kinect=some[1].kinect[:12])
    rng, frames = np.random.default_rng(0), (FRAMES, 2)
    made = SimpleNamespace(
        positions=rng.normal(size=(*frames, 22, 3)), sigma=rng.uniform(size=(*frames, 22)),
        anomaly=rng.uniform(size=frames), flagged=rng.uniform(size=frames) > 0.5,
    )  # fmt: skip
    monkeypatch.setattr(kinect_methods.product, "run", lambda *_: made)
    positions, stated = kinect_methods.run_ours(some, PriorSettings(), 4)
    scored = [J[name] for name in kinect_methods.SCORED]
    for number, (own, told, count) in enumerate(zip(positions, stated, (FRAMES, 12), strict=True)):
        np.testing.assert_array_equal(own, made.positions[:count, number, scored])
        np.testing.assert_array_equal(told.sigma, made.sigma[:count, number, scored])
        np.testing.assert_array_equal(told.anomaly, made.anomaly[:count, number])
        np.testing.assert_array_equal(told.flagged, made.flagged[:count, number])


def test_a_sensors_correction_is_judged_by_whom_it_was_not_learned_of(tmp_path: Path, monkeypatch) -> None:
    # what is missing is known where the sensor has one joint 8 cm off: a correction of half of it leaves half
    seen, off = to_canonical(KINECT22, pair("s01", 0, "").kinect)[0], np.zeros((22, 3))
    off[J["left_wrist"]] = [0.0, 0.0, 0.08]
    takes = [SensorTake(who, seen, np.array([3.0, 0.0, 1.0]), seen + off) for who in (*PEOPLE[::-1], *PEOPLE)]
    missing = sensor_bias._take(takes[0])[1]
    learned_of: list[list[str]] = []

    def train(takes: Sequence[SensorTake], options: TrainingOptions) -> Path:
        learned_of.append(sorted(take.person for take in takes))
        return options.path("correction")

    files: list[str] = []

    class Half:
        @staticmethod
        def load(path: str, rows: int) -> Callable[[np.ndarray], np.ndarray]:
            files.append(path)
            return lambda x: 0.5 * missing[-rows:]

    monkeypatch.setattr(sensor_bias, "LiveCorrection", Half)
    monkeypatch.setattr(sensor_bias, "train_sensor", train)
    share = 0.08 / np.isfinite(seen[0, :, 0]).sum()
    found = list(leave_one_person_out(takes, TrainingOptions(tmp_path, tmp_path, "mine")))
    assert tuple(held.person for held in found) == PEOPLE
    assert learned_of == [[who for who in PEOPLE for _ in range(2) if who != held.person] for held in found]
    assert len(set(files)) == len(PEOPLE), "each has weights of its own"
    for held in found:
        assert held.observed_m == pytest.approx(float(np.nanmean(np.linalg.norm(missing, axis=-1))), rel=1e-6)
        assert share < held.observed_m < 2 * share, "the fit spreads it over the others, which are moved against it"
        assert held.corrected_m == pytest.approx(0.5 * held.observed_m, rel=1e-6)


BEST = "Kalman, constant velocity"
SCALES = {
    ("raw", 0): 0.9, (BEST, 0): 0.85, (BEST, 4): 0.97, (BEST, OFFLINE): 1.0, ("One-Euro", 8): 1.0, (UNKNOWN, 4): 0.98,
    (KNOWN, 4): 1.02, (TCN, 4): 0.95,
}  # fmt: skip
"""What each method makes of its input: it is so many times as large."""


def everybody() -> list[Clip]:
    return [clip(subject, take, "") for subject in kinect_vicon.SUBJECTS for take in range(2)]


def stated(one: Clip) -> kinect_methods.Stated:
    shape = one.raw.shape[:2]
    sigma = np.random.default_rng(len(one.name)).uniform(0.01, 0.1, shape)
    return kinect_methods.Stated(sigma, np.linspace(0, 1, shape[0]), np.arange(shape[0]) < 3)


def left_out(scale: float) -> list[tuple[kinect_methods.Scores, np.ndarray]]:
    """Each person's scores and errors with the offset of a third of the others' clips."""
    found = []
    for who in kinect_vicon.SUBJECTS:
        asked = [one for one in everybody() if one.subject == who]
        others = [one for one in everybody() if one.subject != who][::3]
        (known, seen), (wanted, own) = (
            ([one.centres for one in some], [scale * one.raw for one in some]) for some in (others, asked)
        )
        offset, aligned = kinect_methods.learn_offset(known, align(known, seen)), align(wanted, own)
        errors = [position_error(kinect_methods.move(a, offset), t) for a, t in zip(aligned, wanted, strict=True)]
        found.append((kinect_methods.score(wanted, aligned, offset), np.concatenate(errors)))
    return found


@pytest.fixture
def result(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Result:
    asked: list[tuple[Any, ...]] = []

    def answer(
        some: Sequence[Clip], scale: float, states: bool
    ) -> tuple[list[np.ndarray], list[kinect_methods.Stated] | None]:
        return [scale * one.raw for one in some], [stated(one) for one in some] if states else None

    def methods(self: Kinect, who: str, tuned: object) -> Iterator[kinect_methods.Method]:
        for (name, delay), scale in SCALES.items():
            run = partial(answer, scale=scale, states=name in (UNKNOWN, KNOWN))
            yield kinect_methods.Method(name, delay, run, {"without": float(who[1:])})

    def read(path: Path, subjects: Sequence[str], every: int) -> list[Clip]:
        asked.append((path.name, tuple(subjects), every))
        return everybody()

    monkeypatch.setattr(kinect_vicon, "read_clips", read)
    monkeypatch.setattr(Kinect, "tuned", lambda self, on: asked.append(tuple(one.name for one in on)) or {})
    monkeypatch.setattr(Kinect, "methods", methods)
    found, people = kinect_vicon.run(replace(bench, quick=False)), kinect_vicon.SUBJECTS
    names = tuple(one.name for one in everybody())
    assert asked == [("ui_prmd.npz", people, 6), ("ui_prmd.npz", people, 3), names[::5]]
    return found


def test_each_persons_offset_is_learned_on_the_others_and_who_is_out_of_step_is_in_no_mean(result: Result) -> None:
    people = kinect_vicon.SUBJECTS
    records = {(record["method"], record["delay"]): record for record in result.data["records"]}
    assert records.keys() == SCALES.keys()
    for key, scale in SCALES.items():
        scores, record = [found for found, _ in left_out(scale)], records[key]
        for who, own in zip(people, scores, strict=True):
            assert record["people_mm"][who] == round(1e3 * own.position.mean(), 3)
            assert record["parameters"][who] == {"without": float(who[1:])}
        for name in ("position", "moving", "acceleration"):
            each = [getattr(own, name) for own in scores[1:]]
            assert record[f"{name}_mm"] == round(1e3 * np.concatenate(each).mean(), 3)
            means = [own.mean() for own in each]
            assert record[f"{name}_ci_mm"] == [round(1e3 * v, 3) for v in interval(means, people[1:])[1:3]]
        every = np.concatenate([own.variation for own in scores[1:]])
        assert record["bone_variation_percent"] == round(100 * every.mean(), 3)
    assert "s01" in result.tables[0].note
    assert result.data["data"]["clips"] == result.data["data"]["learning_clips"] == 2 * len(people)
    rows, raw = {(row[0], row[1]): row for row in result.tables[0].rows}, records["raw", 0]
    low, high = raw["moving_ci_mm"]
    assert rows["raw", "0"][3] == f"{raw['moving_mm']:.1f} ({low:.1f}–{high:.1f})"
    assert rows["raw", "0"][4:12] == [f"{raw['people_mm'][who]:.1f}" for who in people]
    assert (BEST, "offline") in rows


def test_what_is_stated_is_compared_with_each_persons_errors(result: Result) -> None:
    told = [stated(one) for one in everybody()]
    for name, says in ((UNKNOWN, "sensor unknown"), (KNOWN, "sensor known")):
        (record,) = (r for r in result.data["records"] if r["method"] == name)
        errors = [error for _, error in left_out(SCALES[name, 4])]
        for number, (who, error) in enumerate(zip(kinect_vicon.SUBJECTS, errors, strict=True)):
            own = (np.concatenate(part) for part in zip(*told[2 * number : 2 * number + 2], strict=True))
            expected = kinect_methods.deviation(error, *own)
            assert record["deviation"][who] == expected
            row = next(row for row in result.tables[1].rows if row[0] == f"{who}, {says}")
            assert row[1] == f"{expected['rank_correlation']:.2f}"
            assert row[-1] == f"{expected['flagged_percent']:.2f}" == "15.00"
        assert f"{name}, delay 4" in result.data["reliability"]


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


def clip_of(seed: int, frames: int) -> Clip:
    truth, seen = person(seed, frames)
    return Clip("m01_s07_e01", "s07", np.zeros((frames, 22, 3)), seen, truth)


def test_a_constant_offset_in_the_body_is_learned_on_one_subject_and_taken_from_another() -> None:
    train, validation = [clip_of(s, 40) for s in range(4)], [clip_of(s, 40) for s in range(10, 14)]
    known, asked = [c.centres for c in train], [c.centres for c in validation]
    offset = kinect_methods.learn_offset(known, align(known, [c.raw for c in train]))
    aligned = align(asked, [c.raw for c in validation])
    without = kinect_methods.score(asked, aligned, np.zeros_like(offset))
    corrected = kinect_methods.score(asked, aligned, offset)
    assert without.position.mean() > 0.03
    # The trunk's frame is that of the joints as observed, which an offset tilts a little.
    assert corrected.position.mean() < 0.2 * without.position.mean()
    # without the clip_of's own constant offset, what moves is as little, whatever offset was learned
    assert without.moving.mean() < 0.2 * without.position.mean()
    np.testing.assert_array_equal(without.moving, corrected.moving)


def test_scores_do_not_depend_on_where_the_sensor_stands_and_lost_markers_are_left_out() -> None:
    here = clip_of(1, 30)
    here.centres[5:9, 3] = np.nan
    offset = np.random.default_rng(2).normal(0, 0.02, OFFSET.shape)
    turn = Rotation.random(rng=np.random.default_rng(9)).as_matrix()
    truths = [here.centres]
    a, b = (kinect_methods.score(truths, align(truths, [seen]), offset) for seen in (here.raw, here.raw @ turn.T + 2.0))
    for name in ("position", "acceleration", "variation"):
        assert np.isfinite(getattr(a, name)).all()
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-12)


@pytest.mark.parametrize("run", [
    partial(filters.constant_velocity, delay=3, density=1.0),
    partial(one_euro, delay=0, min_cutoff_hz=1.0, beta=2.0),
    partial(gaussian_hampel, delay=3, sigma_s=0.05, threshold=3.0),
])  # fmt: skip
def test_clips_side_by_side_are_filtered_as_if_alone(run: partial) -> None:
    clips = [clip_of(0, 12), clip_of(1, 2), clip_of(2, 30)]
    together, _ = kinect_methods.run_filter(clips, run)
    for one, answer in zip(clips, together, strict=True):
        assert answer.shape == one.raw.shape
        np.testing.assert_allclose(answer, kinect_methods.run_filter([one], run)[0][0], atol=1e-12)


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
    one = clip_of(0, 9)._replace(kinect=kinect)
    (answer,), _ = kinect_methods.run_filter(
        [one], lambda seen, stamps_s: seen + stamps_s[:, None, None, None], whole_body=True
    )
    expected = to_canonical(KINECT22, kinect)[0][:, [J[name] for name in SCORED]]
    np.testing.assert_allclose(answer, expected + (np.arange(9) / 30)[:, None, None])


def test_a_search_has_each_persons_figures_and_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    people = ("s07", "s08", "s08")
    clips = [clip_of(n, 20 + n)._replace(subject=who, name=f"{n}") for n, who in enumerate(people)]
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
    clips = [clip_of(n, 12)._replace(name=f"{n}") for n in range(3)]
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
    clips = [clip_of(n, 12)._replace(subject=who) for n, who in enumerate(("s03", "s01", "s02", "s01"))]
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
    ridge, _ = kinect_methods.learners([clip_of(0, 12)], 8, 2.0, steps=7)
    ridge.run([clip_of(1, 12)])
    assert asked == [(8, 0, 2.0), (8, 4, 2.0), (4, 7), (8, 0, 2.0)]
