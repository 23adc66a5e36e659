import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.helpers.bodies import waving

from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing import resample
from steadypose.prior.timing.kalman import INITIAL_SPEED, ConstantVelocityFilter
from steadypose.prior.timing.resample import LOOK_AHEAD_NS, PERIOD_NS, RUNS, DecimationFilter, Frame, Resampler

SLOTS = 2


def line(stamp_ns: int) -> np.ndarray:
    """Every joint on a straight path: what linear interpolation gives back exactly."""
    t = stamp_ns * 1e-9
    return np.broadcast_to(np.array([t, -2 * t, 0.5 + t]), (SLOTS, 22, 3)).copy()


def feed(stamps: list[int]) -> list[Frame]:
    resampler = Resampler(SLOTS)
    frames = [frame for s in stamps for frame in resampler.update(s, line(s), np.full((SLOTS, 22), 0.7))]
    return frames + resampler.drain()


@given(st.lists(st.integers(20_000_000, 60_000_000), min_size=3, max_size=60), st.integers(0, 2**60))
@example([20_000_000] * 7, 0)  # faster than the grid: the newest frame waits for its successor
@settings(max_examples=60)
def test_any_stamps_give_the_whole_grid_once_in_order_and_in_place(steps: list[int], start: int) -> None:
    stamps = (start + np.concatenate([[0], np.cumsum(steps)])).tolist()
    frames = feed(stamps)
    ticks = [f[0] for f in frames]
    assert ticks == [start + k * PERIOD_NS for k in range(len(ticks))]
    assert stamps[-1] - PERIOD_NS < ticks[-1] <= stamps[-1] + LOOK_AHEAD_NS
    origin = start * 1e-9
    for tick, positions, _ in frames[1:]:
        if np.isfinite(positions).all():
            assert np.allclose(positions - line(start), line(tick) - line(start), atol=1e-6 * max(origin, 1))


def test_a_steady_camera_waits_for_nothing() -> None:
    resampler = Resampler(SLOTS)
    for k in range(20):
        jitter = (-1) ** k * 3_000_000 if k else 0
        frames = resampler.update(k * PERIOD_NS + jitter, line(0), np.ones((SLOTS, 22)))
        assert [f[0] for f in frames] == [k * PERIOD_NS]


@pytest.mark.parametrize("hz", [30, 50, 60, 90, 100, 120, 200])
def test_a_fast_camera_is_not_extrapolated_far(hz: int) -> None:
    resampler, rng = Resampler(1), np.random.default_rng(0)
    noise = [rng.standard_normal((1, 22, 3)) for _ in range(2 * hz)]
    frames = [f for k, n in enumerate(noise) for f in resampler.update(round(k * 1e9 / hz), n, np.ones((1, 22)))]
    left = float(np.std([positions for _, positions, _ in frames]))
    assert left < 1.15, "noise is not amplified; extrapolated by a whole period, it would be by 2.2"


def test_a_joint_hidden_for_long_is_missing_in_between_and_a_short_gap_is_bridged() -> None:
    for gap, bridged in ((3, True), (12, False)):
        resampler = Resampler(SLOTS)
        frames = []
        for k in range(30):
            positions = line(k * PERIOD_NS)
            if 10 < k <= 10 + gap:
                positions[0, 5] = np.nan
            frames += resampler.update(k * PERIOD_NS, positions, np.ones((SLOTS, 22)))
        hidden = [k for k, (_, p, c) in enumerate(frames) if np.isnan(p[0, 5, 0]) and c[0, 5] == 0]
        # What has been given out cannot be bridged: frames leave at once, so a joint is missing while it is hidden.
        assert hidden == list(range(11, 11 + gap)), bridged
        assert not any(np.isnan(p[1]).any() for _, p, _ in frames)


def test_each_frame_of_a_camera_too_slow_to_be_interpolated_counts_at_one_grid_time() -> None:
    stamps = np.arange(100) * 200_000_000 + np.random.default_rng(0).integers(0, PERIOD_NS, 100)
    seen = [frame for frame in feed(stamps.tolist()) if np.isfinite(frame.positions).all()]
    assert len(seen) >= len(stamps) - 2  # the first three show that it is slow
    nearest = np.abs(stamps[:, None] - [frame.stamp_ns for frame in seen]).min(axis=0)
    assert nearest.max() <= PERIOD_NS - LOOK_AHEAD_NS


