import numpy as np
from tests.helpers.bodies import waving

from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.clean.person import PersonEstimator, PersonSettings
from steadypose.prior.timing.fixed_lag import Smoothed

BIAS, NOISE = 0.02, 0.01
LEFT_HIP, RIGHT_KNEE = J["left_hip"], J["right_knee"]


def lengths(offsets: np.ndarray) -> np.ndarray:
    return np.linalg.norm(offsets, axis=-1)


def worst(offsets: np.ndarray, truth: np.ndarray) -> float:
    """Metres, of the bone that is the furthest from its true length."""
    return float(np.abs(lengths(offsets) - lengths(truth)).max())


def test_the_stage_knows_bones_from_the_first_frame_and_then_moves_without_steps() -> None:
    stage, present = PersonEstimator(PersonSettings(), 2), np.array([True, False])
    told = []
    for frame in waving(120, 0.85) + np.random.default_rng(0).normal(size=(120, 22, 3)) * 0.02:
        both = np.stack([frame, np.full((22, 3), np.nan)])
        smoothed = Smoothed(0.0, both, np.where(np.isnan(both[..., 0]), np.inf, 0.02))
        told.append(lengths(stage.update(smoothed, np.full(2, BIAS), present).offsets[0]))
    assert np.abs(told[0] - 0.85 * lengths(REST_OFFSETS)).max() < 0.06
    assert np.abs(np.diff(told, axis=0)).max() < 0.005
    assert worst(stage.current.offsets[0], 0.85 * REST_OFFSETS) < 0.03
    np.testing.assert_array_equal(stage.current.offsets[1], REST_OFFSETS)


def test_in_a_crowd_everybodys_bones_are_renewed_as_often_as_those_of_one_of_eight() -> None:
    """A bench puts clips side by side as bodies: they must not wait for one another."""

    def renewals(slots: int) -> np.ndarray:
        stage, present = PersonEstimator(PersonSettings(), slots), np.ones(slots, dtype=bool)
        for frame in waving(120):
            smoothed = Smoothed(0.0, np.tile(frame, (slots, 1, 1)), np.full((slots, 22), 0.02))
            stage.update(smoothed, np.full(slots, BIAS), present)
        return stage._used

    assert renewals(8).min() == renewals(64).min() > 12
