from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.progress import Progress
from scipy.spatial.transform import Rotation

from steadypose.benchmarks import figures, product
from steadypose.benchmarks.baselines import inbetween, smoothnet
from steadypose.benchmarks.baselines.filters import Baseline, raw
from steadypose.benchmarks.baselines.kalman import bank, whole_body_bank
from steadypose.benchmarks.bench import Answer, Bench, Methods, over_seeds, search
from steadypose.benchmarks.corruption import along_sight, gaussian
from steadypose.benchmarks.motion import MotionClips, as_set, simulated_clips, spread
from steadypose.benchmarks.scores import figures as figures_of
from steadypose.benchmarks.scores import npss, pivot, position_error, quaternion_distance, score
from steadypose.benchmarks.studies import completion, fidelity, interpolation, interpolation_noise
from steadypose.benchmarks.studies.corrupted import calibration_table, reliability_bins, run_conditions
from steadypose.benchmarks.studies.interpolation import BEFORE, Truth, measure, relate
from steadypose.prior.body.skeleton import J


@pytest.fixture(scope="module")
def clips() -> MotionClips:
    return simulated_clips(frames=45, most=6, seed=0)


def test_simulated_clips_are_bodies_on_a_floor(clips: MotionClips) -> None:
    assert clips.positions.shape == (45, 6, 22, 3)
    assert clips.contacts.shape == (45, 6, 8)
    assert clips.positions[..., 2].min() > -0.05
    length = np.linalg.norm(clips.positions[:, :, J["left_knee"]] - clips.positions[:, :, J["left_hip"]], axis=-1)
    bones = np.linalg.norm(clips.offsets[:, J["left_knee"]], axis=-1)
    np.testing.assert_allclose(length, np.tile(bones, (45, 1)), rtol=0.01)


def test_the_clips_that_travel_farthest_are_kept_in_order_as_many_of_each_person(clips: MotionClips) -> None:
    paths = [np.linalg.norm(np.diff(clip[:, 0, :2], axis=0), axis=-1).sum() for clip in clips.positions.swapaxes(0, 1)]
    alone = replace(clips, person=np.full(6, "a"))
    np.testing.assert_array_equal(alone.farthest(2).positions, clips.positions[:, sorted(np.argsort(paths)[-2:])])
    people = np.array(["a", "a", "b", "b", "b", "c"])
    chosen = replace(clips, person=people).farthest(3)
    assert chosen.person.tolist() == ["a", "b", "c"]
    best = [max(range(2), key=paths.__getitem__), max(range(2, 5), key=paths.__getitem__), 5]
    np.testing.assert_array_equal(chosen.positions, clips.positions[:, best])


def test_an_undisturbed_answer_scores_zero_and_groups_are_told_apart(clips: MotionClips) -> None:
    hidden = np.zeros(clips.positions.shape[:-1], dtype=bool)
    hidden[:, 0, J["left_wrist"]] = True
    perfect = figures_of(score(clips.positions, clips.positions, hidden))
    assert perfect["position_mm"] == perfect["acceleration_mm"] == 0.0
    moved = clips.positions + [0.0, 0.03, 0.0]
    moved[:, 0, J["left_wrist"]] += [0.0, 0.07, 0.0]
    found = figures_of(score(moved, clips.positions, hidden))
    assert (found["seen_mm"], found["hidden_mm"]) == pytest.approx((30.0, 100.0))


def test_a_short_training_of_the_temporal_network_already_smooths(clips: MotionClips) -> None:
    net = smoothnet.train(simulated_clips(frames=45, most=20, seed=1), steps=60, seed=0)
    seen = gaussian(clips.positions, 0.04, np.random.default_rng(0))
    newest, answer = smoothnet.smooth(net, seen, (0, 4))
    assert np.isfinite(newest).all()
    assert position_error(answer, clips.positions).mean() < 0.85 * position_error(seen, clips.positions).mean()
    other = seen.copy()
    other[30:] += 1.0
    np.testing.assert_array_equal(answer[:26], smoothnet.smooth(net, other, (4,))[0][:26])


def test_conditions_give_records_that_tables_and_pictures_are_made_of(clips: MotionClips, monkeypatch) -> None:
    monkeypatch.setattr(product, "PRODUCT", {"steadypose": product.PRODUCT["steadypose"]})
    with Progress(disable=True) as progress:
        bench = Bench(quick=True, mocap=None, data=Path("nowhere.npz"), progress=progress)
        monkeypatch.setitem(bench.__dict__, "smoothnets", [smoothnet.SmoothNet()])
        baselines = (Baseline("raw", lambda seen, _, delay: seen, (0,)),)
        data = run_conditions(bench, clips, {"4 cm": lambda truth, rng: gaussian(truth, 0.04, rng)}, baselines)
    records = {(r["method"], r["delay"]): r for r in data["records"]}
    assert set(records) == {
        ("raw", 0),
        *((m, k) for m in ("SmoothNet-style", "GRU of the whole body", "steadypose") for k in (0, 4)),
    }
    assert records["raw", 0]["position_mm"] == pytest.approx(40 * np.sqrt(8 / np.pi), rel=0.02)
    record = records["steadypose", 4]
    assert np.mean(record["clips_mm"]["position"]) == pytest.approx(record["position_mm"], abs=1e-3)
    assert record["position_mm"] < 0.95 * records["raw", 0]["position_mm"]
    assert [0.2 < row["seen"]["ratio"] < 4.0 for row in data["calibration"]] == [True, True]
    assert len(reliability_bins(data["calibration"], "steadypose", 4)["4 cm, seen"]) == 10
    assert len(calibration_table(data["calibration"], "calibration").rows) == 2
    table = pivot(data["records"], "condition", "position_mm", "noise", "Noise", "")
    assert table.rows[0][:2] == ["raw", "0"]
    assert isinstance(figures.curves(data["records"], "delay", {"position_mm": "mm"}, "frames", "title"), Figure)