def test_the_lesser_confidence_holds_between_two_observations() -> None:
    resampler = Resampler(SLOTS)
    resampler.update(0, line(0), np.full((SLOTS, 22), 0.9))
    frames = resampler.update(3 * PERIOD_NS, line(3 * PERIOD_NS), np.full((SLOTS, 22), 0.2))
    assert frames[0][2][0, 0] == pytest.approx(0.2)


def test_a_cleared_slot_does_not_reach_back_to_the_last_body() -> None:
    resampler = Resampler(SLOTS)
    resampler.update(0, line(0), np.ones((SLOTS, 22)))
    resampler.clear(np.array([True, False]))
    frames = resampler.update(2 * PERIOD_NS, line(2 * PERIOD_NS), np.ones((SLOTS, 22)))
    assert np.isnan(frames[0][1][0]).all()
    assert np.isfinite(frames[0][1][1]).all()


@pytest.mark.parametrize("hz", [30, 60, 120])
def test_at_the_end_no_grid_time_is_lost(hz: int) -> None:
    resampler, end = Resampler(1), 2 * hz
    stamps = [round(k * 1e9 / hz) for k in range(end + 1)]
    frames = [f for s in stamps for f in resampler.update(s, line(s)[:1], np.ones((1, 22)))] + resampler.drain()
    assert [f.stamp_ns for f in frames] == [k * PERIOD_NS for k in range(61)]
    assert all(np.allclose(f.positions, line(f.stamp_ns)[:1], atol=1e-9) for f in frames)


def dropped(frames: np.ndarray) -> list[bool]:
    republished = resample.Republished()
    return [republished.update(frame[None]) for frame in frames]


@pytest.mark.parametrize("times", [2, 3])
def test_what_a_stream_repeats_regularly_is_dropped(times: int) -> None:
    frames = np.repeat(waving(60), times, axis=0)
    frames[:, 4] = np.nan
    new = np.arange(len(frames)) % times == 0
    found = np.array(dropped(frames))
    assert not found[new].any()
    assert found[~new][RUNS * (times - 1) :].all()


def test_who_stands_still_without_noise_is_no_repetition() -> None:
    moving = waving(60)
    frames = np.concatenate([moving[:20], np.repeat(moving[20:21], 40, axis=0), moving[20:]])
    assert not any(dropped(frames))
    assert not any(dropped(np.repeat(moving[:1], 100, axis=0)))


def test_a_tracker_that_stops_is_given_on_after_its_usual_repetitions() -> None:
    frames = np.concatenate([np.repeat(waving(60), 2, axis=0), np.repeat(waving(1), 30, axis=0)])
    assert sum(dropped(frames)[120:]) == 1


HZ = 60


def frames(positions: np.ndarray, hz: float = HZ, jitter_ns: np.ndarray | None = None) -> list[Frame]:
    """Positions (T, S, 22, 3) at ``hz``, or this much beside."""
    stamps = np.round(np.arange(len(positions)) * 1e9 / hz).astype(np.int64)
    if jitter_ns is not None:
        stamps += jitter_ns
    confidence = np.ones(positions.shape[1:3])
    return [Frame(int(t), p, confidence) for t, p in zip(stamps, positions, strict=True)]


def through(stream: list[Frame], slots: int = 1) -> list[Frame]:
    decimation = DecimationFilter(slots, delayed=True)
    return [out for frame in stream for out in decimation.update(frame)] + decimation.drain()


def swing(stamps_ns: np.ndarray, frequency: float = 3.0) -> np.ndarray:
    """(T, 1, 22, 3): every joint swings by 20 cm."""
    angle = 2 * np.pi * frequency * stamps_ns * 1e-9
    return np.broadcast_to(0.2 * np.sin(angle)[:, None, None, None], (len(angle), 1, 22, 3)).copy()


@given(
    st.lists(st.one_of(st.integers(1, 10), st.integers(3_000_000, 60_000_000)), min_size=1, max_size=80),
    st.sampled_from([None, 1, 8_333_333, 16_666_667]),
)
@settings(max_examples=30)
def test_each_frame_comes_out_once_with_its_stamp(periods: list[int], regular: int | None) -> None:
    steps = periods if regular is None else [regular] * 40 + periods
    stamps, rng = np.cumsum(steps), np.random.default_rng(0)
    stream = [Frame(int(t), rng.standard_normal((1, 22, 3)), np.ones((1, 22))) for t in stamps]
    out = through(stream)
    assert [f.stamp_ns for f in out] == stamps.tolist()
    assert all(np.isfinite(f.positions).all() for f in out)


