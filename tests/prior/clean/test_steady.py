import numpy as np
import pytest
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import clean_bodies, estimate

from steadypose.msgs.types import JointState
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.clean.steady import SHARE, Steady
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.rate import FPS

STEP = np.full((1, 22, 3), 0.03)
WRIST = J["left_wrist"]


def _moving(t: int, off: float = 0.0) -> np.ndarray:
    return np.array(REST_POSITIONS)[None] + t * STEP + off


def test_estimates_that_alternate_about_a_motion_alternate_by_less_and_do_not_lag() -> None:
    steady = Steady(1)
    off = [steady.update(estimate(_moving(t, 0.01 * (-1) ** t)), STEP).positions - _moving(t) for t in range(40)]
    # e = (1 - s) n + s e' with e' = -e
    np.testing.assert_allclose(off[-2], 0.01 * (1 - SHARE) / (1 + SHARE), rtol=1e-6)
    np.testing.assert_allclose(off[-1], -off[-2], rtol=1e-6)


def test_a_step_is_taken_in_a_few_frames() -> None:
    steady = Steady(1)
    off = [
        (steady.update(estimate(_moving(t, 0.01 * (t >= 5))), STEP).positions - _moving(t))[0, 0, 0] for t in range(9)
    ]
    assert off == pytest.approx([0.0] * 5 + [0.01 * (1 - SHARE**k) for k in (1, 2, 3, 4)])


def test_only_joints_observed_in_both_frames_are_blended() -> None:
    steady = Steady(1)
    steady.update(estimate(_moving(0)), STEP)
    hidden = estimate(_moving(1, 0.01))
    hidden.state[0, WRIST] = JointState.IMPUTED
    off = steady.update(hidden, STEP).positions - _moving(1)
    np.testing.assert_allclose(off[0, WRIST], 0.01)
    np.testing.assert_allclose(off[0, 0], 0.01 * (1 - SHARE))
    off = steady.update(estimate(_moving(2, 0.02)), STEP).positions - _moving(2)
    np.testing.assert_allclose(off[0, WRIST], 0.02)


def test_without_a_later_frame_or_a_past_estimates_stay() -> None:
    steady, frame = Steady(1), estimate(_moving(1, 0.01))
    steady.update(estimate(_moving(0)), None)
    np.testing.assert_array_equal(steady.update(frame, STEP).positions, frame.positions)
    steady.forget(np.ones(1, dtype=bool))
    np.testing.assert_array_equal(steady.update(estimate(_moving(2)), STEP).positions, _moving(2))


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
