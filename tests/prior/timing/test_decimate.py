import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.resample import DecimationFilter, Frame

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