@pytest.mark.parametrize("hz", [10, 15, 30, 40])
def test_a_stream_no_faster_than_the_grid_passes_at_once_and_untouched(hz: int) -> None:
    decimation, rng = DecimationFilter(1, delayed=True), np.random.default_rng(0)
    for frame in frames(rng.standard_normal((60, 1, 22, 3)), hz):
        (out,) = decimation.update(frame)
        assert out.stamp_ns == frame.stamp_ns
        assert np.array_equal(out.positions, frame.positions)


@pytest.mark.parametrize(("hz", "left"), [(50, 0.8), (60, 0.8), (90, 0.7), (120, 0.65), (200, 0.55)])
def test_white_noise_shrinks_with_the_rate(hz: int, left: float) -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal((4 * hz, 1, 22, 3))
    out = np.stack([f.positions for f in through(frames(noise, hz))])[hz:]
    assert 0.3 < out.std() / 0.01 < left


def test_motion_without_noise_stays_within_half_a_millimetre() -> None:
    truth = swing(np.round(np.arange(3 * HZ) * 1e9 / HZ))
    out = np.stack([f.positions for f in through(frames(truth))])
    assert np.abs(out - truth).max() < 5e-4, "3 Hz, 3.8 m/s"


def test_stamps_are_believed() -> None:
    rng = np.random.default_rng(0)
    jitter = rng.integers(-3_000_000, 3_000_000, 3 * HZ)
    stamps = np.round(np.arange(3 * HZ) * 1e9 / HZ) + jitter
    truth = np.broadcast_to((2e-9 * stamps)[:, None, None, None], (3 * HZ, 1, 22, 3))
    out = np.stack([f.positions for f in through(frames(truth, jitter_ns=jitter))])
    assert np.allclose(out, truth, atol=1e-9), "a joint at 3.5 m/s, whose stamps jitter"


def test_noise_that_lasts_is_left_alone() -> None:
    noise = time_correlated(0.01 * np.random.default_rng(0).standard_normal((6 * HZ, 1, 22, 3)), 0.98)
    out = np.stack([f.positions for f in through(frames(noise))])
    assert 0.97 < out[HZ:].std() / noise[HZ:].std() <= 1.0


def test_an_outlier_does_not_reach_its_neighbours() -> None:
    noise = 0.005 * np.random.default_rng(0).standard_normal((3 * HZ, 1, 22, 3))
    spoilt = noise.copy()
    spoilt[2 * HZ, 0, 7] += 0.4
    clean, out = (np.stack([f.positions for f in through(frames(x))]) for x in (noise, spoilt))
    off = np.linalg.norm(out - clean, axis=-1)
    assert off[2 * HZ, 0, 7] > 0.38, "what came is for the gate to judge"
    off[2 * HZ, 0, 7] = 0.0
    assert off.max() < 0.02


def test_missing_joints_stay_missing_and_harm_no_other() -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal((3 * HZ, 2, 22, 3))
    holed = noise.copy()
    holed[100:130, 0, 5] = np.nan
    whole, out = (np.stack([f.positions for f in through(frames(x), slots=2)]) for x in (noise, holed))
    missing = np.isnan(holed)
    assert np.array_equal(np.isnan(out), missing)
    others = np.ones(out.shape[1:3], dtype=bool)
    others[0, 5] = False
    assert np.array_equal(out[:, others], whole[:, others])


def test_a_cleared_slot_starts_anew() -> None:
    stream = frames(np.random.default_rng(0).standard_normal((2 * HZ, 2, 22, 3)))
    decimation = DecimationFilter(2, delayed=True)
    for frame in stream[:-1]:
        decimation.update(frame)
    decimation.clear(np.array([True, False]))
    (out,) = decimation.update(stream[-1])
    assert np.isnan(out.positions[0]).all(), "the frame that was held is of the body before"
    assert np.isfinite(out.positions[1]).all()


def test_without_delay_a_frame_waits_for_no_more_than_one_and_only_of_a_fast_camera() -> None:
    for hz, waits in ((60, 0), (120, 1)):
        decimation, stream = DecimationFilter(1, delayed=False), frames(np.zeros((60, 1, 22, 3)), hz)
        passed = [out.stamp_ns for frame in stream for out in decimation.update(frame)]
        assert passed == [frame.stamp_ns for frame in stream][: 60 - waits]


DENSITY, SIGMA = 3.0, 0.02


def stream(seed: int, frames: int = 20, joints: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, J, 3) with missing joints, irregular stamps (T,). Joint 0 starts seen."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0, 0.05, (frames, joints, 3)), axis=0)
    missing = rng.random((frames, joints)) < 0.3
    missing[0, 0] = False
    positions[missing] = np.nan
    return positions, np.cumsum(rng.uniform(0.01, 0.08, frames))


