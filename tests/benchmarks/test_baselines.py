from functools import partial

import numpy as np
import pytest

from steadypose.benchmarks.baselines import filters, kalman
from steadypose.benchmarks.baselines.body import ConditionalGaussian, beside
from steadypose.benchmarks.baselines.filters import BASELINES, FILTERS, OFFLINE, interpolate, one_euro
from steadypose.benchmarks.baselines.kalman import bank, fixed_lag, noise_found, process_noise, transition
from steadypose.benchmarks.studies.hidden_joints import given_the_seen
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import JOINTS, REST_POSITIONS, J
from steadypose.prior.timing.kalman import ConstantVelocityFilter

STAMPS = np.arange(40) / 30.0
NAN = float("nan")


def motion(rng: np.random.Generator, frames: int = 40, joints: int = 2) -> np.ndarray:
    """(T, 3, J, 3) joints of three clips that move smoothly, with 1 cm of noise."""
    start, speed = rng.normal(size=(2, 3, joints, 3))
    return start + speed * STAMPS[:frames, None, None, None] + rng.normal(0, 0.01, (frames, 3, joints, 3))


def line(values: list[float]) -> np.ndarray:
    """(T, 1, 3) a joint that moves along the diagonal."""
    return np.repeat(np.array(values)[:, None, None], 3, axis=-1)


def test_constant_velocity_agrees_with_the_products_own_filter() -> None:
    seen = motion(np.random.default_rng(0))
    stamps = STAMPS + np.random.default_rng(1).uniform(-0.01, 0.01, len(STAMPS))
    seen[10:14, 1, 0] = np.nan
    seen[20:, 2, 1] = np.nan
    own = ConstantVelocityFilter(0.7, measurement_sigma=0.02)
    expected = np.stack([own.update(frame, stamp).positions for frame, stamp in zip(seen, stamps, strict=True)])
    np.testing.assert_allclose(fixed_lag(seen, stamps, 0, 2, 0.7), expected, atol=1e-6)


def test_constant_acceleration_is_the_smoother_of_its_model() -> None:
    """Against the batch solution: the mean of the joint Gaussian of all states, given all measurements so far."""
    rng = np.random.default_rng(2)
    frames, delay, density, sigma = 7, 2, 30.0, 0.02
    stamps = np.cumsum(rng.uniform(0.02, 0.05, frames))
    seen = rng.normal(0, 0.1, (frames, 1, 3))
    seen[3] = np.nan
    answer = fixed_lag(seen, stamps, delay, 3, density, sigma)
    prior = np.diag([1e3, 1.0, 5.0]) ** 2
    blocks = [[prior]]
    for t, step in enumerate(np.diff(stamps)):
        f = transition(3, step)
        row = [f @ block for block in blocks[t]]
        blocks.append([*row, f @ blocks[t][t] @ f.T + density * process_noise(3, step)])
    covariance = np.block(
        [[blocks[max(a, b)][min(a, b)] if a >= b else blocks[b][a].T for b in range(frames)] for a in range(frames)]
    )[::3, ::3]
    for t in range(frames):
        known = [k for k in range(min(t + delay + 1, frames)) if k != 3]
        gain = covariance[t, known] @ np.linalg.inv(covariance[np.ix_(known, known)] + sigma**2 * np.eye(len(known)))
        np.testing.assert_allclose(answer[t, 0], gain @ seen[known, 0], atol=1e-5)


def test_a_gap_is_bridged_only_when_its_end_is_known() -> None:
    seen, stamps = line([0.0, 1.0, NAN, NAN, 4.0, NAN, 6.0]), np.arange(7.0)
    for run, delay, expected in (
        (filters.hold_last, 0, [0, 1, 1, 1, 4, 4, 6]),
        (interpolate, 0, [0, 1, 1, 1, 4, 4, 6]),
        (interpolate, 1, [0, 1, 1, 3, 4, 5, 6]),
        (interpolate, 2, [0, 1, 2, 3, 4, 5, 6]),
    ):
        np.testing.assert_allclose(run(seen, stamps, delay)[:, 0, 0], expected)
    open_end = line([NAN, 1.0, NAN, NAN])
    np.testing.assert_allclose(interpolate(open_end, np.arange(4.0), OFFLINE)[:, 0, 0], [NAN, 1, 1, 1])


