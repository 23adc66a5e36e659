import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steadypose.prior.timing.fixed_lag import FixedLagRTS, OneEuroFilter

DENSITY, INITIAL_SPEED = 3.0, 0.7


def stream(seed: int, frames: int = 24, joints: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (T, J, 3) with missing joints, irregular stamps (T,), sigmas (T, J). Joint 0 starts seen."""
    rng = np.random.default_rng(seed)
    positions = np.cumsum(rng.normal(0, 0.05, (frames, joints, 3)), axis=0)
    missing = rng.random((frames, joints)) < 0.3
    missing[0, 0] = False
    positions[missing] = np.nan
    return positions, np.cumsum(rng.uniform(0.01, 0.08, frames)), rng.uniform(0.005, 0.05, (frames, joints))


def dense_posterior(values: np.ndarray, stamps: np.ndarray, sigmas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (T,) and standard deviation (T,) of one coordinate's path given all of it, by conditioning one big
    Gaussian over all positions and velocities. `values[0]` is a measurement; later ones may be NaN."""
    frames = len(values)
    mean, covariance = np.zeros(2 * frames), np.zeros((2 * frames, 2 * frames))
    mean[0] = values[0]
    covariance[:2, :2] = np.diag([sigmas[0] ** 2, INITIAL_SPEED**2])
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
    used = np.flatnonzero(np.isfinite(values[1:])) + 1
    innovation = covariance[np.ix_(2 * used, 2 * used)] + np.diag(sigmas[used] ** 2)
    gain = np.linalg.solve(innovation, covariance[2 * used]).T
    mean = mean + gain @ (values[used] - mean[2 * used])
    covariance = covariance - gain @ covariance[2 * used]
    return mean[::2], np.sqrt(np.diag(covariance)[::2])


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), delay=st.integers(0, 9))
def test_every_emission_is_the_batch_posterior_given_the_frames_so_far(seed: int, delay: int) -> None:
    positions, stamps, sigmas = stream(seed)
    smoother = FixedLagRTS(delay, DENSITY, initial_speed=INITIAL_SPEED)
    answers = [smoother.update(p, t, s) for p, t, s in zip(positions, stamps, sigmas, strict=True)]
    given_until = list(range(len(stamps))) + [len(stamps) - 1] * delay
    answers += smoother.flush()
    assert answers[:delay] == [None] * delay
    assert len(answers) == len(stamps) + delay

    for frame, (answer, last) in enumerate(zip(answers[delay:], given_until[delay:], strict=True)):
        assert answer is not None
        assert answer.stamp_s == stamps[frame]
        for joint in range(positions.shape[1]):
            seen = np.isfinite(positions[: last + 1, joint, 0])
            first = int(np.argmax(seen)) if seen.any() else last + 1
            if frame < first:
                assert np.isnan(answer.positions[joint]).all()
                assert answer.sigma[joint] == np.inf
                continue
            span = slice(first, last + 1)
            for axis in range(3):
                mean, sigma = dense_posterior(positions[span, joint, axis], stamps[span], sigmas[span, joint])
                np.testing.assert_allclose(answer.positions[joint, axis], mean[frame - first], atol=1e-9)
                np.testing.assert_allclose(answer.sigma[joint], sigma[frame - first], atol=1e-9)


def test_per_joint_density_and_infinite_sigma() -> None:
    positions, stamps, sigmas = stream(5)
    both = FixedLagRTS(2, [1.0, 10.0, 1.0])
    alone = FixedLagRTS(2, 10.0)
    hidden = FixedLagRTS(2, [1.0, 10.0, 1.0])
    for p, t, s in zip(positions, stamps, sigmas, strict=True):
        a, b = both.update(p, t, s), alone.update(p, t, s)
        c = hidden.update(np.nan_to_num(p, nan=9.0), t, np.where(np.isnan(p[:, 0]), np.inf, s))
        if a and b and c:
            np.testing.assert_array_equal(a.positions[1], b.positions[1])
            np.testing.assert_array_equal(a.positions, c.positions)


def test_a_missing_joint_coasts_and_grows_unsure() -> None:
    smoother = FixedLagRTS(0, 1.0, measurement_sigma=0.001)
    seen = coasted = None
    for i in range(60):
        seen = smoother.update(np.full((1, 3), 0.5 * i / 30), i / 30)
    for i in range(60, 75):
        coasted = smoother.update(np.full((1, 3), np.nan), i / 30)
    assert seen
    assert coasted
    np.testing.assert_allclose(coasted.positions, 0.5 * 74 / 30, atol=1e-3)
    assert coasted.sigma[0] > 20 * seen.sigma[0]


def test_predict_is_what_a_missing_frame_would_give() -> None:
    positions, stamps, sigmas = stream(8)
    smoother = FixedLagRTS(0, DENSITY)
    assert smoother.predict(0.0) is None
    for p, t, s in zip(positions, stamps, sigmas, strict=True):
        smoother.update(p, t, s)
    expected = smoother.predict(stamps[-1] + 0.2)
    coasted = smoother.update(np.full_like(positions[0], np.nan), stamps[-1] + 0.2)
    assert expected
    assert coasted
    np.testing.assert_array_equal(expected.positions, coasted.positions)
    np.testing.assert_array_equal(expected.sigma, coasted.sigma)


def test_a_forgotten_joint_starts_afresh_and_leaves_the_others_alone() -> None:
    positions, stamps, sigmas = stream(9)
    known, whole, fresh = FixedLagRTS(2, DENSITY), FixedLagRTS(2, DENSITY), FixedLagRTS(2, DENSITY)
    forgotten = np.array([False, True, False])
    for i, (p, t, s) in enumerate(zip(positions, stamps, sigmas, strict=True)):
        if i == 12:
            known.forget(forgotten)
        a, b = known.update(p, t, s), whole.update(p, t, s)
        c = fresh.update(p, t, s) if i >= 12 else None
        if a and b:
            np.testing.assert_array_equal(a.positions[~forgotten], b.positions[~forgotten])
        if a and c:
            np.testing.assert_array_equal(a.positions[1], c.positions[1])
            np.testing.assert_array_equal(a.sigma[1], c.sigma[1])


