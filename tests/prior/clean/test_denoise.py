import numpy as np
import pytest
from scipy.signal import lfilter
from tests.helpers.bodies import waving
from tests.helpers.values import clean_bodies, gated

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import J
from steadypose.prior.clean.frame import BodyWindows
from steadypose.prior.clean.history import History
from steadypose.prior.clean.impute import CARRY_FRAMES, _carried
from steadypose.prior.clean.reconstruct import MODEL_SIGMA, NOISE_LEFT, SETTLED, Denoise, Reconstruct, _place_pelvis
from steadypose.prior.timing.kalman import Smoothed


def answers(seen: np.ndarray, delay: int = 4, **settings) -> np.ndarray:
    return np.stack([body.positions for body in clean_bodies(seen, delay=delay, bias_sigma=0.002, **settings)])


def error_mm(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth, axis=-1)[30:].mean() * 1000)


@pytest.mark.parametrize("delay", [0, 4])
def test_in_noise_the_answer_is_nearer_to_the_truth(delay: int) -> None:
    truth = waving(75)
    seen = truth + np.random.default_rng(0).normal(0.0, 0.04, truth.shape)
    with_it = error_mm(answers(seen, delay), truth)
    assert with_it < 0.96 * error_mm(answers(seen, delay, denoise={"enabled": False}), truth)


def test_the_last_frames_are_denoised_as_the_others() -> None:
    truth = waving(50)
    seen = truth + np.random.default_rng(1).normal(0.0, 0.04, truth.shape)
    found = answers(seen)
    assert len(found) == len(truth)
    plain = answers(seen, denoise={"enabled": False})
    assert (np.linalg.norm(found - plain, axis=-1)[-4:].mean(axis=1) > 0.002).all()


def test_lost_frames_do_not_make_the_answer_flicker() -> None:
    """A body away for a frame in seven, in noise: twice the shaking of one that is not, and as near to the truth."""
    truth = waving(110)
    seen = truth + np.random.default_rng(3).normal(0.0, 0.02, truth.shape)
    flickering = seen.copy()
    flickering[20:109:7] = np.nan
    flickering[[60, 61, 80, 81, 82]] = np.nan

    def shaken(found: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(found - truth, n=2, axis=0), axis=-1)[30:].mean())

    steady, found = answers(seen), answers(flickering)
    assert len(found) == len(truth)
    assert shaken(found) < 2.3 * shaken(steady)
    assert error_mm(found, truth) < 1.15 * error_mm(steady, truth)


def test_the_weight_is_that_of_least_variance() -> None:
    """Of estimates with noise n and own + sqrt(NOISE_LEFT) n', correlated as the better of the two demands."""
    stage, history, jitter = Denoise(delay_frames=0, slots=1), History(4, 1), np.array([0.04])
    history.append(gated(np.zeros((1, 22, 3))))
    stage._reconstructed[:] = 1e-4
    smoothed = Smoothed(0.0, np.zeros((1, 22, 3)), np.full((1, 22), 0.012))
    share = stage.flush([smoothed], history, jitter, np.zeros_like(jitter))[0].positions[0, 0, 0] / 1e-4
    first, second, both = 0.012**2, NOISE_LEFT * 0.012**2 + MODEL_SIGMA**2, NOISE_LEFT * 0.012**2
    variance = [(1 - w) ** 2 * first + w**2 * second + 2 * w * (1 - w) * both for w in np.linspace(0, 1, 10_001)]
    assert share == pytest.approx(np.argmin(variance) / 10_000, abs=2e-4)
    assert stage.flush([smoothed], history, jitter, np.zeros_like(jitter))[0].sigma[0, 0] == pytest.approx(
        np.sqrt(min(variance)), rel=1e-3
    )