def test_a_spike_is_taken_out_before_the_mean() -> None:
    seen = np.random.default_rng(3).normal(0, 0.01, (40, 3, 2, 3))
    struck = seen.copy()
    struck[20, 1, 1] += 0.3
    run = partial(filters.gaussian_hampel, stamps_s=STAMPS, delay=4, sigma_s=0.05)
    clean = run(seen, threshold=8.0)
    assert np.abs(run(struck, threshold=8.0) - clean).max() < 0.03
    assert np.abs(run(struck, threshold=1e6) - run(seen, threshold=1e6)).max() > 0.03


def test_butterworth_has_no_lag_and_bridges_gaps() -> None:
    stamps = np.arange(120) / 30.0
    truth = np.sin(2 * np.pi * 0.5 * stamps)[:, None, None] * np.ones((1, 1, 3))
    seen = truth.copy()
    seen[50:53] = np.nan
    answer = filters.butterworth(seen, stamps, OFFLINE, cutoff_hz=4.0)
    assert np.abs(answer - truth)[20:100].max() < 0.02


ONLINE = [baseline for baseline in BASELINES if baseline.delays != (OFFLINE,)]


@pytest.mark.parametrize("baseline", ONLINE, ids=lambda baseline: baseline.name)
def test_no_answer_knows_more_than_its_delay(baseline) -> None:
    delay = 0 if baseline.delays else 3
    seen = motion(np.random.default_rng(4), joints=len(JOINTS))
    seen[12:16, 0] = np.nan
    seen[12:16, 1, 4:9] = np.nan
    parameters = {name: float(np.sqrt(low * high)) for name, (low, high) in baseline.space.items()}
    whole = baseline.run(seen, STAMPS, delay, **parameters)
    other = seen.copy()
    other[25:] += 1.0
    expected = baseline.run(other, STAMPS, delay, **parameters)[: 25 - delay]
    np.testing.assert_array_equal(whole[: 25 - delay], expected, err_msg=baseline.name)
    assert whole.shape == seen.shape


def test_only_what_fills_gaps_alone_is_no_filter() -> None:
    fill_gaps = {"hold last", "held in the body frame", "linear interpolation"}
    assert {baseline.name for baseline in BASELINES} - {baseline.name for baseline in FILTERS} == fill_gaps


def test_the_bank_is_true_to_what_is_clean_and_smooths_what_is_noisy_without_being_told() -> None:
    rng = np.random.default_rng(6)
    stamps = np.arange(120) / 30.0
    wave = 0.3 * np.sin(2 * np.pi * np.array([0.3, 1.0, 3.0]) * stamps[:, None])
    truth = wave[:, :, None, None] * np.ones((1, 1, 4, 3))
    assert np.abs(bank(truth, stamps, 4) - truth)[15:].max() < 0.008  # the last one moves at 10 m/s
    seen = truth + rng.normal(0, 0.03, truth.shape)
    error, raw = (np.abs(answer - truth)[15:].mean(axis=(0, 2, 3)) for answer in (bank(seen, stamps, 4), seen))
    assert error[0] < 0.5 * raw[0]
    assert error[1] < 0.8 * raw[1]
    assert error[2] < 1.3 * raw[2]


def test_the_bank_finds_the_noise_and_that_of_whole_bodies_refuses_a_choice_of_joints() -> None:
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 22, 3\) canonical joints"):
        kalman.whole_body_bank(np.zeros((5, 13, 3)), np.arange(5) / 30, 0)
    rng = np.random.default_rng(7)
    moving = 2.0 * STAMPS[:, None, None, None] * np.ones((1, 2, 5, 3))
    for sigma in (0.002, 0.05):
        found = noise_found(moving + rng.normal(0, sigma, moving.shape))[-1]
        np.testing.assert_allclose(found, sigma, rtol=0.35)


