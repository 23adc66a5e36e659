import numpy as np
import pytest
from tests.helpers.bodies import waving

from steadypose.prior.body.skeleton import MIRROR, PARENTS, J
from steadypose.training.data import corruption
from steadypose.training.data.corruption import add_noise, occlude, vary_builds, with_faults, with_sensor_error
from steadypose.training.recipes.hgvae_faults import FAULTS

WINDOWS = np.stack([waving(50, speed=1.0 + 0.05 * k) for k in range(40)])


def test_the_truth_is_left_alone() -> None:
    rng, kept = np.random.default_rng(0), WINDOWS.copy()
    for spoilt in (
        occlude(WINDOWS, rng),
        add_noise(WINDOWS, rng, corruption.draw_bias_sigma(40, rng)),
        vary_builds(WINDOWS, 0.05, 0.2, rng),
        with_faults(WINDOWS, FAULTS, 1.0, rng),
        with_sensor_error(WINDOWS, 0.01, rng),
        corruption.hide_joints(WINDOWS, 3, rng),
    ):
        assert spoilt.shape == WINDOWS.shape
        assert not np.array_equal(spoilt, kept, equal_nan=True)
    np.testing.assert_array_equal(WINDOWS, kept)


def test_other_people_have_other_bones_alike_on_both_sides_each_at_an_angle_of_its_own_throughout() -> None:
    def bones(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = windows[..., 1:, :] - windows[..., list(PARENTS[1:]), :]
        return found, np.linalg.norm(found, axis=-1)

    factor = bones(vary_builds(WINDOWS, 0.1, 0.2, np.random.default_rng(0)))[1] / bones(WINDOWS)[1]
    assert 0.05 < np.log(factor).std() < 0.15
    np.testing.assert_allclose(factor, factor[:, :1].repeat(50, axis=1))
    np.testing.assert_allclose(factor, factor[..., np.array(MIRROR)[1:] - 1])
    still = WINDOWS[:, :1].repeat(50, axis=1)
    other = vary_builds(still, 0.0, 0.2, np.random.default_rng(0))
    np.testing.assert_allclose(other, other[:, :1].repeat(50, axis=1), atol=1e-12)
    (own, lengths), (turned, same) = bones(still[:, 0]), bones(other[:, 0])
    angle = np.arccos(np.clip((own * turned).sum(axis=-1) / lengths / same, -1.0, 1.0))
    assert 0.1 < np.sqrt((angle**2).mean()) < 0.25  # 0.2 about two axes, times the root of a third
    assert (angle.std(axis=1) > 0.01).mean() > 0.8


def test_gaps_are_many_and_reach_the_newest_frame() -> None:
    hidden = np.isnan(occlude(WINDOWS, np.random.default_rng(0))[..., 0])
    assert 0.1 < hidden.mean() < 0.7
    assert hidden[:, -1].any(axis=1).mean() > 0.5


def test_some_gaps_are_what_lies_below_a_level_whichever_joints_these_are() -> None:
    rng, found = np.random.default_rng(0), 0
    for window in np.concatenate([WINDOWS] * (200 // len(WINDOWS))):
        hidden = np.isnan(occlude(window[None], rng)[0, ..., 0])
        gap = hidden.any(axis=1) & ~hidden.all(axis=1)
        height, sets = window[gap, :, 2], np.unique(hidden[gap], axis=0)
        highest_hidden = np.where(hidden[gap], height, -np.inf).max(initial=-np.inf)
        found += len(sets) > 1 and highest_hidden < np.where(hidden[gap], np.inf, height).min(initial=np.inf)
    assert found >= 3


def test_a_sensor_errs_by_what_is_said_half_of_it_for_good() -> None:
    off = with_sensor_error(WINDOWS, 0.02, np.random.default_rng(0)) - WINDOWS
    assert off.std() == pytest.approx(0.02, rel=0.05)
    assert off.mean(axis=1).std() == pytest.approx(0.02 * np.sqrt(0.5 + 0.5 / 50), rel=0.05)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_a_fault_is_where_it_is_said_to_be(fault) -> None:
    """Joints or frames that have no part in it stay as they were, but where the fault is of the whole body."""
    rng, joints = np.random.default_rng(3), [J["left_elbow"], J["left_wrist"]]
    for _ in range(20):
        window = WINDOWS[0].copy()
        fault(window, slice(20, 40), joints, WINDOWS[9], rng)
        off = np.linalg.norm(window - WINDOWS[0], axis=-1) > 1e-9
        assert off.any()
        if fault.__name__ not in ("sides_exchanged", "other_bones"):
            assert not off[:20].any()
            assert not off[40:].any()
        if fault.__name__ not in ("sides_exchanged", "other_bones", "noisy"):
            assert set(np.flatnonzero(off.any(axis=0))) <= {*joints, *MIRROR[joints]}