def test_seeds_are_averaged() -> None:
    one = {"method": "a", "delay": 0, "condition": "x", "position_mm": 10.0, "hidden_mm": 4.0}
    (merged,) = over_seeds([one, {**one, "position_mm": 12.0}])
    assert merged["position_mm"] == 11.0
    assert merged["seeds"] == 2


def test_every_search_spends_its_budget_and_finds_one_parameter_within_a_few_per_cent() -> None:
    asked: list[dict[str, float]] = []

    def evaluate(point: dict[str, float]) -> dict[str, float]:
        asked.append(point)
        return {"position_mm": np.log(point["a"] / 3.0) ** 2, "acceleration_mm": np.log(point["b"] / 0.2) ** 2}

    found = search({"a": (0.01, 100.0), "b": (0.01, 10.0)}, evaluate, budget=24)
    assert len(asked) == len(found.tried) == 24
    assert all(0.01 <= p["a"] <= 100.0 and 0.01 <= p["b"] <= 10.0 for p in asked)
    assert found.parameters == {key: min(found.tried, key=lambda t: t["position_mm"] + t["acceleration_mm"])[key]
                                for key in ("a", "b")}  # fmt: skip
    found = search({"a": (1e-3, 1e3)}, lambda p: {"position_mm": np.log(p["a"] / 7) ** 2, "acceleration_mm": 0}, 18)
    assert np.log(found.parameters["a"]) == pytest.approx(np.log(7.0), abs=0.04 * np.log(1e6))


def test_noise_is_three_times_as_large_along_the_line_of_sight() -> None:
    truth = np.tile(np.array([2.0, 1.0, -0.5]), (200, 10, 22, 1))
    noise = along_sight(truth, 0.01, np.random.default_rng(0)) - truth
    sight = truth[0, 0, 0] / np.linalg.norm(truth[0, 0, 0])
    along = noise @ sight
    across = noise - along[..., None] * sight
    assert along.std() == pytest.approx(0.03, rel=0.02)
    assert np.sqrt((across**2).sum(axis=-1).mean() / 2) == pytest.approx(0.01, rel=0.02)


def test_errors_are_sorted_by_the_speed_of_the_joint() -> None:
    frames = 60
    truth = np.zeros((frames, 1, 2, 3))
    truth[:, 0, 1, 0] = 3.0 * np.arange(frames) / 30
    answer = truth + np.array([[[0.0, 0.01, 0.0]], [[0.0, 0.04, 0.0]]]).reshape(1, 1, 2, 3)
    speed = np.linalg.norm(np.gradient(truth, 1 / 30, axis=0), axis=-1)
    found = fidelity._by_speed(
        Answer("m", 0, np.arange(frames) / 30, answer, {}, np.full(answer.shape[:-1], 0.01)), truth, speed
    )
    assert {name: b["position_mm"] for name, b in found["by_speed"].items()} == {
        "0-0.1 m/s": pytest.approx(10.0),
        "2-4 m/s": pytest.approx(40.0),
    }
    assert found["by_speed"]["2-4 m/s"]["found_by_stated"] == pytest.approx(4 / np.sqrt(3), abs=1e-3)


def test_clips_are_taken_evenly_from_people_as_far_as_these_go() -> None:
    people = np.array(["a"] * 50 + ["b"] * 3 + ["c"] * 20)
    taken = spread(people, 21)
    assert {s: int((people[taken] == s).sum()) for s in "abc"} == {"a": 9, "b": 3, "c": 9}
    assert (np.diff(taken) > 0).all()
    assert len(spread(people, 500)) == len(people)


def test_the_protocol_gives_tables_and_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    banks = Baseline("bank of smoothers", bank), Baseline("whole-body bank", whole_body_bank)
    baselines = (Baseline("raw", raw, (0,)), *banks, Baseline("half", lambda seen, _, delay: seen * 0.5))
    methods = Methods(baselines, {"steadypose": product.PRODUCT["steadypose"]}, (0, 4), networks=False)
    monkeypatch.setattr(fidelity, "methods", lambda _: methods)
    with Progress(disable=True) as progress:
        result = fidelity.run(Bench(quick=True, mocap=None, data=Path("nowhere.npz"), progress=progress))
    table = next(t for t in result.tables if t.name == "fidelity-speed-4")
    assert [row[0] for row in table.rows][:5] == [
        "none: raw", "none: best filter", "none: bank of smoothers", "none: whole-body bank", "none: steadypose",
    ]  # fmt: skip
    assert table.rows[0][1:] == ["0.0"] * (len(table.columns) - 1)
    sources = next(t for t in result.tables if t.name == "fidelity-sources-0")
    assert sources.columns[-2:] == ["mean over people", "of: whole-body bank"]
    ours_, bank_ = (next(it for it in sources.rows if it[0] == f"1 cm: {m}") for m in ("steadypose", "whole-body bank"))
    assert bank_[-1].startswith("1.00")
    assert float(ours_[-1].split()[0]) == pytest.approx(float(ours_[1]) / float(bank_[1]), abs=0.02)
    assert all(isinstance(figure, Figure) for figure in result.figures.values())


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