def test_a_hidden_joint_stays_beside_the_nearest_seen_one_and_turns_with_the_trunk() -> None:
    angle = np.linspace(0.0, 1.5, 40)
    cosine, sine, zero, one = np.cos(angle), np.sin(angle), np.zeros(40), np.ones(40)
    turn = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one], axis=-1).reshape(40, 3, 3)
    truth = np.einsum("tab,jb->tja", turn, REST_POSITIONS)[:, None] + STAMPS[:, None, None, None] * (1.0, 0.5, 0.0)
    seen = truth.copy()
    seen[10:, 0, [J["left_knee"], J["left_ankle"], J["left_foot"], J["right_wrist"]]] = np.nan
    np.testing.assert_allclose(beside(seen, STAMPS, 0), truth, atol=1e-9)
    gone = truth.copy()
    gone[10:] = np.nan
    gone[:, 0, J["head"]] = np.nan
    answer = beside(gone, STAMPS, 0)
    np.testing.assert_allclose(answer[:10, 0, J["head"]], truth[:10, 0, J["head"]], atol=1e-9)  # as of who stands
    np.testing.assert_allclose(answer[39, 0, 1:15], truth[9, 0, 1:15])
    gone[:] = np.nan
    assert np.isnan(beside(gone, STAMPS, 0)).all()


def test_a_density_a_joint_follows_a_wrist_more_closely_than_a_hip() -> None:
    seen = np.zeros((12, 1, 22, 3))
    seen[-1] = 0.1  # all joints jump alike
    moved = filters.constant_velocity_by_joint(seen, np.arange(12) / 30, 0, 0.5)[-1, 0, :, 0]
    assert moved[J["left_wrist"]] > moved[J["left_hip"]] > 0.0
    same = filters.constant_velocity(seen, np.arange(12) / 30, 0, 0.5)[-1, 0, 0, 0]
    assert moved.min() < same < moved.max()


def naive_one_euro(values: np.ndarray, stamps: np.ndarray, fmin: float, beta: float, fd: float) -> np.ndarray:
    """The paper's algorithm 1, one joint, with the norm of the velocity as its speed."""
    out, velocity = [values[0]], np.zeros(3)
    for i, dt in enumerate(np.diff(stamps), start=1):
        a = 1 / (1 + 1 / (2 * np.pi * fd * dt))
        velocity = a * (values[i] - values[i - 1]) / dt + (1 - a) * velocity
        a = 1 / (1 + 1 / (2 * np.pi * (fmin + beta * float(np.linalg.norm(velocity))) * dt))
        out.append(a * values[i] + (1 - a) * out[-1])
    return np.array(out)


def test_one_euro_is_the_papers_algorithm_between_gaps() -> None:
    rng = np.random.default_rng(11)
    positions, stamps = np.cumsum(rng.normal(0, 0.05, (24, 3, 3)), axis=0), np.cumsum(rng.uniform(0.01, 0.08, 24))
    positions[rng.random((24, 3)) < 0.3] = np.nan
    got = one_euro(positions, stamps, 0, 1.2, 3.0)
    for joint in range(positions.shape[1]):
        seen = np.flatnonzero(np.isfinite(positions[:, joint, 0]))
        expected = naive_one_euro(positions[seen, joint], stamps[seen], 1.2, 3.0, 1.0)
        np.testing.assert_allclose(got[seen, joint], expected, atol=1e-12)
        assert np.isnan(got[: seen[0], joint]).all()
        for frame in set(range(seen[0], len(stamps))) - set(seen.tolist()):
            np.testing.assert_array_equal(got[frame, joint], got[frame - 1, joint])


ELBOW, WRIST, HEAD = J["left_elbow"], J["left_wrist"], J["head"]


