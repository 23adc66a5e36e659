import numpy as np
import pytest
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import clean_bodies, estimate

from steadypose.msgs.types import JointState
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.clean.steady import FAST, LOOK_AHEAD, MEMORY_S, SHARE, STRAIGHTEN, Steady
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.rate import FPS

STEP = np.full((1, 22, 3), 0.003)
WRIST = J["left_wrist"]


def _moving(t: int, off: float = 0.0) -> np.ndarray:
    return np.array(REST_POSITIONS)[None] + t * STEP + off


def _updated(
    steady: Steady, frame: Estimate, step: np.ndarray | None = STEP, apart: float = 0.1, correlated: float = 0.0
):
    """The positions of a frame whose joints were observed ``apart`` metres from their estimates."""
    return steady.update(frame, step, frame.positions + [apart, 0.0, 0.0], np.array([correlated])).positions


def test_estimates_that_alternate_about_a_motion_alternate_by_less_and_do_not_lag() -> None:
    steady = Steady(1, 4)
    off = [_updated(steady, estimate(_moving(t, 0.01 * (-1) ** t))) - _moving(t) for t in range(40)]
    # e = (1 - s) n + s e' with e' = -e
    np.testing.assert_allclose(off[-2], 0.01 * (1 - SHARE) / (1 + SHARE), rtol=1e-6)
    np.testing.assert_allclose(off[-1], -off[-2], rtol=1e-6)


def test_a_step_is_taken_in_a_few_frames() -> None:
    steady = Steady(1, 4)
    off = [(_updated(steady, estimate(_moving(t, 0.01 * (t >= 5)))) - _moving(t))[0, 0, 0] for t in range(9)]
    assert off == pytest.approx([0.0] * 5 + [0.01 * (1 - SHARE**k) for k in (1, 2, 3, 4)])


def test_only_joints_observed_in_both_frames_are_blended() -> None:
    steady = Steady(1, 4)
    _updated(steady, estimate(_moving(0)))
    hidden = estimate(_moving(1, 0.01))
    hidden.state[0, WRIST] = JointState.IMPUTED
    off = _updated(steady, hidden) - _moving(1)
    np.testing.assert_allclose(off[0, WRIST], 0.01)
    np.testing.assert_allclose(off[0, 0], 0.01 * (1 - SHARE))
    off = _updated(steady, estimate(_moving(2, 0.02))) - _moving(2)
    np.testing.assert_allclose(off[0, WRIST], 0.02)


def test_without_a_later_frame_or_a_past_estimates_stay() -> None:
    steady, frame = Steady(1, 0), estimate(_moving(1, 0.01))
    _updated(steady, estimate(_moving(0)), None, correlated=1.0)
    np.testing.assert_array_equal(_updated(steady, frame, correlated=1.0), frame.positions)
    steady.forget(np.ones(1, dtype=bool))
    np.testing.assert_array_equal(_updated(steady, estimate(_moving(2)), correlated=1.0), _moving(2))


def _straightened(off: float, apart: float, correlated: float, delay: int = LOOK_AHEAD) -> float:
    """How far a joint comes nearer to its straight path, off which it is in one frame after two seconds on it."""
    steady = Steady(1, delay)
    for t in range(60):
        _updated(steady, estimate(_moving(t)), apart=apart, correlated=correlated)
    jump = estimate(_moving(60, off))
    moved = _updated(steady, jump, apart=apart, correlated=correlated) - jump.positions
    return float(np.linalg.norm(moved, axis=-1).mean() - SHARE * np.sqrt(3) * off)


def test_where_noise_lasts_a_joint_goes_to_the_middle_of_its_neighbours_in_time() -> None:
    # its step leads on from where it is, so the middle is half of what the blend left
    middle = 0.5 * (1 - SHARE) * np.sqrt(3) * 1e-4
    assert _straightened(1e-4, apart=0.1, correlated=1.0) == pytest.approx(middle, rel=1e-3)
    assert _straightened(1e-4, apart=0.1, correlated=0.0) == pytest.approx(0.0, abs=1e-12)
    assert _straightened(1e-4, apart=0.1, correlated=1.0, delay=LOOK_AHEAD - 1) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("apart", "correlated"), [(0.01, 1.0), (0.01, 0.5), (0.001, 1.0)])
def test_how_far_is_limited_by_how_far_estimates_lie_from_observations(apart: float, correlated: float) -> None:
    off, forgotten = 0.05, 1 - 1 / (MEMORY_S * FPS)
    last = np.linalg.norm(SHARE * off * np.ones(3) + [apart, 0.0, 0.0])
    distance = forgotten * (1 - forgotten**60) * apart + (1 - forgotten) * last
    middle = 0.5 * (1 - SHARE) * np.sqrt(3) * off
    speed = 0.5 * FPS * np.sqrt(3) * (2 * STEP[0, 0, 0] + (1 - SHARE) * off)
    most = STRAIGHTEN * correlated * distance / (1 + (speed / FAST) ** 2)
    assert _straightened(off, apart, correlated) == pytest.approx(most * middle / np.hypot(middle, most), rel=1e-6)


def test_a_body_that_was_forgotten_has_no_distance_to_its_observations() -> None:
    steady = Steady(1, 4)
    for t in range(30):
        _updated(steady, estimate(_moving(t)), correlated=1.0)
    steady.forget(np.ones(1, dtype=bool))
    _updated(steady, estimate(_moving(0)), apart=0.0, correlated=1.0)
    off = _updated(steady, estimate(_moving(1, 1e-3)), apart=0.0, correlated=1.0) - _moving(1, 1e-3)
    np.testing.assert_allclose(off, -SHARE * 1e-3, atol=2e-4)


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_the_smoother_tells_the_motion_to_the_next_frame(delay: int) -> None:
    truth, smoother = waving(40)[:, None], MixtureSmoother(delay, 1)
    found = [smoothed for t, frame in enumerate(truth) if (smoothed := smoother.update(frame, t / FPS))]
    *earlier, last = [*found, *smoother.flush()]
    assert last.step is None
    for t in range(20, len(earlier)):
        step = earlier[t].step
        assert (step is None) == (delay == 0)
        if step is not None:
            np.testing.assert_allclose(step, truth[t + 1] - truth[t], atol=1e-4)


def test_jitter_falls_while_joints_stay_as_near() -> None:
    truth, seen = waving(150), noisy(150, 0.01)
    off = [np.array([b.positions for b in clean_bodies(seen, steady={"enabled": e})]) - truth for e in (True, False)]
    jitter, error = (
        [np.linalg.norm(np.diff(o[40:], n=order, axis=0), axis=-1).mean() for o in off] for order in (2, 0)
    )
    assert jitter[0] < 0.93 * jitter[1]
    assert error[0] < 1.01 * error[1]
