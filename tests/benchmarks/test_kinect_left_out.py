"""Nothing that is learned of a Kinect reaches the person who is left out, whoever learns and whoever that is.

What is learned is held against the same with other recordings of that person: not a bit may differ. And it must differ
with other recordings of somebody else, or nothing was learned.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.progress import Progress

from steadypose.benchmarks.baselines.filters import FILTERS
from steadypose.benchmarks.bench import Bench, Tuned
from steadypose.benchmarks.studies import kinect_methods, kinect_vicon
from steadypose.benchmarks.studies.kinect_clips import SCORED, Clip
from steadypose.benchmarks.studies.kinect_methods import (
    KNOWN,
    RIDGE,
    TCN,
    UNKNOWN,
    Kinect,
    Method,
    Stated,
    run_filter,
    run_ours,
)
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.settings import PriorSettings
from steadypose.training.data.ui_prmd import KinectPair
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
    return KinectPair(f"m01_{subject}_e{take:02}", subject, "m01", 30.0, kinect, vicon, np.zeros((FRAMES, 39, 3)))


def clip(subject: str, take: int, corrupted: str) -> Clip:
    one = pair(subject, take, corrupted)
    scored = [J[name] for name in SCORED]
    raw = to_canonical(KINECT22, one.kinect)[0][:, scored]
    truth = np.nan_to_num(one.vicon[:, scored])
    return Clip(one.name, subject, one.kinect, raw, truth, truth)


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
    positions, stated = run_ours(some, PriorSettings(), 4)
    scored = [J[name] for name in SCORED]
    for number, (own, told, count) in enumerate(zip(positions, stated, (FRAMES, 12), strict=True)):
        np.testing.assert_array_equal(own, made.positions[:count, number, scored])
        np.testing.assert_array_equal(told.sigma, made.sigma[:count, number, scored])
        np.testing.assert_array_equal(told.anomaly, made.anomaly[:count, number])
        np.testing.assert_array_equal(told.flagged, made.flagged[:count, number])


def test_a_sensors_correction_is_judged_by_whom_it_was_not_learned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_offsets_are_learned_on_the_others(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """And every person is left out once, of means only who is out of step."""
    everybody = [clip(subject, take, "") for subject in kinect_vicon.SUBJECTS for take in range(2)]
    of_truth = {id(truth): one.subject for one in everybody for truth in (one.centres, one.markers)}
    people: list[str] = []

    def answer(some: Sequence[Clip], stated: bool) -> tuple[list[np.ndarray], list[Stated] | None]:
        people.append(some[-1].subject)
        raw = run_filter(some, lambda seen, _: seen)
        shape = raw[0].shape[:2]
        told = Stated(
            np.random.default_rng(0).uniform(0.01, 0.1, shape),
            np.linspace(0, 1, shape[0]),
            np.zeros(shape[0], dtype=bool),
        )
        return raw, [told for _ in some] if stated else None

    def methods(self: Kinect, left_out: str, tuned: object) -> Iterator[Method]:
        for name, stated in (("raw", False), (UNKNOWN, True), (KNOWN, True)):
            yield Method(name, 0 if name == "raw" else 4, partial(answer, stated=stated))

    def learn(truths: Sequence[np.ndarray], aligned: Sequence[np.ndarray]) -> np.ndarray:
        taught = {of_truth[id(truth)] for truth in truths}
        assert people[-1] not in taught
        assert taught
        return np.zeros((len(SCORED), 3))

    monkeypatch.setattr(kinect_vicon, "read_clips", lambda path, subjects, every: everybody)
    monkeypatch.setattr(kinect_vicon, "learn_offset", learn)
    monkeypatch.setattr(Kinect, "tuned", lambda self, on: {})
    monkeypatch.setattr(Kinect, "methods", methods)
    slow = Bench(quick=False, mocap=bench.mocap, data=bench.data, progress=bench.progress)
    result = kinect_vicon.run(slow)
    assert list(dict.fromkeys(people)) == list(kinect_vicon.SUBJECTS)
    record = result.data["records"][0]
    own = [figures["position_mm"] for who, figures in record["groups"].items() if who in kinect_vicon.SUBJECTS[1:]]
    assert record["position_mm"] == pytest.approx(np.mean(own), abs=1e-2)
    assert "s01" in record["groups"]
    assert all("s01" in table.note for table in result.tables[:3])