def test_motion_that_the_model_does_not_know_takes_its_belief_away_and_so_does_a_sensor_without_noise() -> None:
    history, smoothed = History(4, 1), Smoothed(0.0, np.zeros((1, 22, 3)), np.full((1, 22), 0.02))
    history.append(gated(np.zeros((1, 22, 3))))

    def moved(apart: float, jitter: float) -> list[float]:
        stage = Denoise(delay_frames=0, slots=1)
        stage._reconstructed[:] = apart
        found = [
            stage.flush([smoothed], history, np.array([jitter]), np.zeros(1))[0].positions[0, 0, 0] for _ in range(20)
        ]
        return [place / apart for place in found]

    near, far = moved(0.01, 0.04), moved(0.2, 0.04)
    assert near[-1] > 0.75
    assert max(far) < 0.01, "at once, not when the mean has it"
    assert max(moved(0.01, 0.001)) < 0.02


@pytest.mark.parametrize("back", [0, 2, 4, 8])
def test_errors_that_last_count_as_noise_where_the_window_has_settled(back: int) -> None:
    history, smoothed = History(12, 1), Smoothed(0.0, np.zeros((1, 22, 3)), np.full((1, 22), 0.05))
    for _ in range(back + 1):
        history.append(gated(np.zeros((1, 22, 3))))

    def moved(jitter: float, bias: float) -> Floats:
        stage = Denoise(delay_frames=back, slots=1)
        stage._reconstructed[:] = 0.01
        held = [smoothed] * (back + 1)
        return stage.flush(held, history, np.array([jitter]), np.array([bias]))[0].positions

    counted = 0.02 * min(back / SETTLED, 1.0)
    np.testing.assert_allclose(moved(0.004, 0.02), moved(np.hypot(0.004, counted), 0.0))