def test_stays_settled_over_a_long_stream() -> None:
    """Ten minutes at a delay of 16 frames: the recursions must neither drift apart nor lose their sign."""
    rng = np.random.default_rng(0)
    smoother = FixedLagRTS(16, 0.01, measurement_sigma=0.05)
    errors, answer = [], None
    for i in range(18_000):
        answer = smoother.update(rng.normal(0, 0.05, (1, 3)), i / 30)
        if answer and i > 500:
            errors.append(answer.positions)
    assert answer
    # The scene stands still while the model allows it to move: the error is under the stated sigma.
    assert 0.2 * answer.sigma[0] < np.std(errors) < answer.sigma[0]


def test_stated_sigma_is_the_error_found() -> None:
    rng = np.random.default_rng(3)
    frames, joints, dt = 600, 40, 1 / 30
    noise = np.linalg.cholesky(DENSITY * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    state = np.zeros((joints, 3, 2))
    smoother = FixedLagRTS(4, DENSITY, measurement_sigma=0.03)
    truth, estimates, sigma = [], [], 0.0
    for i in range(frames):
        state[..., 0] += dt * state[..., 1]
        state += rng.normal(size=state.shape) @ noise.T
        truth.append(state[..., 0].copy())
        if answer := smoother.update(state[..., 0] + rng.normal(0, 0.03, (joints, 3)), i * dt):
            estimates.append(answer.positions)
            sigma = answer.sigma[0]
    error = np.std(np.stack(truth)[100 : len(estimates)] - np.stack(estimates)[100:])
    assert error == pytest.approx(sigma, rel=0.03)


def naive_one_euro(values: np.ndarray, stamps: np.ndarray, fmin: float, beta: float, fd: float) -> np.ndarray:
    """The paper's algorithm 1, one joint, with the norm of the velocity as its speed."""

    def weight(dt: float, cutoff: float) -> float:
        return 1 / (1 + (1 / (2 * np.pi * cutoff)) / dt)

    out = [values[0]]
    velocity = np.zeros(3)
    for i in range(1, len(values)):
        dt = stamps[i] - stamps[i - 1]
        a = weight(dt, fd)
        velocity = a * (values[i] - values[i - 1]) / dt + (1 - a) * velocity
        a = weight(dt, fmin + beta * float(np.linalg.norm(velocity)))
        out.append(a * values[i] + (1 - a) * out[-1])
    return np.array(out)


def test_one_euro_is_the_papers_algorithm_between_gaps() -> None:
    positions, stamps, _ = stream(11)
    one_euro = OneEuroFilter(1.2, 3.0, 0.9)
    got = np.stack([one_euro.update(p, t) for p, t in zip(positions, stamps, strict=True)])
    for joint in range(positions.shape[1]):
        seen = np.flatnonzero(np.isfinite(positions[:, joint, 0]))
        expected = naive_one_euro(positions[seen, joint], stamps[seen], 1.2, 3.0, 0.9)
        np.testing.assert_allclose(got[seen, joint], expected, atol=1e-12)
        assert np.isnan(got[: seen[0], joint]).all()
        for frame in set(range(seen[0], len(stamps))) - set(seen.tolist()):
            np.testing.assert_array_equal(got[frame, joint], got[frame - 1, joint])


def test_flush_empties_and_filters_start_afresh() -> None:
    positions, stamps, sigmas = stream(2)
    smoother, one_euro = FixedLagRTS(3, DENSITY), OneEuroFilter(1.0, 1.0)

    def run() -> np.ndarray:
        held = [smoother.update(p, t, s) for p, t, s in zip(positions, stamps, sigmas, strict=True)]
        return np.stack([a.positions for a in held + smoother.flush() if a])

    np.testing.assert_array_equal(run(), run())
    assert smoother.flush() == []
    first = [one_euro.update(p, t) for p, t in zip(positions, stamps, strict=True)]
    one_euro.reset()
    np.testing.assert_array_equal(first, [one_euro.update(p, t) for p, t in zip(positions, stamps, strict=True)])


def test_a_stream_shorter_than_the_delay_is_answered_by_flush() -> None:
    smoother = FixedLagRTS(4, 1.0)
    assert smoother.update(np.zeros((2, 3)), 0.0) is None
    assert smoother.update(np.zeros((2, 3)), 0.1) is None
    assert [a.stamp_s for a in smoother.flush()] == [0.0, 0.1]


@pytest.mark.parametrize("make", [lambda: FixedLagRTS(1, 1.0), lambda: OneEuroFilter(1.0, 0.0)])
def test_refuses_a_stamp_that_does_not_increase_and_a_changed_shape(make) -> None:
    smoother = make()
    smoother.update(np.zeros((2, 3)), 1.0)
    with pytest.raises(ValueError, match=r"stamp after 1\.0 s"):
        smoother.update(np.zeros((2, 3)), 1.0)
    with pytest.raises(ValueError, match=r"shape \(2, 3\)"):
        smoother.update(np.zeros((3, 3)), 2.0)


def test_refuses_settings_without_meaning() -> None:
    with pytest.raises(ValueError, match="delay"):
        FixedLagRTS(-1, 1.0)
    with pytest.raises(ValueError, match="above 0"):
        FixedLagRTS(0, 0.0)
    with pytest.raises(ValueError, match="cut-offs"):
        OneEuroFilter(0.0, 1.0)
