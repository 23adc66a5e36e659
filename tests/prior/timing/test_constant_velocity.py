import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steadypose.prior.timing.kalman import INITIAL_SPEED, ConstantVelocityFilter

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