@pytest.mark.parametrize(("correlation", "least", "most"), [(0.0, 0.0, 0.002), (0.9, 0.005, 0.02)])
def test_a_bias_counts_unless_noise_is_known_to_be_white(
    correlation: float, least: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bones whose own lengths vary, as between markers on skin, look like a bias."""
    counted, update = [], Denoise.update

    def noted(*args) -> Smoothed | None:
        counted.append(args[-1].max())
        return update(*args)

    monkeypatch.setattr(Denoise, "update", noted)
    truth = waving(100) * (1 + 0.02 * np.sin(np.arange(100) / 12))[:, None, None]
    noise = np.random.default_rng(1).normal(0.0, 0.005, truth.shape)
    clean_bodies(truth + lfilter([1.0], [1.0, -correlation], noise, axis=0))
    assert least <= min(counted[40:])
    assert max(counted[40:]) <= most


@pytest.mark.parametrize(("correlation", "least", "most"), [(0.0, 0.8, 1.0), (0.9, 0.0, 0.2)])
def test_the_path_follows_a_bouncing_camera_but_no_time_correlated_noise(
    correlation: float, least: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``least`` and ``most`` are shares of a bounce of 4 cm at 3 Hz, which is faster than a person's path."""
    paths, update = [], Reconstruct.update

    def noted(*args) -> BodyWindows | None:
        windows = update(*args)
        assert windows
        paths.append(windows.tracks.path[0])
        return windows

    monkeypatch.setattr(Reconstruct, "update", noted)
    bounce = 0.04 * np.sin(2 * np.pi * 3 * np.arange(100) / 30)
    noise = np.random.default_rng(1).normal(0.0, 0.005, (100, 22, 3))
    at_rest = np.tile(waving(1), (100, 1, 1)) + bounce[:, None, None] * [0, 0, 1]
    clean_bodies(at_rest + lfilter([1.0], [1.0, -correlation], noise, axis=0))
    window = np.sin(2 * np.pi * 3 * np.arange(50) / 30)  # 50 frames are five periods
    found = 2 * window @ paths[99][:, 2] / 50
    assert least * 0.04 <= abs(found) <= most * 0.04


def test_hidden_joints_and_bodies_that_left_are_not_touched() -> None:
    stage, history, jitter = Denoise(delay_frames=0, slots=2), History(4, 2), np.full(2, 0.04)
    seen = np.zeros((2, 22, 3))
    seen[0, J["left_wrist"]] = np.nan
    history.append(gated(seen))
    stage._reconstructed[:] = 1.0
    stage.forget(np.array([False, True]))
    smoothed = Smoothed(0.0, np.zeros((2, 22, 3)), np.full((2, 22), 0.012))
    moved = stage.flush([smoothed], history, jitter, np.zeros_like(jitter))[0].positions[..., 0]
    assert moved[0, J["left_wrist"]] == 0
    assert (moved[0, : J["left_wrist"]] > 0).all()
    assert (moved[1] == 0).all()


def test_the_pelvis_goes_where_it_lay_beside_hips_and_spine() -> None:
    truth = waving(50)
    seen = truth.copy()
    seen[10:, J["left_hip"]] = np.nan
    found = truth[None, -3:].copy()
    found[:, :, 0] += 0.05
    before = found.copy()
    _place_pelvis(found, seen[None])
    assert np.abs(found[:, :, 0] - truth[-3:, 0]).max() < 0.02
    np.testing.assert_array_equal(found[:, :, 1:], before[:, :, 1:])
    _place_pelvis(before, np.full((1, 50, 22, 3), np.nan))
    np.testing.assert_array_equal(before[:, :, 0], truth[None, -3:, 0] + 0.05)


ARM = [J["left_elbow"], J["left_wrist"]]


def hidden_arm(frames: int = 70, start: int = 50) -> np.ndarray:
    seen = waving(frames)
    seen[start:, ARM] = np.nan
    return seen


def test_what_the_model_was_off_is_carried_into_a_gap_from_both_sides_and_fades() -> None:
    off = np.zeros((2, 6))
    observed = np.ones((2, 6))
    off[0, 1], off[0, 4] = 1.0, 2.0
    observed[0, 2:4] = 0
    observed[1, 3:] = 0
    off[1, 2] = 1.0
    carried = _carried(off, observed, CARRY_FRAMES, np.ones(2, dtype=np.int64))
    near, far = np.exp(-1 / CARRY_FRAMES), np.exp(-2 / CARRY_FRAMES)
    assert carried[0, 2] == pytest.approx(2 / 3 * near + 1 / 3 * 2 * far)
    np.testing.assert_allclose(carried[1, 3:], np.exp(-np.arange(1, 4) / CARRY_FRAMES))
    np.testing.assert_array_equal(carried[observed > 0], off[observed > 0])


def test_beside_a_gap_the_mean_of_some_frames_is_carried_and_none_beyond_the_next_gap() -> None:
    off = np.array([[5.0, 1.0, 3.0, 0.0, 8.0, 0.0, 6.0, 9.0]])
    observed = np.array([[1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 1.0]])
    carried = _carried(off, observed, 1e9, np.array([2]))
    np.testing.assert_allclose(carried[0, [3, 5]], [(2.0 + 8.0) / 2, (8.0 + 7.5) / 2])


def test_a_hidden_arm_is_imputed_better_than_held_and_marked() -> None:
    bodies, truth = clean_bodies(hidden_arm(), delay=0), waving(70)[:, ARM]
    held = np.linalg.norm(truth[51:65] - truth[49], axis=-1).mean()
    found = np.array([b.positions[ARM] for b in bodies])
    assert np.linalg.norm(found - truth, axis=-1)[51:65].mean() < held
    assert (bodies[45].state == JointState.REFINED).all()
    assert (bodies[60].sigma[ARM] > 1.1 * bodies[45].sigma[ARM]).all()
    assert all((b.state[ARM] == JointState.IMPUTED).all() for b in bodies[50:])
    assert all(np.isnan(b.raw_positions[ARM]).all() for b in bodies[50:])


def test_switched_off_hidden_joints_follow_the_refinement_model() -> None:
    refined = {"impute": {"enabled": False}, "refine": {"enabled": True}}
    off = clean_bodies(hidden_arm(45, 30), delay=0, **refined, score={"enabled": False})
    scored = clean_bodies(hidden_arm(45, 30), delay=0, **refined)
    assert all((a.positions == b.positions).all() for a, b in zip(off, scored, strict=True))
    assert all((b.state[ARM] == JointState.IMPUTED).all() for b in off[30:])