def dense_posterior(values: np.ndarray, stamps: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean (3,) and standard deviation along an axis at the end, given all of a path (T, 3), by conditioning one big
    Gaussian over all positions and velocities. `values[0]` is a measurement; later ones may be NaN."""
    frames = len(values)
    mean, covariance = np.zeros((2 * frames, 3)), np.zeros((2 * frames, 2 * frames))
    mean[0] = values[0]
    covariance[:2, :2] = np.diag([SIGMA**2, INITIAL_SPEED**2])
    for i in range(1, frames):
        dt = stamps[i] - stamps[i - 1]
        f = np.array([[1, dt], [0, 1]])
        now, before, past = slice(2 * i, 2 * i + 2), slice(2 * i - 2, 2 * i), slice(0, 2 * i)
        mean[now] = f @ mean[before]
        covariance[now, past] = f @ covariance[before, past]
        covariance[past, now] = covariance[now, past].T
        covariance[now, now] = f @ covariance[before, before] @ f.T + DENSITY * np.array(
            [[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]
        )
    used = np.flatnonzero(np.isfinite(values[1:, 0])) + 1
    innovation = covariance[np.ix_(2 * used, 2 * used)] + SIGMA**2 * np.eye(len(used))
    gain = np.linalg.solve(innovation, covariance[2 * used]).T
    mean = mean + gain @ (values[used] - mean[2 * used])
    covariance = covariance - gain @ covariance[2 * used]
    return mean[-2], np.sqrt(covariance[-2, -2])


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6))
def test_every_estimate_is_the_posterior_given_the_frames_so_far(seed: int) -> None:
    positions, stamps = stream(seed)
    kalman = ConstantVelocityFilter(DENSITY, SIGMA)
    for frame, (measured, stamp) in enumerate(zip(positions, stamps, strict=True)):
        estimate = kalman.update(measured, stamp)
        assert estimate.stamp_s == stamp
        for joint in range(positions.shape[1]):
            seen = np.isfinite(positions[: frame + 1, joint, 0])
            if not seen.any():
                assert np.isnan(estimate.positions[joint]).all()
                assert estimate.sigma[joint] == np.inf
                continue
            span = slice(int(np.argmax(seen)), frame + 1)
            mean, sigma = dense_posterior(positions[span, joint], stamps[span])
            np.testing.assert_allclose(estimate.positions[joint], mean, atol=1e-9)
            np.testing.assert_allclose(estimate.sigma[joint], sigma, atol=1e-9)


def test_predict_is_what_a_missing_frame_would_give_and_its_deviation_grows() -> None:
    positions, stamps = stream(8)
    kalman = ConstantVelocityFilter(DENSITY)
    assert kalman.predict(0.0) is None
    before = [kalman.update(*frame) for frame in zip(positions, stamps, strict=True)][-1]
    expected = kalman.predict(stamps[-1] + 0.2)
    coasted = kalman.update(np.full_like(positions[0], np.nan), stamps[-1] + 0.2)
    assert expected
    np.testing.assert_array_equal(expected.positions, coasted.positions)
    np.testing.assert_array_equal(expected.sigma, coasted.sigma)
    assert (coasted.sigma > before.sigma).all()


def test_a_forgotten_joint_starts_anew_and_leaves_the_others_alone() -> None:
    positions, stamps = stream(9)
    known, whole, fresh = (ConstantVelocityFilter(DENSITY) for _ in range(3))
    forgotten = np.array([False, True, False])
    for i, (measured, stamp) in enumerate(zip(positions, stamps, strict=True)):
        if i == 12:
            known.forget(forgotten)
        a, b = known.update(measured, stamp), whole.update(measured, stamp)
        np.testing.assert_array_equal(a.positions[~forgotten], b.positions[~forgotten])
        if i >= 12:
            c = fresh.update(measured, stamp)
            np.testing.assert_array_equal(a.positions[1], c.positions[1])
            np.testing.assert_array_equal(a.sigma[1], c.sigma[1])


def test_refuses_a_stamp_that_does_not_increase_until_it_is_reset() -> None:
    kalman = ConstantVelocityFilter(1.0)
    kalman.update(np.zeros((2, 3)), 1.0)
    with pytest.raises(ValueError, match=r"stamp after 1\.0 s"):
        kalman.update(np.zeros((2, 3)), 1.0)
    kalman.reset()
    kalman.update(np.zeros((3, 3)), 0.5)
