import numpy as np
import pytest

from steadypose.benchmarks import corruption
from steadypose.benchmarks.corruption import LIMBS, arm_behind, below, hide
from steadypose.prior.body.skeleton import MIRROR, REST_POSITIONS, J

SHAPE = (300, 6, 22, 3)


def resting() -> np.ndarray:
    """(1, 1, 22, 3) a body in a T-pose that faces +x, 0.95 m up."""
    return (REST_POSITIONS + [0.0, 0.0, 0.95])[None, None]


def test_noise_has_the_size_and_the_memory_that_it_says() -> None:
    zero = np.zeros(SHAPE)
    white = corruption.gaussian(zero, 0.04, np.random.default_rng(0))
    lasting = corruption.correlated(zero, 0.04, np.random.default_rng(0), memory=0.9)
    for noise, memory in ((white, 0.0), (lasting, 0.9)):
        assert noise.std() == pytest.approx(0.04, rel=0.02)
        assert noise[-1].std() == pytest.approx(0.04, rel=0.1)
        assert (noise[1:] * noise[:-1]).mean() / noise.var() == pytest.approx(memory, abs=0.02)


def test_one_observation_in_a_hundred_lies_thirty_centimetres_off() -> None:
    off = np.linalg.norm(corruption.spiked(np.zeros(SHAPE), np.random.default_rng(0)), axis=-1)
    assert (off > 0).mean() == pytest.approx(0.01, rel=0.15)
    np.testing.assert_allclose(off[off > 0], 0.30)


def test_exchanged_limbs_are_whole_and_come_back() -> None:
    truth = np.random.default_rng(1).normal(size=SHAPE)
    seen = corruption.swapped(truth, np.random.default_rng(0))
    left, right = LIMBS[0], LIMBS[1]
    on = (seen[:, :, left] != truth[:, :, left]).any(axis=(2, 3))
    assert 0.02 < on.mean() < 0.12
    np.testing.assert_array_equal(seen[on][:, left], truth[on][:, right])
    np.testing.assert_array_equal(seen[on][:, right], truth[on][:, left])
    kept = [j for j in range(22) if j not in np.concatenate(LIMBS)]
    np.testing.assert_array_equal(seen[:, :, kept], truth[:, :, kept])


def test_sides_are_exchanged_for_as_long_as_asked_and_leave_time_to_find_it() -> None:
    truth = np.random.default_rng(0).normal(size=(90, 5, 22, 3))
    seen = corruption.sides_exchanged(truth, np.random.default_rng(1), frames=30, first=20)
    on = (seen != truth).any(axis=(2, 3))
    assert (on.sum(axis=0) == 30).all()
    assert not on[:20].any()
    assert not on[-10:].any()
    assert (seen[on] == truth[on][:, MIRROR]).all()


def test_bursts_take_one_limb_for_as_long_as_asked_and_leave_time_to_find_it() -> None:
    hidden = corruption.bursts((90, 50, 22), 30, 15, np.random.default_rng(0))
    for clip in hidden.swapaxes(0, 1):
        (limb,) = [joints for joints in LIMBS if clip[:, joints].any()]
        assert clip.sum() == 30 * len(limb)
        away = np.flatnonzero(clip[:, limb[0]])
        assert away[0] >= 15
        assert away[-1] == away[0] + 29 <= 79


def test_the_trunk_hides_the_arm_on_its_far_side_only_and_a_counter_what_is_below_it() -> None:
    body = resting()
    seen = hide(body, below(body))
    assert np.isnan(seen[..., J["left_knee"], :]).all()
    assert np.isfinite(seen[..., J["head"], :]).all()
    for side, sign in (("left", 1.0), ("right", -1.0)):
        body[..., J[f"{side}_elbow"], :] = [0.0, sign * 0.22, 1.15]
        body[..., J[f"{side}_wrist"], :] = [0.05, sign * 0.22, 1.05]
    hidden = arm_behind(body)[0, 0]
    assert hidden[[J["right_elbow"], J["right_wrist"]]].all()
    assert hidden.sum() == 2
    body[..., J["right_wrist"], :] = [0.6, -0.2, 1.1]
    assert not arm_behind(body)[0, 0, J["right_wrist"]]