def poses(count: int, seed: int) -> np.ndarray:
    """Bodies anywhere, facing anywhere: an elbow moves at random, the wrist by 0.6 of it and by as much at random."""
    rng = np.random.default_rng(seed)
    body = np.tile(REST_POSITIONS, (count, 1, 1))
    swing, own = 0.1 * rng.standard_normal((2, count, 3))
    body[:, ELBOW] += swing
    body[:, WRIST] += 0.6 * swing + own
    body[:, HEAD] += 0.05 * rng.standard_normal((count, 3))
    turn = yaw_matrix(rng.uniform(-np.pi, np.pi, count))
    return body @ turn.swapaxes(-1, -2) + rng.uniform(-3, 3, (count, 1, 3))


@pytest.fixture(scope="module")
def gaussian() -> ConditionalGaussian:
    return ConditionalGaussian(poses(20_000, 0))


def test_a_hidden_joint_is_the_regression_on_the_seen_ones(gaussian: ConditionalGaussian) -> None:
    """Closed form: E[wrist | elbow] = rest + 0.6 (elbow - rest), whatever else is seen, place and heading."""
    rng = np.random.default_rng(1)
    body, angle, place = np.array(REST_POSITIONS), rng.uniform(-np.pi, np.pi), rng.uniform(-3, 3, 3)
    swing = np.array([0.1, -0.05, 0.2])
    body[ELBOW] += swing
    expected = body[WRIST] + 0.6 * swing
    turn = yaw_matrix(np.array(angle))
    seen = body @ turn.T + place
    seen[WRIST] = np.nan
    found = gaussian(seen[None, None])[0, 0]
    np.testing.assert_allclose(found[WRIST], turn @ expected + place, atol=5e-3)
    np.testing.assert_array_equal(np.delete(found, WRIST, axis=0), np.delete(seen, WRIST, axis=0))


def test_hidden_joints_that_nothing_tells_of_are_at_their_means(gaussian: ConditionalGaussian) -> None:
    seen = np.array(REST_POSITIONS)
    seen[[WRIST, ELBOW]] = np.nan
    np.testing.assert_allclose(gaussian(seen)[[WRIST, ELBOW]], REST_POSITIONS[[WRIST, ELBOW]], atol=5e-3)
    # with a heading that is given also without hips and shoulders
    truth = np.einsum("nab,jb->nja", yaw_matrix(np.array([0.3, 2.0])), REST_POSITIONS)
    seen = truth.copy()
    seen[:, [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "shoulder")]] = np.nan
    np.testing.assert_allclose(gaussian(seen, np.array([0.3, 2.0])), truth, atol=5e-3)


@pytest.mark.parametrize("hidden", [[], [J["pelvis"]], [J["left_hip"], WRIST], list(range(22))])
def test_without_a_frame_to_answer_in_it_answers_nothing(hidden: list[int]) -> None:
    seen = poses(3, 2)
    seen[:, hidden] = np.nan
    np.testing.assert_array_equal(ConditionalGaussian(poses(100, 0))(seen), seen)


def test_one_shoulder_and_both_hips_give_a_heading_and_without_any_a_joint_is_held_beside_the_body() -> None:
    gaussian, turn = ConditionalGaussian(poses(20_000, 0)), yaw_matrix(np.array([0.3, 2.0]))
    truth = np.tile(np.einsum("nab,jb->nja", turn, REST_POSITIONS), (12, 1, 1, 1))
    seen = truth.copy()
    seen[:, :, [J["left_shoulder"], ELBOW, WRIST]] = np.nan
    found = given_the_seen(seen, np.arange(12) / 30, 4, gaussian)
    np.testing.assert_allclose(found, truth, atol=5e-3)
    seen[6:, :, [J["right_hip"], J["right_shoulder"]]] = np.nan
    found = given_the_seen(seen, np.arange(12) / 30, 4, gaussian)[:, :, J["right_shoulder"]]
    np.testing.assert_allclose(found, truth[:, :, J["right_shoulder"]], atol=5e-3)
