"""Nothing that is learned of a Kinect reaches the person who is left out, whoever learns and whoever that is.

What is learned is held against the same with other recordings of that person: not a bit may differ. And it must differ
with other recordings of somebody else, or nothing was learned.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.progress import Progress

from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE
from steadypose.benchmarks.bench import Bench, Tuned
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.scores import interval, position_error
from steadypose.benchmarks.studies import kinect_methods, kinect_vicon
from steadypose.benchmarks.studies.kinect_methods import KNOWN, RIDGE, TCN, UNKNOWN, Clip, Kinect, Method, Stated, align
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
    assert {RIDGE, TCN, KNOWN, *(baseline.name for baseline in FILTERS)} == {name for name, _ in plain}
    assert [key for key in plain if plain[key] != others[key]] == []
    taught = learned(bench, left_out, next(who for who in PEOPLE if who != left_out))
    assert [name for name in (RIDGE, TCN, KNOWN) if plain[name, 4] == taught[name, 4]] == []


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


def stated(one: Clip) -> Stated:
    shape = one.raw.shape[:2]
    sigma = np.random.default_rng(len(one.name)).uniform(0.01, 0.1, shape)
    return Stated(sigma, np.linspace(0, 1, shape[0]), np.arange(shape[0]) < 3)


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

    def answer(some: Sequence[Clip], scale: float, states: bool) -> tuple[list[np.ndarray], list[Stated] | None]:
        return [scale * one.raw for one in some], [stated(one) for one in some] if states else None

    def methods(self: Kinect, who: str, tuned: object) -> Iterator[Method]:
        for (name, delay), scale in SCALES.items():
            run = partial(answer, scale=scale, states=name in (UNKNOWN, KNOWN))
            yield Method(name, delay, run, {"without": float(who[1:])})

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
