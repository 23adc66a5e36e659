import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.helpers.bodies import waving

from steadypose.prior.timing.resample import LOOK_AHEAD_NS, MAX_GAP_NS, PERIOD_NS, RUNS, Frame, Republished, Resampler

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


def test_a_slow_camera_is_interpolated_between_its_frames() -> None:
    step = 2 * PERIOD_NS
    assert step < MAX_GAP_NS
    frames = feed([k * step for k in range(10)])
    assert all(np.isfinite(p).all() for _, p, _ in frames)
    assert frames[3][1][0, 0, 0] == pytest.approx(3 * PERIOD_NS * 1e-9)


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
    republished = Republished()
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
