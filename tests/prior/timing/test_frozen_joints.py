import numpy as np
from tests.helpers.bodies import waving

from steadypose.prior.body.skeleton import J
from steadypose.prior.timing.frozen_joints import RECENT, frozen_joints

WRIST = J["left_wrist"]


def test_a_joint_is_frozen_that_repeats_itself_while_others_shake() -> None:
    rng = np.random.default_rng(0)
    seen = np.stack([waving(50)] * 3)
    seen[:2] += rng.normal(0.0, 0.005, seen[:2].shape)
    seen[:, -RECENT:, J["left_wrist"]] = seen[:, -RECENT - 1, None, J["left_wrist"]]
    seen[1, :, J["neck"]] = np.nan
    found = frozen_joints(seen)
    assert np.flatnonzero(found[0]).tolist() == [J["left_wrist"]]
    assert np.flatnonzero(found[1]).tolist() == [J["left_wrist"]]
    assert not found[2].any()  # without noise, it may be at rest
    seen[0, -RECENT + 5 :, J["left_wrist"]] += rng.random((RECENT - 5, 3))
    assert not frozen_joints(seen)[0].any()


def test_a_body_that_is_repeated_whole_has_no_joint_frozen() -> None:
    """A camera of 15 Hz on a grid of 30, or one that pauses."""
    rng = np.random.default_rng(0)
    seen = (waving(50) + rng.normal(0.0, 0.005, (50, 22, 3)))[None]
    slower = seen[:, np.arange(50) // 2 * 2]
    assert not frozen_joints(slower).any()
    assert not frozen_joints(np.repeat(seen[:, :1], RECENT + 1, axis=1)).any()
    slower[:, :, WRIST] = slower[:, :1, WRIST]
    assert np.flatnonzero(frozen_joints(slower[0:1, -RECENT - 1 :])[0]).tolist() == [WRIST]


def test_what_a_sensor_rounds_is_not_frozen_while_it_rests() -> None:
    rng = np.random.default_rng(0)
    seen = (waving(50) + rng.normal(0.0, 0.001, (50, 22, 3)))[None]
    seen[:, :, 12:] += 0.02 * rng.standard_normal((1, 50, 10, 3))
    rounded = 0.02 * np.round(seen / 0.02)
    resting = (np.diff(rounded[0, -RECENT:], axis=0) == 0).all(axis=-1).mean(axis=0) > 0.5
    assert resting.any()
    assert not frozen_joints(rounded).any()
    rounded = 0.001 * np.round((seen + 0.005 * rng.standard_normal(seen.shape)) / 0.001)
    rounded[:, -RECENT:, WRIST] = rounded[:, -RECENT - 1, None, WRIST]
    assert np.flatnonzero(frozen_joints(rounded)[0]).tolist() == [WRIST], "by the millimetre, what stays is frozen"
